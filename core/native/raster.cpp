// Strips of rows, splat by splat, front to back, LANES pixels at a time; and the same walk again for the gradient.
#include <algorithm>

#include "order.h"

static const Floats CENTRES = [] {
    Floats v;
    for (int i = 0; i < LANES; i++) v[i] = i + 0.5f;
    return v;
}();

// The pixels of a strip that a slot touches, as rows of planes. Transmittance is kept negative once a pixel has stopped.
struct Canvas {
    int r0, r1, x0, x1;  // rows and columns of the image
    size_t plane, row;   // floats from plane to plane, and from row to row
    float *data;

    float *at(int y, int x) const { return data + (y - r0) * row + (x - x0); }

    Canvas part(int lo, int hi) const {
        Canvas c = *this;
        c.r0 = lo, c.r1 = hi, c.data = at(lo, x0);
        return c;
    }
};

enum { T_PLANE, R_PLANE, G_PLANE, B_PLANE, FORWARD_PLANES };                    // forward
enum { REST_PLANE = 1, GR_PLANE, GG_PLANE, GB_PLANE, BACKWARD_PLANES };         // backward: T, rest, dL/dR, dL/dG, dL/dB

static thread_local std::vector<float> forward_buffer, backward_buffer, strip_buffer;  // kept from task to task

static Canvas open_canvas(const RsFrame &frame, const Slot &slot, int strip, int planes, std::vector<float> &buffer) {
    Canvas c;
    const Rows rows = rows_of(frame, slot, strip);
    c.r0 = rows.lo, c.r1 = rows.hi;
    c.x0 = slot.strip_x_lo[strip], c.x1 = slot.strip_x_hi[strip];
    if (c.x0 >= c.x1) c.x0 = c.x1 = 0;
    c.plane = (c.x1 - c.x0 + 2 * LANES - 1) / LANES * LANES;  // a vector may start at the last column
    c.row = c.plane * planes;
    buffer.resize(c.row * (c.r1 - c.r0));
    c.data = buffer.data();
    return c;
}

// What bounds an alpha and a transmittance.
struct Limits {
    Floats cut;  // log2(alpha_min)
    Floats alpha_max, transmittance_min;
    explicit Limits(const RsOptions &o)
        : cut(splat(std::log2(o.alpha_min))), alpha_max(splat(o.alpha_max)), transmittance_min(splat(o.transmittance_min)) {}
};

// One splat over one row's vector.
struct Hit {
    Floats raw, alpha, weight;  // exp2(power); capped, 0 where it does not count; T alpha
};

// Takes a splat's alpha off the transmittance at t; false where no pixel is reached. A pixel whose transmittance would fall
// under the minimum stops: its T turns negative, and nothing that comes behind reaches it.
static inline bool step(Floats power, float *t, const Limits &limits, Hit &hit) {
    Floats T = load(t);
    Ints reached = (power >= limits.cut) & (T > 0.f);
    if (!any(reached)) return false;
    hit.raw = exp2(power);
    Floats alpha = keep(reached, minimum(hit.raw, limits.alpha_max)), weight = T * alpha, after = T - weight;
    Ints live = after >= limits.transmittance_min;
    hit.alpha = keep(live, alpha), hit.weight = keep(live, weight);
    store(t, select(live, after, negative(T)));
    return true;
}

// A splat's rows within a canvas, as the walks below take them: N vectors a row. Up to four, the compiler unrolls them,
// and no branch depends on the width; N = 0 stands for any number.
constexpr int MOST_UNROLLED = 4;

template <template <int> class Walk, class... Arguments> static inline void walk(const Splat &s, const Canvas &c, Arguments &&...rest) {
    switch ((s.x_hi - s.x_lo + LANES - 1) / LANES) {
    case 1: return Walk<1>::run(s, c, rest...);
    case 2: return Walk<2>::run(s, c, rest...);
    case 3: return Walk<3>::run(s, c, rest...);
    case MOST_UNROLLED: return Walk<MOST_UNROLLED>::run(s, c, rest...);
    default: return Walk<0>::run(s, c, rest...);
    }
}

