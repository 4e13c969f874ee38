// Depth order of the splats that survive, and the strips' lists.
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

static void keep_survivors(Slot &slot, const std::vector<Splat> &projected) {
    const int count = projected.size();
    slot.ids.resize(count), slot.tau.resize(count), slot.splats.resize(count), slot.keys.resize(count), slot.order.resize(count);
    int n = 0;
    slot.broken = 0;
    for (int i = 0; i < count; i++) {
        const Splat &s = projected[i];
        slot.broken += s.fate == BROKEN;
        if (s.fate != SURVIVES) continue;
        slot.ids[n] = i, slot.tau[n] = s.tau, slot.splats[n] = s, slot.order[n] = n;
        memcpy(&slot.keys[n++], &s.depth, sizeof s.depth);
    }
    slot.ids.resize(n), slot.tau.resize(n), slot.splats.resize(n), slot.keys.resize(n), slot.order.resize(n);
}

// Which strips each splat reaches, and what each strip's splats reach.
static void share_out(const RsFrame &frame, Slot &slot) {
    const int n = slot.splats.size(), lo = slot.rows.lo, height = frame.options.strip_rows;
    slot.first_pair.resize(n + 1), slot.first_strip.resize(n);
    slot.strip_begin.assign(slot.strips + 1, 0);
    slot.strip_x_lo.assign(slot.strips, MAX_SIZE), slot.strip_x_hi.assign(slot.strips, 0);
    int64_t pairs = 0;
    for (int k = 0; k < n; k++) {
        const Splat &s = slot.splats[k];
        slot.first_pair[k] = pairs, slot.first_strip[k] = 0;
        if (s.y_lo >= s.y_hi || s.x_lo >= s.x_hi) continue;
        const int first = slot.first_strip[k] = (s.y_lo - lo) / height, last = (s.y_hi - 1 - lo) / height;
        for (int strip = first; strip <= last; strip++, pairs++) {
            slot.strip_begin[strip + 1]++;
            slot.strip_x_lo[strip] = std::min(slot.strip_x_lo[strip], s.x_lo);
            slot.strip_x_hi[strip] = std::max(slot.strip_x_hi[strip], s.x_hi);
        }
    }
    if (pairs > INT32_MAX) throw std::bad_alloc();  // 128 GiB of moments
    slot.first_pair[n] = pairs;
    for (int strip = 0; strip < slot.strips; strip++) slot.strip_begin[strip + 1] += slot.strip_begin[strip];
}

void bin(RsFrame &frame, int index, const std::vector<Splat> &projected) {
    Slot &slot = frame.slots[index];
    keep_survivors(slot, projected);
    sort_by_depth(slot);
    share_out(frame, slot);
    slot.entries.resize(slot.first_pair.back());
    static thread_local std::vector<int32_t> fill;
    fill.assign(slot.strip_begin.begin(), slot.strip_begin.end() - 1);
    for (int k : slot.order) {
        int strip = slot.first_strip[k];
        for (uint32_t pair = slot.first_pair[k]; pair < (uint32_t)slot.first_pair[k + 1]; pair++, strip++)
            slot.entries[fill[strip]++] = {k, pair, 0};
    }
}
