// The C interface: checks, plans the slots, runs the stages.
#include <algorithm>
#include <new>

#include "frame.h"

RsFrame *rs_frame_create(void) { return new (std::nothrow) RsFrame(); }
void rs_frame_destroy(RsFrame *frame) { delete frame; }
int rs_lanes(void) { return LANES; }

static bool same_rows(const RsRows &a, const RsRows &b) { return a.lo == b.lo && a.hi == b.hi; }

static bool acceptable(const RsGaussians &g, int slots, int coefficients, const RsCamera &camera, const RsOptions &options) {
    return g.count >= 0 && (g.bases == 1 || g.bases == 4) && slots >= 1 && coefficients >= 1 && coefficients <= MAX_COEFFICIENTS &&
           camera.height >= 1 && camera.height <= MAX_SIZE && camera.width >= 1 && camera.width <= MAX_SIZE &&
           options.strip_rows >= 1 && options.threads >= 1;
}

// False where a row range is outside the image or partly overlaps another, or a number of it is not finite.
static bool acceptable(const RsRows *rows, int slots, int height) {
    for (int t = 0, next = 0; t < slots; t++) {
        if (!std::isfinite(rows[t].rate) || !std::isfinite(rows[t].start) || !std::isfinite(rows[t].weight)) return false;
        if (t && same_rows(rows[t], rows[t - 1])) continue;
        if (rows[t].lo < next || rows[t].hi <= rows[t].lo || rows[t].hi > height) return false;
        next = rows[t].hi;
    }
    return true;
}

// Slots that are planned at a time, but for those that share their rows. What of them is kept for the way back is as much as of
// one whole image; of more, nothing is kept, and they are planned again. So memory does not grow with the slots.
constexpr int WAVE = 64;

static void split_into_waves(RsFrame &frame) {
    const int slots = frame.rows.size();
    frame.waves.assign(1, 0);
    for (int t = 1; t < slots; t++)
        if (t - frame.waves.back() >= WAVE && !same_rows(frame.rows[t], frame.rows[t - 1])) frame.waves.push_back(t);
    frame.waves.push_back(slots);
}

// Lays out a wave's slots, groups and strips.
static void lay_out(RsFrame &frame, int wave) {
    const int height = frame.options.strip_rows, first = frame.waves[wave], slots = frame.waves[wave + 1] - first;
    frame.first_slot = first, frame.slot_count = slots, frame.groups.clear(), frame.tasks.clear();
    if ((int)frame.slots.size() < slots) frame.slots.resize(slots);
    for (int t = 0; t < slots; t++) {
        const RsRows &rows = frame.rows[first + t];
        Slot &slot = frame.slots[t];
        slot.rows = rows, slot.strips = (rows.hi - rows.lo + height - 1) / height;
        if (t && same_rows(rows, frame.rows[first + t - 1])) {
            frame.groups.back().slots++;
            continue;
        }
        for (int strip = 0; strip < slot.strips; strip++) frame.tasks.push_back({(int)frame.groups.size(), strip});
        frame.groups.push_back({t, 1});
    }
}

// One slot: threads share its Gaussians. Several: each thread takes whole slots.
static void project_and_bin(RsFrame &frame, const RsGaussians &g, const float *pose) {
    constexpr int CHUNK = 64;  // blocks
    const int T = frame.slot_count, threads = frame.options.threads;
    const size_t of_slot = (size_t)frame.coefficients * JOINTS * 12;
    if (T == 1) {
        const float *slot_pose = pose + frame.first_slot * of_slot;
        cull(frame, g, slot_pose, frame.slots[0], frame.blocks);
        const int count = frame.blocks.size();
        frame.projected.resize((size_t)count * LANES);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
        for (int k = 0; k < count; k += CHUNK)
            project(frame, g, slot_pose, frame.slots[0], &frame.blocks[k], std::min(CHUNK, count - k), &frame.projected[(size_t)k * LANES]);
        return bin(frame, frame.slots[0], frame.blocks, frame.projected);
    }
    Attempt attempt;
#pragma omp parallel num_threads(threads)
    {
        static thread_local std::vector<int32_t> blocks;
        static thread_local std::vector<Splat> projected;
#pragma omp for schedule(dynamic, 1)
        for (int t = 0; t < T; t++) attempt([&, t] {
            const float *slot_pose = pose + (frame.first_slot + t) * of_slot;
            cull(frame, g, slot_pose, frame.slots[t], blocks);
            projected.resize(blocks.size() * LANES);
            project(frame, g, slot_pose, frame.slots[t], blocks.data(), blocks.size(), projected.data());
            bin(frame, frame.slots[t], blocks, projected);
        });
    }
    attempt.settle();
}