template <int N> struct Blend {
    static void run(const Splat splat, const Canvas &c, const Limits &limits) {
        const int y1 = std::min<int>(c.r1, splat.y_hi), x0 = splat.x_lo, vectors = N ? N : (splat.x_hi - x0 + LANES - 1) / LANES;
        const size_t plane = c.plane, row = c.row;
        int y = std::max<int>(c.r0, splat.y_lo);
        for (float *line = c.at(y, x0); y < y1; y++, line += row) {
            float dy = y + 0.5f - splat.v, constant = splat.qyy * dy * dy + splat.log2_opacity;
            Floats dx = CENTRES + (x0 - (splat.u - splat.tilt * dy));
            float *t = line;
            for (int i = 0; i < vectors; i++, t += LANES, dx += (float)LANES) {
                Hit hit;
                if (!step(dx * dx * splat.qxx + constant, t, limits, hit)) continue;
                store(t + R_PLANE * plane, load(t + R_PLANE * plane) + hit.weight * splat.r);
                store(t + G_PLANE * plane, load(t + G_PLANE * plane) + hit.weight * splat.g);
                store(t + B_PLANE * plane, load(t + B_PLANE * plane) + hit.weight * splat.b);
            }
        }
    }
};

static void blend_strip(const RsFrame &frame, const Slot &slot, int strip, const Canvas &c) {
    const Limits limits(frame.options);
    for (int y = c.r0; y < c.r1; y++) {
        float *t = c.at(y, c.x0);
        std::fill(t, t + c.plane, 1.f), std::fill(t + c.plane, t + FORWARD_PLANES * c.plane, 0.f);
    }
    each_in_order(slot, strip, {c.r0, c.r1}, [&](Entry e, int lo, int hi) { walk<Blend>(slot.splats[e.splat], c.part(lo, hi), limits); });
}

// weight * canvas, on the image's columns: the first slot of a group sets them, the others add.
static void emit(const Canvas &c, float weight, bool first, const Planes<float> &image) {
    auto put = [first](float *out, float value) { *out = first ? value : *out + value; };
    const int n = c.x1 - c.x0, before = (n ? c.x0 : image.x1) - image.x0, width = image.x1 - image.x0;
    for (int y = c.r0; y < c.r1; y++) {
        const size_t start = image.at(y, image.x0);
        float *out[4] = {image.transmittance + start, image.rgb + start, image.rgb + image.plane + start, image.rgb + 2 * image.plane + start};
        for (int p = 0; p < 4; p++) {
            const float *in = c.at(y, c.x0) + p * c.plane, outside = p ? 0.f : weight;
            for (int x = 0; x < before; x++) put(out[p] + x, outside);
            for (int x = 0; x < n; x++) put(out[p] + before + x, weight * (p ? in[x] : std::fabs(in[x])));
            for (int x = before + n; x < width; x++) put(out[p] + x, outside);
        }
    }
}

static void order(RsFrame &frame, Task task) {
    const Group &group = frame.groups[task.group];
    for (int k = 0; k < group.slots; k++) order(frame, frame.slots[group.first_slot + k], task.strip);
}

static void draw(RsFrame &frame, Task task, const Planes<float> &image) {
    order(frame, task);
    const Group &group = frame.groups[task.group];
    for (int k = 0; k < group.slots; k++) {
        const Slot &slot = frame.slots[group.first_slot + k];
        Canvas c = open_canvas(frame, slot, task.strip, FORWARD_PLANES, forward_buffer);
        blend_strip(frame, slot, task.strip, c);
        emit(c, slot.rows.weight, k == 0, image);
    }
}

// ---- backward ---------------------------------------------------------------------------------------------------------

