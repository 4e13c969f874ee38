// Walks every path of the kernels on small, odd inputs; made to run under sanitizers. Prints what it did; status 1 where
// two numbers of threads gave two results.
#include <cmath>
#include <cstdio>
#include <cstring>
#include <vector>

#include "../../core/native/layout.h"

namespace {

using Array = std::vector<float>;

uint32_t state = 1;
float uniform() { return (state = state * 1664525u + 1013904223u, (state >> 8) / 16777216.f); }  // [0, 1), Numerical Recipes
float around(float middle, float spread) { return middle + spread * (2.f * uniform() - 1.f); }

Array random(size_t n, float middle, float spread) {
    Array a(n);
    for (float &x : a) x = around(middle, spread);
    return a;
}

struct Shutter {
    const char *name;
    int coefficients;
    std::vector<RsRows> rows;
};

std::vector<Shutter> shutters(int H) {
    float rate = 2.f / H;
    std::vector<Shutter> all = {{"global", 1, {{0, H, 0.f, 0.f, 1.f}}},
                                {"blur", 1, {{0, H, 0.f, 0.f, .5f}, {0, H, 0.f, 0.f, .25f}, {0, H, 0.f, 0.f, .25f}}},
                                {"scanline", 4, {{0, H, rate, -1.f, 1.f}}},
                                {"upward, exposed", 4, {{0, H, -rate, .9f, .5f}, {0, H, -rate, 1.f, .5f}}},
                                {"part", 2, {{H / 2, H, rate, -1.f, 1.f}}},
                                {"rows, exposed", 2, {}}};  // as many slots as are planned in two waves
    for (int y = 0; y < H; y++)
        for (float moving : {0.f, rate}) all.back().rows.push_back({y, y + 1, moving, 0.f, .5f});
    return all;
}

// Gaussians of one difficulty: plain ones, or every pathology that a field can hold.
struct Splats {
    Array means, rotations, log_scales, logits, sh, weights, screen;

    Splats(int M, int bases, bool nasty)
        : means(random(3 * M, 0, .5f)), rotations(random(4 * M, 0, 1)), log_scales(random(3 * M, -3, 1)), logits(random(M, 0, 2)),
          sh(random(3 * M * bases, 0, .5f)), weights(random(JOINTS * M, 0, 0)), screen(random(2 * M, 0, 0)) {
        for (int i = 0; i < M; i++) weights[i % JOINTS * M + i] = .7f, weights[(i + 5) % JOINTS * M + i] = .3f;
        if (!nasty) return;
        const float bad[] = {0.f, NAN, INFINITY, -INFINITY, 1e30f, -1e30f, 1e-40f, 100.f};
        Array *fields[] = {&means, &rotations, &log_scales, &logits, &sh, &weights, &screen};
        for (Array *field : fields)
            for (size_t i = 0; i < field->size(); i += 3) (*field)[i] = bad[(i / 3) % 8];
    }
    RsGaussians view(int M, int bases) const {
        return {M, bases, means.data(), rotations.data(), log_scales.data(), logits.data(), sh.data(), weights.data(), screen.data()};
    }
};

struct Results {
    Array rgb, transmittance, gradients;
    bool operator==(const Results &o) const {
        auto same = [](const Array &a, const Array &b) { return !a.size() || !memcmp(a.data(), b.data(), 4 * a.size()); };
        return same(rgb, o.rgb) && same(transmittance, o.transmittance) && same(gradients, o.gradients);
    }
};

Results run(RsFrame *frame, const RsGaussians &g, const Array &pose, const Shutter &shutter, const RsCamera &camera, int threads) {
    RsOptions options = {};
    options.near = .05f, options.dilation = .3f, options.alpha_min = 1 / 255.f, options.alpha_max = .99f;
    options.transmittance_min = 1e-4f, options.strip_rows = 16, options.threads = threads;
    size_t HW = (size_t)camera.height * camera.width, M = g.count, T = shutter.rows.size(), D = shutter.coefficients;
    Results r;
    r.rgb.resize(3 * HW), r.transmittance.resize(HW);
    RsCounters counters;
    if (rs_render(frame, &g, pose.data(), T, D, shutter.rows.data(), &camera, &options, r.rgb.data(), r.transmittance.data(), &counters))
        return r;
    Array target_gradient = r.rgb, gradient_t = r.transmittance;
    const std::vector<uint8_t> bytes(3 * HW, 90), mask(HW, 255);
    const RsTarget target = {bytes.data(), mask.data(), .5f, .1f};
    rs_l1(r.rgb.data(), r.transmittance.data(), &target, camera.height, camera.width, threads, target_gradient.data(), gradient_t.data());
    const size_t sizes[] = {3 * M, 4 * M, 3 * M, M, 3 * M * g.bases, JOINTS * M, 2 * M, T * D * JOINTS * 12};
    size_t total = 0;
    for (size_t n : sizes) total += n;
    r.gradients.resize(2 * total + 2);
    auto gradients_at = [&](float *at) {
        float *p[8];
        for (int i = 0; i < 8; i++) p[i] = at, at += sizes[i];
        return RsGradients{p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7]};
    };
    const RsGradients all = gradients_at(r.gradients.data()), fused = gradients_at(r.gradients.data() + total), none = {};
    rs_render_backward(frame, &g, pose.data(), r.rgb.data(), r.transmittance.data(), target_gradient.data(), gradient_t.data(), &none);
    rs_render_backward(frame, &g, pose.data(), r.rgb.data(), r.transmittance.data(), target_gradient.data(), gradient_t.data(), &all);

