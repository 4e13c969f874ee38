// The C interface: checks, plans the slots, runs the stages.
#include <algorithm>
#include <new>

#include "frame.h"

RsFrame *rs_frame_create(void) { return new (std::nothrow) RsFrame(); }
void rs_frame_destroy(RsFrame *frame) { delete frame; }
int rs_lanes(void) { return LANES; }

static bool same_rows(const RsRows &a, const RsRows &b) { return a.lo == b.lo && a.hi == b.hi; }

// Lays out slots, groups and strips. False if a row range is outside the image or partly overlaps another, or a number of
// it is not finite.
static bool plan(RsFrame &frame, const RsRows *rows, int slots, int count) {
    int next = 0, height = frame.options.strip_rows;
    frame.slot_count = slots, frame.groups.clear(), frame.tasks.clear();
    if ((int)frame.slots.size() < slots) frame.slots.resize(slots);
    for (int t = 0; t < slots; t++) {
        Slot &slot = frame.slots[t];
        if (!std::isfinite(rows[t].rate) || !std::isfinite(rows[t].start) || !std::isfinite(rows[t].weight)) return false;
        slot.rows = rows[t], slot.strips = (rows[t].hi - rows[t].lo + height - 1) / height;
        if (t && same_rows(rows[t], rows[t - 1])) {
            frame.groups.back().slots++;
            continue;
        }
        if (rows[t].lo < next || rows[t].hi <= rows[t].lo || rows[t].hi > frame.camera.height) return false;
        next = rows[t].hi;
        for (int strip = 0; strip < slot.strips; strip++) frame.tasks.push_back({(int)frame.groups.size(), strip});
        frame.groups.push_back({t, 1});
    }
    return count >= 0;
}

// Calls each(lo, hi) for rows that no slot covers.
template <class Each> static void uncovered(const RsFrame &frame, Each each) {
    int next = 0;
    for (const Group &group : frame.groups) {
        const RsRows &rows = frame.slots[group.first_slot].rows;
        each(next, rows.lo), next = rows.hi;
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

// One slot: threads share its Gaussians. Several: each thread takes whole slots.
static void project_and_bin(RsFrame &frame, const RsGaussians &g, const float *pose) {
    constexpr int CHUNK = 64 * LANES;
    int M = g.count, T = frame.slot_count, threads = frame.options.threads;
    if (T == 1) {
        frame.projected.resize(M);
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
        for (int begin = 0; begin < M; begin += CHUNK) project(frame, g, pose, 0, begin, std::min(begin + CHUNK, M), frame.projected.data());
        return bin(frame, 0, frame.projected);
    }
    Attempt attempt;
#pragma omp parallel num_threads(threads)
    {
        static thread_local std::vector<Splat> projected;
#pragma omp for schedule(dynamic, 1)
        for (int t = 0; t < T; t++) attempt([&, t] {
            projected.resize(M);
            project(frame, g, pose, t, 0, M, projected.data()), bin(frame, t, projected);
        });
    }
    attempt.settle();
}

static bool acceptable(const RsGaussians &g, int slots, int coefficients, const RsCamera &camera, const RsOptions &options) {
    return g.count >= 0 && (g.bases == 1 || g.bases == 4) && slots >= 1 && coefficients >= 1 && coefficients <= MAX_COEFFICIENTS &&
           camera.height >= 1 && camera.height <= MAX_SIZE && camera.width >= 1 && camera.width <= MAX_SIZE &&
           options.strip_rows >= 1 && options.threads >= 1;
}

// All that comes before rasterising; false where an argument is outside its limits.
static bool prepare(RsFrame &frame, const RsGaussians &g, const float *pose, int slots, int coefficients, const RsRows *rows,
                    const RsCamera &camera, const RsOptions &options) {
    if (!acceptable(g, slots, coefficients, camera, options)) return false;
    frame.camera = camera, frame.options = options, frame.coefficients = coefficients;
    if (!plan(frame, rows, slots, g.count)) return false;
    project_and_bin(frame, g, pose);
    return true;
}

static RsCounters count(const RsFrame &frame) {
    RsCounters c = {};
    for (int t = 0; t < frame.slot_count; t++) {
        const Slot &slot = frame.slots[t];
        c.splats += slot.ids.size(), c.pairs += slot.entries.size(), c.broken += slot.broken;
    }
    return c;
}

template <class Value> static Planes<Value> whole(const RsCamera &camera, Value *rgb, Value *transmittance) {
    return {rgb, transmittance, (size_t)camera.height * camera.width, 0, camera.width, 0};
}

int rs_render(RsFrame *frame, const RsGaussians *g, const float *pose, int slots, int coefficients, const RsRows *rows,
              const RsCamera *camera, const RsOptions *options, float *rgb, float *transmittance, RsCounters *counters) try {
    if (!prepare(*frame, *g, pose, slots, coefficients, rows, *camera, *options)) return 2;
    clear_uncovered(*frame, rgb, transmittance);
    raster(*frame, whole(*camera, rgb, transmittance));
    *counters = count(*frame);
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}

int rs_render_l1(RsFrame *frame, const RsGaussians *g, const float *pose, int slots, int coefficients, const RsRows *rows,
                 const RsCamera *camera, const RsOptions *options, const RsTarget *target, RsCounters *counters, double *loss,
                 double *squared_error) try {
    if (!prepare(*frame, *g, pose, slots, coefficients, rows, *camera, *options)) return 2;
    Comparison comparison(*target, camera->height, camera->width);
    raster_compared(*frame, comparison);
    uncovered(*frame, [&](int lo, int hi) { comparison.rows(lo, hi, {}, {}); });
    *counters = count(*frame), *loss = comparison.loss(), *squared_error = comparison.squared_error();
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}

int rs_render_backward(RsFrame *frame, const RsGaussians *g, const float *pose, const float *rgb, const float *transmittance,
                       const float *grad_rgb, const float *grad_transmittance, const RsGradients *out) try {
    raster_backward(*frame, whole(frame->camera, rgb, transmittance), whole(frame->camera, grad_rgb, grad_transmittance));
    project_backward(*frame, *g, pose, 1.f, *out);
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}

int rs_render_l1_backward(RsFrame *frame, const RsGaussians *g, const float *pose, float scale, const RsGradients *out) try {
    project_backward(*frame, *g, pose, scale, *out);
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}
