// Strips of rows, splat by splat, front to back, LANES pixels at a time; and the same walk again for the gradient.
#include <algorithm>

#include "frame.h"

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
};

enum { T_PLANE, R_PLANE, G_PLANE, B_PLANE, FORWARD_PLANES };                    // forward
enum { REST_PLANE = 1, GR_PLANE, GG_PLANE, GB_PLANE, BACKWARD_PLANES };         // backward: T, rest, dL/dR, dL/dG, dL/dB

static Canvas open_canvas(const RsFrame &frame, const Slot &slot, int strip, int planes, std::vector<float> &buffer) {
    Canvas c;
    c.r0 = slot.rows.lo + strip * frame.options.strip_rows, c.r1 = std::min(c.r0 + frame.options.strip_rows, slot.rows.hi);
    c.x0 = slot.strip_x_lo[strip], c.x1 = slot.strip_x_hi[strip];
    if (c.x0 >= c.x1) c.x0 = c.x1 = 0;
    c.plane = (c.x1 - c.x0 + 2 * LANES - 1) / LANES * LANES;  // a vector may start at the last column
    c.row = c.plane * planes;
    buffer.resize(c.row * (c.r1 - c.r0));
    c.data = buffer.data();
    return c;
}

// One splat over one row's vector: where it counts, with which alpha and weight; steps the transmittance.
struct Hit {
    Ints use;             // contributes
    Floats raw, alpha;    // before and after the cap
    Floats weight;        // T alpha, 0 where unused
};

struct Limits {
    float cut;  // log2(alpha_min)
    Floats alpha_max;
    float transmittance_min;
    explicit Limits(const RsOptions &o) : cut(std::log2(o.alpha_min)), alpha_max(splat(o.alpha_max)), transmittance_min(o.transmittance_min) {}
};

static inline bool step(Floats power, float *t, const Limits &limits, Hit &hit) {
    Floats T = load(t);
    Ints reached = (power >= limits.cut) & (T > 0.f);
    if (!any(reached)) return false;
    hit.raw = exp2(power);
    hit.alpha = minimum(hit.raw, limits.alpha_max);
    Floats weight = T * hit.alpha, after = T - weight;
    Ints stop = after < limits.transmittance_min;
    hit.use = reached & ~stop;
    hit.weight = keep(hit.use, weight);
    store(t, select(reached, select(stop, -T, after), T));
    return true;
}

static void blend_strip(const RsFrame &frame, const Slot &slot, int strip, const Canvas &c) {
    const Limits limits(frame.options);
    for (int y = c.r0; y < c.r1; y++) {
        float *t = c.at(y, c.x0);
        std::fill(t, t + c.plane, 1.f), std::fill(t + c.plane, t + FORWARD_PLANES * c.plane, 0.f);
    }
    for (int e = slot.strip_begin[strip]; e < slot.strip_begin[strip + 1]; e++) {
        const Splat &s = slot.splats[slot.entry_splat[e]];
        int y0 = std::max<int>(c.r0, s.y_lo), y1 = std::min<int>(c.r1, s.y_hi);
        for (int y = y0; y < y1; y++) {
            float dy = y + 0.5f - s.v, ridge = s.u - s.tilt * dy, constant = s.qyy * dy * dy + s.log2_opacity;
            for (int x = s.x_lo; x < s.x_hi; x += LANES) {
                Floats dx = CENTRES + (x - ridge);
                Hit hit;
                float *t = c.at(y, x);
                if (!step(dx * dx * s.qxx + constant, t, limits, hit)) continue;
                store(t + R_PLANE * c.plane, load(t + R_PLANE * c.plane) + hit.weight * s.r);
                store(t + G_PLANE * c.plane, load(t + G_PLANE * c.plane) + hit.weight * s.g);
                store(t + B_PLANE * c.plane, load(t + B_PLANE * c.plane) + hit.weight * s.b);
            }
        }
    }
}

// Adds weight * canvas to the image's rows; the first slot of a group sets them.
static void emit(const RsFrame &frame, const Canvas &c, float weight, bool first, float *rgb, float *transmittance) {
    int W = frame.camera.width;
    size_t HW = (size_t)frame.camera.height * W;
    for (int y = c.r0; y < c.r1; y++) {
        float *out[4] = {transmittance + (size_t)y * W, rgb + (size_t)y * W, rgb + HW + (size_t)y * W, rgb + 2 * HW + (size_t)y * W};
        if (first)
            for (float *row : out) std::fill(row, row + W, 0.f);
        for (int x = 0; x < c.x0; x++) out[0][x] += weight;
        for (int x = c.x1; x < W; x++) out[0][x] += weight;
        for (int p = 0; p < 4; p++) {
            const float *in = c.at(y, c.x0) + p * c.plane;
            for (int x = c.x0; x < c.x1; x++) out[p][x] += weight * (p ? in[x - c.x0] : std::fabs(in[x - c.x0]));
        }
    }
}

void raster(RsFrame &frame, float *rgb, float *transmittance) {
    int tasks = frame.tasks.size();
    Attempt attempt;
#pragma omp parallel num_threads(frame.options.threads)
    {
        static thread_local std::vector<float> buffer;
#pragma omp for schedule(dynamic, 1)
        for (int task = 0; task < tasks; task++) attempt([&, task] {
            const Group &group = frame.groups[frame.tasks[task].first];
            for (int k = 0; k < group.slots; k++) {
                const Slot &slot = frame.slots[group.first_slot + k];
                Canvas c = open_canvas(frame, slot, frame.tasks[task].second, FORWARD_PLANES, buffer);
                blend_strip(frame, slot, frame.tasks[task].second, c);
                emit(frame, c, slot.rows.weight, k == 0, rgb, transmittance);
            }
        });
    }
    attempt.settle();
}