    double loss, squared_error;
    rs_render_l1(frame, &g, pose.data(), T, D, shutter.rows.data(), &camera, &options, &target, &counters, &loss, &squared_error);
    rs_render_l1_backward(frame, &g, pose.data(), 3.f, &fused);
    r.gradients[2 * total] = loss, r.gradients[2 * total + 1] = squared_error;
    return r;
}

Array pose_of(const Shutter &shutter) {
    Array pose;
    for (size_t t = 0; t < shutter.rows.size(); t++)
        for (int d = 0; d < shutter.coefficients; d++)
            for (int j = 0; j < JOINTS; j++)
                for (int m = 0; m < 12; m++) pose.push_back(around(d == 0 && m % 5 == 0, .1f));
    return pose;
}

bool render_all(RsFrame *frame, int M, int bases, bool nasty, int H, int W) {
    const Splats splats(M, bases, nasty);
    const RsCamera camera = {{1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 2.f}, 1.2f * W, 1.2f * W, .5f * W, .5f * H, H, W};
    bool same = true;
    for (const Shutter &shutter : shutters(H)) {
        const Array pose = pose_of(shutter);
        const RsGaussians g = splats.view(M, bases);
        const Results one = run(frame, g, pose, shutter, camera, 1);
        for (int threads : {2, 5})
            if (!(run(frame, g, pose, shutter, camera, threads) == one))
                printf("%s, %d Gaussians, %d x %d: %d threads differ from 1\n", shutter.name, M, H, W, threads), same = false;
    }
    return same;
}

void kinematics(int states, bool residuals) {
    const Array angles = random(72 * states, 0, 7), extra = random(72 * states, 0, 1), root = random(3 * states, 0, 7);
    const Array shift = random(3 * states, 0, 1), rest = random(72, 0, 1);
    int32_t parents[JOINTS];
    for (int j = 0; j < JOINTS; j++) parents[j] = (j + 1) / 2 - 1;
    const RsBody body = {angles.data(), residuals ? extra.data() : nullptr, root.data(), shift.data(), rest.data(), parents};
    Array transforms(states * JOINTS * 12), g(72 * states), gr(72 * states), gR(3 * states), gT(3 * states), gJ(72);
    rs_pose(&body, states, transforms.data());
    rs_pose_backward(&body, states, transforms.data(), g.data(), residuals ? gr.data() : nullptr, gR.data(), gT.data(), gJ.data());
}

bool continuity(int frames, int points) {
    const Array control = random(frames * points * 75, 0, 3);
    const std::vector<double> ends(2 * points, .5), meeting(frames, .25);
    Array one(control.size()), two(control.size());
    const double a = rs_continuity(control.data(), frames, points, ends.data(), meeting.data(), 1, 1, one.data());
    const double b = rs_continuity(control.data(), frames, points, ends.data(), meeting.data(), 1, 2, two.data());
    return a == b && one == two;
}

}  // namespace

int main() {
    bool same = true;
    RsFrame *frame = rs_frame_create();
    for (int M : {0, 1, 70})
        for (int nasty = 0; nasty < 2; nasty++) {
            same &= render_all(frame, M, 4, nasty, 33, 47);
            same &= render_all(frame, M, 1, nasty, 1, 1);
        }
    rs_frame_destroy(frame);
    for (int states : {0, 1, 5}) kinematics(states, false), kinematics(states, true);
    for (int frames : {1, 2, 7}) same &= continuity(frames, 4);
    printf("kernels of %d lanes: %s\n", rs_lanes(), same ? "same bits for 1, 2 and 5 threads" : "results depend on the threads");
    return !same;
}
