// Depth order within a strip, row by row.
//
// A splat's depth is z + dz/dtau (tau - own tau), linear in the row: two splats that are in the same order at the strip's
// first and last row are so in between. Two that swap, and can reach a common pixel, are drawn row by row, each row in its
// own order, with all that lies between them; everything else is drawn once for the whole strip. So the image is that of
// an order for each row, whatever the height of the strips.
#pragma once
#include <algorithm>

#include "frame.h"

// tau when a row's centre is exposed.
static inline float instant(const Slot &slot, int y) { return slot.rows.rate * (y + 0.5f) + slot.rows.start; }

static inline float depth_at(const Splat &s, float tau) { return s.depth + s.depth_rate * (tau - s.tau); }

struct Ordered {
    float depth;
    Entry entry;
};

constexpr int64_t MOST_MOVES = 64;  // per entry; a merge sort costs about as much

// Stable, by insertion, as entries are nearly in order already. overtakes(e, f) hears of every f that e is put before.
// False, with nothing lost, where that takes too long.
template <class Overtakes> static inline bool insertion_sort(std::vector<Ordered> &list, Overtakes overtakes) {
    int64_t moves = MOST_MOVES * list.size();
    for (size_t i = 1; i < list.size(); i++) {
        const Ordered one = list[i];
        size_t j = i;
        for (; j > 0 && list[j - 1].depth > one.depth; j--) overtakes(one.entry, list[j - 1].entry), list[j] = list[j - 1];
        list[j] = one;
        if ((moves -= i - j) < 0) return false;
    }
    return true;
}

static inline void sort_front_to_back(std::vector<Ordered> &list) {
    if (!insertion_sort(list, [](Entry, Entry) {}))
        std::stable_sort(list.begin(), list.end(), [](const Ordered &a, const Ordered &b) { return a.depth < b.depth; });
}

// Calls draw(entry, first row, row behind the last) for a strip's entries, front to back in every row.
template <class Draw> static inline void each_in_order(const Slot &slot, int strip, Rows strip_rows, Draw draw) {
    static thread_local std::vector<Ordered> line;
    const Entry *entries = slot.entries.data();
    for (int begin = slot.strip_begin[strip], all = slot.strip_begin[strip + 1], end; begin < all; begin = end) {
        for (end = begin + 1; end < all && entries[end].tied;) end++;
        if (end == begin + 1) {
            draw(entries[begin], strip_rows.lo, strip_rows.hi);
            continue;
        }
        for (int y = strip_rows.lo; y < strip_rows.hi; y++) {
            line.clear();
            for (int e = begin; e < end; e++) {
                const Splat &s = slot.splats[entries[e].splat];
                if (s.y_lo <= y && y < s.y_hi) line.push_back({depth_at(s, instant(slot, y)), entries[e]});
            }
            sort_front_to_back(line);
            for (const Ordered &one : line) draw(one.entry, y, y + 1);
        }
    }
}