// Takes the arguments in; false where one is outside its limits.
static bool begin(RsFrame &frame, const RsGaussians &g, int slots, int coefficients, const RsRows *rows, const RsCamera &camera,
                  const RsOptions &options) {
    if (!acceptable(g, slots, coefficients, camera, options) || !acceptable(rows, slots, camera.height)) return false;
    frame.camera = camera, frame.options = options, frame.coefficients = coefficients, frame.rows.assign(rows, rows + slots);
    split_into_waves(frame), surround(frame, g);
    return true;
}

// Calls work() for each wave, planned.
template <class Work> static void each_wave(RsFrame &frame, const RsGaussians &g, const float *pose, Work work) {
    for (size_t wave = 0; wave + 1 < frame.waves.size(); wave++) {
        lay_out(frame, wave), project_and_bin(frame, g, pose);
        work();
    }
}

// The same on the way back, where the plan of a single wave is still there.
template <class Work> static void each_wave_again(RsFrame &frame, const RsGaussians &g, const float *pose, Work work) {
    if (frame.in_waves()) return each_wave(frame, g, pose, work);
    work();
}

static void count(const RsFrame &frame, RsCounters &c) {
    for (int t = 0; t < frame.slot_count; t++) {
        const Slot &slot = frame.slots[t];
        c.projected += slot.projected, c.splats += slot.ids.size(), c.pairs += slot.entries.size(), c.broken += slot.broken;
    }
}

// Calls each(lo, hi) for rows that no slot covers.
template <class Each> static void uncovered(const RsFrame &frame, Each each) {
    int next = 0;
    for (const RsRows &rows : frame.rows) {
        if (next < rows.lo) each(next, rows.lo);
        next = rows.hi;
    }
    each(next, frame.camera.height);
}

// They show the empty background.
static void clear_uncovered(const RsFrame &frame, float *rgb, float *transmittance) {
    size_t W = frame.camera.width, HW = frame.camera.height * W;
    uncovered(frame, [&](int lo, int hi) {
        std::fill(transmittance + lo * W, transmittance + hi * W, 1.f);
        for (int p = 0; p < 3; p++) std::fill(rgb + p * HW + lo * W, rgb + p * HW + hi * W, 0.f);
    });
}

template <class Value> static Planes<Value> whole(const RsCamera &camera, Value *rgb, Value *transmittance) {
    return {rgb, transmittance, (size_t)camera.height * camera.width, 0, camera.width, 0};
}

int rs_render(RsFrame *frame, const RsGaussians *g, const float *pose, int slots, int coefficients, const RsRows *rows,
              const RsCamera *camera, const RsOptions *options, float *rgb, float *transmittance, RsCounters *counters) try {
    if (!begin(*frame, *g, slots, coefficients, rows, *camera, *options)) return 2;
    clear_uncovered(*frame, rgb, transmittance), *counters = {};
    each_wave(*frame, *g, pose, [&] {
        raster(*frame, whole(*camera, rgb, transmittance));
        count(*frame, *counters);
    });
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}

int rs_render_l1(RsFrame *frame, const RsGaussians *g, const float *pose, int slots, int coefficients, const RsRows *rows,
                 const RsCamera *camera, const RsOptions *options, const RsTarget *target, RsCounters *counters, double *loss,
                 double *squared_error) try {
    if (!begin(*frame, *g, slots, coefficients, rows, *camera, *options)) return 2;
    Comparison comparison(*target, camera->height, camera->width);
    frame->target = *target, *counters = {};
    each_wave(*frame, *g, pose, [&] {
        raster_compared(*frame, comparison, !frame->in_waves());
        count(*frame, *counters);
    });
    uncovered(*frame, [&](int lo, int hi) { comparison.rows(lo, hi, {}, {}); });
    *loss = comparison.loss(), *squared_error = comparison.squared_error();
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}

int rs_render_backward(RsFrame *frame, const RsGaussians *g, const float *pose, const float *rgb, const float *transmittance,
                       const float *grad_rgb, const float *grad_transmittance, const RsGradients *out) try {
    each_wave_again(*frame, *g, pose, [&] {
        raster_backward(*frame, whole(frame->camera, rgb, transmittance), whole(frame->camera, grad_rgb, grad_transmittance));
        project_backward(*frame, *g, pose, 1.f, *out);
    });
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}

int rs_render_l1_backward(RsFrame *frame, const RsGaussians *g, const float *pose, float scale, const RsGradients *out) try {
    Comparison comparison(frame->target, frame->camera.height, frame->camera.width);
    each_wave_again(*frame, *g, pose, [&] {
        if (frame->in_waves()) raster_compared(*frame, comparison, true);
        project_backward(*frame, *g, pose, scale, *out);
    });
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}