// What the gradient walk starts from: T = 1, the upstream gradient, and rest = dL/dC . C + dL/dT T of the whole pixel,
// from which the contributions are taken one by one, front to back.
static void open_gradient(const Slot &slot, const Canvas &c, const Canvas *own, const Planes<const float> &image,
                          const Planes<const float> &gradient) {
    const int n = c.x1 - c.x0;
    const float weight = slot.rows.weight;
    for (int y = c.r0; y < c.r1; y++) {
        float *t = c.at(y, c.x0), *rest = t + REST_PLANE * c.plane;
        const size_t in = image.at(y, c.x0), up = gradient.at(y, c.x0);
        std::fill(t, t + c.plane, 1.f), std::fill(rest + n, t + 2 * c.plane, 0.f);
        const float *g = gradient.transmittance + up, *T = own ? own->at(y, c.x0) : image.transmittance + in;
        for (int x = 0; x < n; x++) rest[x] = weight * g[x] * std::fabs(T[x]);
        for (int p = 0; p < 3; p++) {
            float *out = t + (GR_PLANE + p) * c.plane;
            const float *up_colour = gradient.rgb + p * gradient.plane + up;
            const float *colour = own ? own->at(y, c.x0) + (R_PLANE + p) * own->plane : image.rgb + p * image.plane + in;
            for (int x = 0; x < n; x++) out[x] = weight * up_colour[x], rest[x] += out[x] * colour[x];
            std::fill(out + n, out + c.plane, 0.f);
        }
    }
}

// Adds the moments of one splat over a canvas. dL/dalpha = T (c . g) - rest_after / (1 - alpha).
template <int N> struct Moments {
    static void run(const Splat splat, const Canvas &c, const Limits &limits, float *out) {
        const int y1 = std::min<int>(c.r1, splat.y_hi), x0 = splat.x_lo, vectors = N ? N : (splat.x_hi - x0 + LANES - 1) / LANES;
        const size_t plane = c.plane, row = c.row;
        Floats m0 = {}, mx = {}, my = {}, mxx = {}, mxy = {}, myy = {}, mr = {}, mg = {}, mb = {};
        int y = std::max<int>(c.r0, splat.y_lo);
        for (float *line = c.at(y, x0); y < y1; y++, line += row) {
            float dy = y + 0.5f - splat.v, constant = splat.qyy * dy * dy + splat.log2_opacity;
            Floats dx = CENTRES + (x0 - (splat.u - splat.tilt * dy)), row0 = {}, rowx = {};
            float *t = line;
            for (int i = 0; i < vectors; i++, t += LANES, dx += (float)LANES) {
                Hit hit;
                if (!step(dx * dx * splat.qxx + constant, t, limits, hit)) continue;
                Floats gr = load(t + GR_PLANE * plane), gg = load(t + GG_PLANE * plane), gb = load(t + GB_PLANE * plane);
                Floats shaded = hit.weight * (gr * splat.r + gg * splat.g + gb * splat.b), rest = load(t + REST_PLANE * plane) - shaded;
                store(t + REST_PLANE * plane, rest);
                mr += hit.weight * gr, mg += hit.weight * gg, mb += hit.weight * gb;
                Floats g = keep(hit.raw <= limits.alpha_max, shaded - hit.alpha * rest / (1.f - hit.alpha));
                Floats gx = g * dx;
                row0 += g, rowx += gx, mxx += gx * dx;
            }
            m0 += row0, mx += rowx, my += row0 * dy, mxy += rowx * dy, myy += row0 * (dy * dy);
        }
        const Floats all[MOMENTS] = {m0, mx, my, mxx, mxy, myy, mr, mg, mb};
        static_assert(MOMENTS == 9, "eight and one");
        float eight[8];
        sum_eight(all, eight);
        for (int i = 0; i < 8; i++) out[i] += eight[i];
        out[8] += sum(all[8]);
    }
};