// ---- backward ---------------------------------------------------------------------------------------------------------

// What the gradient walk starts from: T = 1, the upstream gradient, and rest = dL/dC . C + dL/dT T of the whole pixel,
// from which the contributions are taken one by one, front to back.
static void open_gradient(const RsFrame &frame, const Slot &slot, const Canvas &c, const Canvas *own, const float *rgb,
                          const float *transmittance, const float *grad_rgb, const float *grad_transmittance) {
    int W = frame.camera.width, n = c.x1 - c.x0;
    size_t HW = (size_t)frame.camera.height * W;
    float weight = slot.rows.weight;
    for (int y = c.r0; y < c.r1; y++) {
        float *t = c.at(y, c.x0), *rest = t + REST_PLANE * c.plane;
        size_t o = (size_t)y * W + c.x0;
        std::fill(t, t + c.plane, 1.f), std::fill(rest, rest + (BACKWARD_PLANES - 1) * c.plane, 0.f);
        for (int p = 0; p < 3; p++)
            for (int x = 0; x < n; x++) t[(GR_PLANE + p) * c.plane + x] = weight * grad_rgb[p * HW + o + x];
        for (int x = 0; x < n; x++) {
            float value = weight * grad_transmittance[o + x] * (own ? std::fabs(own->at(y, c.x0)[x]) : transmittance[o + x]);
            for (int p = 0; p < 3; p++) {
                float colour = own ? own->at(y, c.x0)[(R_PLANE + p) * own->plane + x] : rgb[p * HW + o + x];
                value += t[(GR_PLANE + p) * c.plane + x] * colour;
            }
            rest[x] = value;
        }
    }
}

// Moments of one splat over one strip. dL/dalpha = T (c . g) - rest_after / (1 - alpha).
static void splat_moments(const Splat &s, const Canvas &c, const Limits &limits, float *out) {
    Floats m0 = {}, mx = {}, my = {}, mxx = {}, mxy = {}, myy = {}, mr = {}, mg = {}, mb = {};
    int y0 = std::max<int>(c.r0, s.y_lo), y1 = std::min<int>(c.r1, s.y_hi);
    for (int y = y0; y < y1; y++) {
        float dy = y + 0.5f - s.v, ridge = s.u - s.tilt * dy, constant = s.qyy * dy * dy + s.log2_opacity;
        Floats row0 = {}, rowx = {};
        for (int x = s.x_lo; x < s.x_hi; x += LANES) {
            Floats dx = CENTRES + (x - ridge);
            Hit hit;
            float *t = c.at(y, x);
            if (!step(dx * dx * s.qxx + constant, t, limits, hit)) continue;
            Floats gr = load(t + GR_PLANE * c.plane), gg = load(t + GG_PLANE * c.plane), gb = load(t + GB_PLANE * c.plane);
            Floats shade = gr * s.r + gg * s.g + gb * s.b, rest = load(t + REST_PLANE * c.plane) - hit.weight * shade;
            store(t + REST_PLANE * c.plane, rest);
            mr += hit.weight * gr, mg += hit.weight * gg, mb += hit.weight * gb;
            Floats g = keep(hit.use & (hit.raw <= limits.alpha_max), hit.weight * shade - hit.alpha * rest / (1.f - hit.alpha));
            Floats gx = g * dx;
            row0 += g, rowx += gx, mxx += gx * dx;
        }
        m0 += row0, mx += rowx, my += row0 * dy, mxy += rowx * dy, myy += row0 * (dy * dy);
    }
    const Floats all[MOMENTS] = {m0, mx, my, mxx, mxy, myy, mr, mg, mb};
    for (int m = 0; m < MOMENTS; m++) out[m] = sum(all[m]);
}

void raster_backward(RsFrame &frame, const float *rgb, const float *transmittance, const float *grad_rgb, const float *grad_transmittance) {
    int tasks = frame.tasks.size();
    for (int t = 0; t < frame.slot_count; t++) frame.slots[t].moments.resize(frame.slots[t].entry_pair.size() * 16);
    const Limits limits(frame.options);
    Attempt attempt;
#pragma omp parallel num_threads(frame.options.threads)
    {
        static thread_local std::vector<float> forward, backward;
#pragma omp for schedule(dynamic, 1)
        for (int task = 0; task < tasks; task++) attempt([&, task] {
            const Group &group = frame.groups[frame.tasks[task].first];
            int strip = frame.tasks[task].second;
            for (int k = 0; k < group.slots; k++) {
                Slot &slot = frame.slots[group.first_slot + k];
                Canvas own, c = open_canvas(frame, slot, strip, BACKWARD_PLANES, backward);
                bool averaged = group.slots > 1 || slot.rows.weight != 1.f;
                if (averaged) {  // the slot's own image is not stored: blend it again
                    own = open_canvas(frame, slot, strip, FORWARD_PLANES, forward);
                    blend_strip(frame, slot, strip, own);
                }
                open_gradient(frame, slot, c, averaged ? &own : nullptr, rgb, transmittance, grad_rgb, grad_transmittance);
                for (int e = slot.strip_begin[strip]; e < slot.strip_begin[strip + 1]; e++)
                    splat_moments(slot.splats[slot.entry_splat[e]], c, limits, &slot.moments[(size_t)slot.entry_pair[e] * 16]);
            }
        });
    }
    attempt.settle();
}
