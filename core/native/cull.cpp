// Which Gaussians cannot reach a slot's rows, a block at a time and without posing any.
//
// A pose that stands still moves a mean to sum_j w_j A_j x: with weights that are not negative and sum to 1, into the hull of
// what its joints make of it. So a block stays within the hull of what each of its joints makes of a ball around it.
#include <algorithm>

#include "geometry.h"

constexpr float TAME = 1e15f;           // numbers beyond are left to the projection, which tells the broken ones
constexpr float OFF_ONE = 1e-5f;        // by which the weights' sum may differ from 1
constexpr float ROUNDING = 3 * OFF_ONE; // of a coordinate, that difference included
constexpr float MARGIN = 0.01f;         // pixels

static float largest(Floats v) {
    float most = v[0];
    for (int i = 1; i < LANES; i++) most = std::max(most, v[i]);
    return most;
}

static Floats absolute(Floats v) { return -negative(v); }

static Ball ball_around(const Block &block, const RsGaussians &g) {
    Floats numbers = {};  // sum of the sizes of all that a Gaussian is made of
    auto get = [&](const float *p, int row) {
        const Floats v = block.get(p + row * (size_t)g.count);
        numbers += absolute(v);
        return v;
    };
    Ball ball = {};
    Floats apart = {}, size = splat(-30.f), of_weights = {};
    for (int i = 0; i < 3; i++) {
        const Floats x = get(g.means, i), from_centre = x - (ball.centre[i] = sum(x) * (1.f / LANES));
        apart += from_centre * from_centre, size = maximum(size, get(g.log_scales, i));
    }
    ball.radius = std::sqrt(largest(apart)), ball.size = std::exp(std::min(largest(size), 6.f));
    get(g.screen, 0), ball.shift = largest(absolute(get(g.screen, 1)));
    get(g.opacity_logits, 0);
    for (int i = 0; i < 4; i++) get(g.rotations, i);
    for (int i = 0; i < 3 * g.bases; i++) get(g.sh, i);
    bool positive = true;
    for (int j = 0; j < JOINTS; j++) {
        const Floats w = get(g.skin_weights, j);
        of_weights += w, positive = positive && !any(w < 0.f);
        if (any(w != 0.f)) ball.joints |= 1u << j;
    }
    const bool whole = !any(absolute(of_weights - 1.f) > OFF_ONE), tame = !any(~(numbers < TAME));
    ball.bounded = positive && whole && tame;
    return ball;
}

void surround(RsFrame &frame, const RsGaussians &g) {
    const bool culls = frame.rows.size() > 1 && !(frame.options.flags & RS_NO_CULL);
    const int blocks = culls ? (g.count + LANES - 1) / LANES : 0;
    frame.balls.resize(blocks);
#pragma omp parallel for num_threads(frame.options.threads)
    for (int b = 0; b < blocks; b++) frame.balls[b] = ball_around(Block(b * LANES, g.count), g);
}

// A joint's transform to the camera's vertical and depth axes.
struct Axes {
    float y[4], z[4], y_length, z_length;
};

struct Joints {
    Axes axes[JOINTS];
    uint32_t wild;  // those that are not tame
};

static Joints joints_of(const RsFrame &frame, const Slot &slot, const float *pose) {
    const float *R = frame.camera.rotation, *t = frame.camera.translation;
    Joints joints = {};
    for (int j = 0; j < JOINTS; j++) {
        float A[12] = {};
        for (int d = frame.coefficients - 1; d >= 0; d--)
            for (int m = 0; m < 12; m++) A[m] = A[m] * slot.rows.start + pose[((size_t)d * JOINTS + j) * 12 + m];
        Axes &a = joints.axes[j];
        for (int i = 0; i < 4; i++) {
            a.y[i] = R[3] * A[i] + R[4] * A[4 + i] + R[5] * A[8 + i] + (i == 3 ? t[1] : 0.f);
            a.z[i] = R[6] * A[i] + R[7] * A[4 + i] + R[8] * A[8 + i] + (i == 3 ? t[2] : 0.f);
        }
        a.y_length = std::sqrt(a.y[0] * a.y[0] + a.y[1] * a.y[1] + a.y[2] * a.y[2]);
        a.z_length = std::sqrt(a.z[0] * a.z[0] + a.z[1] * a.z[1] + a.z[2] * a.z[2]);
        float numbers = 0.f;
        for (float number : A) numbers += std::fabs(number);
        if (!(numbers < TAME)) joints.wild |= 1u << j;
    }
    return joints;
}

struct Range {
    float lo = INFINITY, hi = -INFINITY;
    void include(const float *axis, float length, float origin, const Ball &ball) {
        const float *c = ball.centre, at = axis[0] * c[0] + axis[1] * c[1] + axis[2] * c[2] + axis[3];
        const float reach = length * ball.radius + ROUNDING * (std::fabs(at) + std::fabs(origin));
        lo = std::min(lo, at - reach), hi = std::max(hi, at + reach);
    }
};

// Whether a splat of the block might reach the slot's rows.
static bool might_reach(const RsFrame &frame, const Slot &slot, const Ball &ball, const Joints &joints) {
    if (!ball.bounded || ball.joints & joints.wild) return true;
    const RsCamera &cam = frame.camera;
    Range y, z;
    float y_length = 0.f, z_length = 0.f;
    for (uint32_t left = ball.joints; left; left &= left - 1) {
        const Axes &a = joints.axes[__builtin_ctz(left)];
        y.include(a.y, a.y_length, cam.translation[1], ball), z.include(a.z, a.z_length, cam.translation[2], ball);
        y_length = std::max(y_length, a.y_length), z_length = std::max(z_length, a.z_length);
    }
    if (!(z.lo >= frame.options.near)) return true;
    const float highest = y.lo / (y.lo < 0.f ? z.lo : z.hi), lowest = y.hi / (y.hi < 0.f ? z.hi : z.lo);  // Y/Z
    const float steepest = std::max(std::fabs(highest), std::fabs(lowest));
    const float deviation = cam.fy / z.lo * (y_length + steepest * z_length) * ball.size * (1.f + ROUNDING);
    const float reach = -2.f * std::log(frame.options.alpha_min) * 1.001f + 1e-3f;  // of the most opaque: see project_block
    const float half = std::sqrt(reach * (deviation * deviation + frame.options.dilation)) + ball.shift + MARGIN;
    const bool above = lowest * cam.fy + cam.cy + half < slot.rows.lo, below = highest * cam.fy + cam.cy - half > slot.rows.hi;
    return !(above || below);
}

void cull(const RsFrame &frame, const RsGaussians &g, const float *pose, const Slot &slot, std::vector<int32_t> &blocks) {
    blocks.clear();
    const bool culls = slot.rows.rate == 0.f && !frame.balls.empty();
    const Joints joints = culls ? joints_of(frame, slot, pose) : Joints{};
    for (int b = 0; b * LANES < g.count; b++)
        if (!culls || might_reach(frame, slot, frame.balls[b], joints)) blocks.push_back(b * LANES);
}