static void walk_back(RsFrame &frame, Task task, const Planes<const float> &image, const Planes<const float> &gradient) {
    const Limits limits(frame.options);
    const Group &group = frame.groups[task.group];
    const int strip = task.strip;
    for (int k = 0; k < group.slots; k++) {
        Slot &slot = frame.slots[group.first_slot + k];
        Canvas own, c = open_canvas(frame, slot, strip, BACKWARD_PLANES, backward_buffer);
        bool averaged = group.slots > 1 || slot.rows.weight != 1.f;
        if (averaged) {  // the slot's own image is not stored: blend it again
            own = open_canvas(frame, slot, strip, FORWARD_PLANES, forward_buffer);
            blend_strip(frame, slot, strip, own);
        }
        open_gradient(slot, c, averaged ? &own : nullptr, image, gradient);
        auto moments = [&slot](Entry e) { return &slot.moments[(size_t)e.pair * 16]; };
        for (int e = slot.strip_begin[strip]; e < slot.strip_begin[strip + 1]; e++) std::fill_n(moments(slot.entries[e]), 16, 0.f);
        each_in_order(slot, strip, {c.r0, c.r1}, [&](Entry e, int lo, int hi) {
            walk<Moments>(slot.splats[e.splat], c.part(lo, hi), limits, moments(e));
        });
    }
}

// ---- whole images -----------------------------------------------------------------------------------------------------

template <class Work> static void each_task(const RsFrame &frame, Work work) {
    const int tasks = frame.tasks.size();
    Attempt attempt;
#pragma omp parallel for schedule(dynamic, 1) num_threads(frame.options.threads)
    for (int task = 0; task < tasks; task++) attempt([&, task] { work(frame.tasks[task]); });
    attempt.settle();
}

static void make_room_for_moments(RsFrame &frame) {
    for (int t = 0; t < frame.slot_count; t++) frame.slots[t].moments.resize(frame.slots[t].entries.size() * 16);
}

void raster(RsFrame &frame, const Planes<float> &image) {
    each_task(frame, [&](Task task) { draw(frame, task, image); });
}

void raster_backward(RsFrame &frame, const Planes<const float> &image, const Planes<const float> &gradient) {
    make_room_for_moments(frame);
    each_task(frame, [&](Task task) {
        if (frame.in_waves()) order(frame, task);  // planned anew since it was drawn
        walk_back(frame, task, image, gradient);
    });
}

struct Strip {
    Planes<float> image, gradient;
};

// Room for the columns that a task's splats reach.
static Strip open_strip(const RsFrame &frame, Task task, Rows rows) {
    const Group &group = frame.groups[task.group];
    int x0 = MAX_SIZE, x1 = 0;
    for (int k = 0; k < group.slots; k++) {
        const Slot &slot = frame.slots[group.first_slot + k];
        x0 = std::min<int>(x0, slot.strip_x_lo[task.strip]), x1 = std::max<int>(x1, slot.strip_x_hi[task.strip]);
    }
    if (x0 >= x1) x0 = x1 = 0;
    const size_t plane = (size_t)(rows.hi - rows.lo) * (x1 - x0);
    strip_buffer.resize(8 * plane);
    float *image = strip_buffer.data(), *gradient = image + 4 * plane;
    return {{image, image + 3 * plane, plane, x0, x1, rows.lo}, {gradient, gradient + 3 * plane, plane, x0, x1, rows.lo}};
}

void raster_compared(RsFrame &frame, Comparison &comparison, bool walks_back) {
    if (walks_back) make_room_for_moments(frame);
    each_task(frame, [&](Task task) {
        const Rows rows = rows_of(frame, frame.slots[frame.groups[task.group].first_slot], task.strip);
        const Strip strip = open_strip(frame, task, rows);
        draw(frame, task, strip.image);
        comparison.rows(rows.lo, rows.hi, strip.image, strip.gradient);
        if (walks_back) walk_back(frame, task, strip.image, strip.gradient);
    });
}
