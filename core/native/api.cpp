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

// Rows that no slot covers show the empty background.
static void clear_uncovered(const RsFrame &frame, float *rgb, float *transmittance) {
    size_t W = frame.camera.width, HW = frame.camera.height * W;
    int next = 0;
    auto clear = [&](int lo, int hi) {
        std::fill(transmittance + lo * W, transmittance + hi * W, 1.f);
        for (int p = 0; p < 3; p++) std::fill(rgb + p * HW + lo * W, rgb + p * HW + hi * W, 0.f);
    };
    for (const Group &group : frame.groups) {
        const RsRows &rows = frame.slots[group.first_slot].rows;
        clear(next, rows.lo), next = rows.hi;
    }
    clear(next, frame.camera.height);
}

// One slot: threads share its Gaussians. Several: each thread takes whole slots.
static void project_and_bin(RsFrame &frame, const RsGaussians &g, const float *pose) {
    constexpr int CHUNK = 64 * LANES;
    int M = g.count, T = frame.slot_count, threads = frame.options.threads;
    const size_t stride = padded(M);
    if (T == 1) {
        frame.scratch.resize(FIELDS * stride);
        const Projected out{frame.scratch.data(), stride};
#pragma omp parallel for schedule(dynamic, 1) num_threads(threads)
        for (int begin = 0; begin < M; begin += CHUNK) project(frame, g, pose, 0, begin, std::min(begin + CHUNK, M), out);
        return bin(frame, 0, M, out);
    }
    Attempt attempt;
#pragma omp parallel num_threads(threads)
    {
        static thread_local std::vector<float> scratch;
#pragma omp for schedule(dynamic, 1)
        for (int t = 0; t < T; t++) attempt([&, t] {
            scratch.resize(FIELDS * stride);
            const Projected out{scratch.data(), stride};
            project(frame, g, pose, t, 0, M, out), bin(frame, t, M, out);
        });
    }
    attempt.settle();
}

static bool acceptable(const RsGaussians &g, int slots, int coefficients, const RsCamera &camera, const RsOptions &options) {
    return g.count >= 0 && (g.bases == 1 || g.bases == 4) && slots >= 1 && coefficients >= 1 && coefficients <= MAX_COEFFICIENTS &&
           camera.height >= 1 && camera.height <= MAX_SIZE && camera.width >= 1 && camera.width <= MAX_SIZE &&
           options.strip_rows >= 1 && options.threads >= 1;
}

int rs_render(RsFrame *frame, const RsGaussians *g, const float *pose, int slots, int coefficients, const RsRows *rows,
              const RsCamera *camera, const RsOptions *options, float *rgb, float *transmittance, RsCounters *counters) try {
    if (!acceptable(*g, slots, coefficients, *camera, *options)) return 2;
    frame->camera = *camera, frame->options = *options, frame->coefficients = coefficients;
    if (!plan(*frame, rows, slots, g->count)) return 2;
    project_and_bin(*frame, *g, pose);
    clear_uncovered(*frame, rgb, transmittance);
    raster(*frame, rgb, transmittance);
    *counters = {};
    for (int t = 0; t < slots; t++) counters->splats += frame->slots[t].ids.size(), counters->pairs += frame->slots[t].entries.size(), counters->broken += frame->slots[t].broken;
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}

int rs_render_backward(RsFrame *frame, const RsGaussians *g, const float *pose, const float *rgb, const float *transmittance,
                       const float *grad_rgb, const float *grad_transmittance, const RsGradients *out) try {
    size_t M = g->count;
    auto zero = [M](float *p, size_t rows) {
        if (p) std::fill(p, p + rows * M, 0.f);
    };
    zero(out->means, 3), zero(out->rotations, 4), zero(out->log_scales, 3), zero(out->opacity_logits, 1);
    zero(out->sh, 3 * (size_t)g->bases), zero(out->skin_weights, JOINTS), zero(out->screen, 2);
    raster_backward(*frame, rgb, transmittance, grad_rgb, grad_transmittance);
    project_backward(*frame, *g, pose, *out);
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}
