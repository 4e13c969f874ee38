// Depth order of the splats that survive, and the strips' lists.
#include <algorithm>

#include "frame.h"

// What only binning needs, kept by each thread.
struct Sorting {
    std::vector<uint32_t> keys, other_keys;  // depths; positive, so their bits sort as integers
    std::vector<int32_t> order, other_order;
    std::vector<int32_t> first_strip, fill;  // of a splat; of a strip, its next entry
};

// LSD radix sort, 3 passes of 11 bits, carrying `order`. Stable.
static void sort_by_depth(Sorting &s) {
    const int n = s.keys.size();
    s.other_keys.resize(n), s.other_order.resize(n);
    uint32_t histogram[3][2048] = {};
    for (uint32_t key : s.keys) histogram[0][key & 2047]++, histogram[1][key >> 11 & 2047]++, histogram[2][key >> 22]++;
    for (int pass = 0; pass < 3; pass++) {
        uint32_t total = 0;
        for (uint32_t &h : histogram[pass]) total += h, h = total - h;
        for (int i = 0; i < n; i++) {
            uint32_t at = histogram[pass][s.keys[i] >> 11 * pass & 2047]++;
            s.other_keys[at] = s.keys[i], s.other_order[at] = s.order[i];
        }
        s.keys.swap(s.other_keys), s.order.swap(s.other_order);
    }
}

static void keep_survivors(Slot &slot, const std::vector<int32_t> &blocks, const std::vector<Splat> &projected, Sorting &sorting) {
    int n = 0;
    slot.projected = 0, slot.broken = 0;
    for (const Splat &s : projected) n += s.fate == SURVIVES, slot.broken += s.fate == BROKEN, slot.projected += s.fate != ABSENT;
    slot.ids.resize(n), slot.splats.resize(n), sorting.keys.resize(n), sorting.order.resize(n);
    for (int i = 0, k = 0; k < n; i++) {
        const Splat &s = projected[i];
        if (s.fate != SURVIVES) continue;
        slot.ids[k] = blocks[i / LANES] + i % LANES, slot.splats[k] = s, sorting.order[k] = k;
        memcpy(&sorting.keys[k++], &s.depth, sizeof s.depth);
    }
}

// Which strips each splat reaches, and what each strip's splats reach.
static void share_out(const RsFrame &frame, Slot &slot, std::vector<int32_t> &first_strip) {
    const int n = slot.splats.size(), lo = slot.rows.lo, height = frame.options.strip_rows;
    slot.first_pair.resize(n + 1), first_strip.resize(n);
    slot.strip_begin.assign(slot.strips + 1, 0);
    slot.strip_x_lo.assign(slot.strips, MAX_SIZE), slot.strip_x_hi.assign(slot.strips, 0);
    int64_t pairs = 0;
    for (int k = 0; k < n; k++) {
        const Splat &s = slot.splats[k];
        slot.first_pair[k] = pairs, first_strip[k] = 0;
        if (s.y_lo >= s.y_hi || s.x_lo >= s.x_hi) continue;
        const int first = first_strip[k] = (s.y_lo - lo) / height, last = (s.y_hi - 1 - lo) / height;
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

void bin(RsFrame &frame, Slot &slot, const std::vector<int32_t> &blocks, const std::vector<Splat> &projected) {
    static thread_local Sorting sorting;
    keep_survivors(slot, blocks, projected, sorting);
    sort_by_depth(sorting);
    share_out(frame, slot, sorting.first_strip);
    slot.entries.resize(slot.first_pair.back());
    sorting.fill.assign(slot.strip_begin.begin(), slot.strip_begin.end() - 1);
    for (int k : sorting.order) {
        int strip = sorting.first_strip[k];
        for (uint32_t pair = slot.first_pair[k]; pair < (uint32_t)slot.first_pair[k + 1]; pair++, strip++)
            slot.entries[sorting.fill[strip]++] = {k, pair, 0};
    }
}
