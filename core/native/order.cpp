// Puts a strip's entries in the order of its first row, and finds those whose order changes before its last.
#include "order.h"

static bool reach_common_pixel(const Splat &a, const Splat &b, Rows rows) {
    return a.x_lo < b.x_hi && b.x_lo < a.x_hi && std::max({(int)a.y_lo, (int)b.y_lo, rows.lo}) < std::min({(int)a.y_hi, (int)b.y_hi, rows.hi});
}

void order(const RsFrame &frame, Slot &slot, int strip) {
    if (slot.rows.rate == 0.f || frame.options.flags & RS_NO_RESORT) return;
    const Rows rows = rows_of(frame, slot, strip);
    const int n = slot.strip_begin[strip + 1] - slot.strip_begin[strip];
    Entry *entries = slot.entries.data() + slot.strip_begin[strip];
    static thread_local std::vector<Ordered> list;
    list.resize(n);
    auto take = [&](int y) {
        for (int i = 0; i < n; i++) list[i] = {depth_at(slot.splats[entries[i].splat], instant(slot, y)), entries[i]};
    };
    take(rows.lo);
    sort_front_to_back(list);
    for (int i = 0; i < n; i++) entries[i] = list[i].entry;
    if (rows.hi - rows.lo == 1) return;

    // Whom each entry overtakes on the way to the last row: `foremost` is the first of those that it shares a pixel with.
    static thread_local std::vector<int> foremost;
    foremost.resize(n);
    take(rows.hi - 1);
    for (int i = 0; i < n; i++) list[i].entry.pair = foremost[i] = i;  // places, in place of pairs
    const bool all = insertion_sort(list, [&](Entry e, Entry f) {
        if ((int)f.pair < foremost[e.pair] && reach_common_pixel(slot.splats[e.splat], slot.splats[f.splat], rows)) foremost[e.pair] = f.pair;
    });
    for (int i = n - 1, front = n; i > 0; i--) {
        front = std::min(front, foremost[i]);
        entries[i].tied = !all || front < i;
    }
}
