// Culling, depth order, and the strips' lists.
#include <algorithm>

#include "frame.h"

// LSD radix sort of positive floats (their bits sort as integers), 3 passes of 11 bits, carrying `order`. Stable.
static void sort_by_depth(Slot &slot) {
    int n = slot.keys.size();
    slot.keys2.resize(n), slot.order2.resize(n);
    uint32_t histogram[3][2048] = {};
    for (uint32_t key : slot.keys) histogram[0][key & 2047]++, histogram[1][key >> 11 & 2047]++, histogram[2][key >> 22]++;
    for (int pass = 0; pass < 3; pass++) {
        uint32_t total = 0;
        for (uint32_t &h : histogram[pass]) total += h, h = total - h;
        for (int i = 0; i < n; i++) {
            uint32_t at = histogram[pass][slot.keys[i] >> 11 * pass & 2047]++;
            slot.keys2[at] = slot.keys[i], slot.order2[at] = slot.order[i];
        }
        slot.keys.swap(slot.keys2), slot.order.swap(slot.order2);
    }
}

static int16_t first_centre(float edge, int lo, int hi) { return (int16_t)std::ceil(std::clamp(edge - 0.5f, (float)lo, (float)hi)); }

// Keeps the Gaussians that can reach a pixel of the slot. Comparisons are written so that NaN is dropped.
static void cull(const RsFrame &frame, Slot &slot, int count, const Projected &p) {
    const RsRows &rows = slot.rows;
    float cut = std::log2(frame.options.alpha_min);
    slot.broken = 0;
    slot.ids.clear(), slot.tau.clear(), slot.keys.clear(), slot.order.clear();
    for (int i = 0; i < count; i++) {
        float u = p(U, i), v = p(V, i), hx = p(HALF_X, i), hy = p(HALF_Y, i), depth = p(DEPTH, i);
        slot.broken += depth == BROKEN;
        bool visible = (depth > 0.f) & (p(LOG2_OPACITY, i) > cut) & (p(QXX, i) <= 0.f) & (v + hy > rows.lo) & (v - hy < rows.hi) & (u + hx > 0.f) &
                       (u - hx < frame.camera.width);
        if (!visible) continue;
        uint32_t key;
        memcpy(&key, &depth, 4);
        slot.keys.push_back(key), slot.order.push_back(slot.ids.size());
        slot.ids.push_back(i), slot.tau.push_back(p(TAU, i));
    }
}

static Splat pack(const RsFrame &frame, const Slot &slot, const Projected &p, int survivor) {
    int i = slot.ids[survivor];
    Splat s;
    s.u = p(U, i), s.v = p(V, i), s.qxx = p(QXX, i), s.tilt = p(TILT, i), s.qyy = p(QYY, i), s.log2_opacity = p(LOG2_OPACITY, i);
    s.r = p(RED, i), s.g = p(GREEN, i), s.b = p(BLUE, i);
    s.depth = p(DEPTH, i), s.depth_rate = p(DEPTH_RATE, i), s.tau = p(TAU, i), s.survivor = survivor;
    float hx = p(HALF_X, i), hy = p(HALF_Y, i);
    s.x_lo = first_centre(s.u - hx, 0, frame.camera.width), s.x_hi = first_centre(s.u + hx, 0, frame.camera.width);
    s.y_lo = first_centre(s.v - hy, slot.rows.lo, slot.rows.hi), s.y_hi = first_centre(s.v + hy, slot.rows.lo, slot.rows.hi);
    return s;
}

void bin(RsFrame &frame, int index, int count, const Projected &p) {
    Slot &slot = frame.slots[index];
    cull(frame, slot, count, p);
    sort_by_depth(slot);
    int n = slot.ids.size(), lo = slot.rows.lo, height = frame.options.strip_rows;
    slot.splats.resize(n), slot.rank.resize(n), slot.first_pair.resize(n + 1);
    slot.strip_begin.assign(slot.strips + 1, 0);
    slot.strip_x_lo.assign(slot.strips, MAX_SIZE), slot.strip_x_hi.assign(slot.strips, 0);
    int64_t pairs = 0;
    for (int k = 0; k < n; k++) {
        const Splat s = slot.splats[k] = pack(frame, slot, p, slot.order[k]);
        slot.rank[slot.order[k]] = k, slot.first_pair[k] = pairs;
        if (s.y_lo >= s.y_hi || s.x_lo >= s.x_hi) continue;
        for (int strip = (s.y_lo - lo) / height; strip <= (s.y_hi - 1 - lo) / height; strip++, pairs++) {
            slot.strip_begin[strip + 1]++;
            slot.strip_x_lo[strip] = std::min(slot.strip_x_lo[strip], s.x_lo);
            slot.strip_x_hi[strip] = std::max(slot.strip_x_hi[strip], s.x_hi);
        }
    }
    if (pairs > INT32_MAX) throw std::bad_alloc();  // 128 GiB of moments
    slot.first_pair[n] = pairs;
    for (int strip = 0; strip < slot.strips; strip++) slot.strip_begin[strip + 1] += slot.strip_begin[strip];
    slot.entries.resize(pairs);
    static thread_local std::vector<int32_t> fill;
    fill.assign(slot.strip_begin.begin(), slot.strip_begin.end() - 1);
    for (int k = 0; k < n; k++) {
        int strip = (slot.splats[k].y_lo - lo) / height;
        for (uint32_t pair = slot.first_pair[k]; pair < (uint32_t)slot.first_pair[k + 1]; pair++, strip++)
            slot.entries[fill[strip]++] = {k, pair, 0};
    }
}
