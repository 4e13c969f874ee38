// Mean absolute error with its gradient in one pass over the image.
#include "loss.h"

#include <algorithm>

#include "simd.h"

static inline Floats load_some(const uint8_t *p, int n) {
    if (n == LANES) return load_bytes(p) * (1.f / 255.f);
    uint8_t padded[LANES] = {};
    memcpy(padded, p, n);
    return load_bytes(padded) * (1.f / 255.f);
}

static inline Floats load_some(const float *p, int n) {
    if (n == LANES) return load(p);
    Floats v = {};
    memcpy(&v, p, n * sizeof(float));
    return v;
}

static inline void store_some(float *p, Floats v, int n) {
    if (n == LANES) return store(p, v);
    memcpy(p, &v, n * sizeof(float));
}

static inline Floats magnitude(Floats x) { return maximum(x, -x); }
static inline Floats sign(Floats x, float scale) { return keep(x > 0.f, splat(scale)) - keep(x < 0.f, splat(scale)); }

// Where a row lies in the image, the target and the gradient. Passed by value: stores may not change it.
struct Row {
    const float *rgb, *transmittance;
    const uint8_t *target, *mask;
    float *grad_rgb, *grad_transmittance;
    size_t plane, target_plane, grad_plane;
    int width;
};

static RowError compare_row(const Row row, float background, float colour_scale, float mask_scale) {
    Floats colour = {}, coverage = {}, square = {};
    auto compare = [&](int x, int n) {  // n pixels; lanes beyond them hold zeros and add nothing
        Floats T = load_some(row.transmittance + x, n), opaque = load_some(row.mask + x, n), g_t = {};
        for (int i = n; i < LANES; i++) T[i] = 1.f;
        for (int p = 0; p < 3; p++) {
            Floats d = load_some(row.rgb + p * row.plane + x, n) - load_some(row.target + p * row.target_plane + x, n) +
                       background * (T - 1.f + opaque);
            Floats g = sign(d, colour_scale);
            colour += magnitude(d), square += d * d, g_t += g;
            store_some(row.grad_rgb + p * row.grad_plane + x, g, n);
        }
        Floats e = 1.f - T - opaque;
        coverage += magnitude(e);
        store_some(row.grad_transmittance + x, background * g_t - sign(e, mask_scale), n);
    };
    int x = 0;
    for (; x + LANES <= row.width; x += LANES) compare(x, LANES);
    if (x < row.width) compare(x, row.width - x);
    return {sum(colour), sum(coverage), sum(square)};
}

// The same of `width` pixels that nothing was drawn on.
static RowError compare_empty(const uint8_t *target, const uint8_t *mask, size_t plane, int width, float background) {
    Floats colour = {}, coverage = {}, square = {};
    for (int x = 0; x < width; x += LANES) {
        const int n = std::min(LANES, width - x);
        const Floats opaque = load_some(mask + x, n);
        for (int p = 0; p < 3; p++) {
            const Floats d = load_some(target + p * plane + x, n) - background * opaque;
            colour += magnitude(d), square += d * d;
        }
        coverage += opaque;
    }
    return {sum(colour), sum(coverage), sum(square)};
}

static RowError operator+(const RowError &a, const RowError &b) { return {a.colour + b.colour, a.coverage + b.coverage, a.square + b.square}; }

void Comparison::rows(int lo, int hi, const Planes<const float> &image, const Planes<float> &gradient) {
    const float colour_scale = 1.f / (3.f * pixels), mask_scale = target.mask_weight / pixels;
    for (int y = lo; y < hi; y++) {
        const int x0 = image.x0, x1 = image.x1;
        const size_t in = image.at(y, x0), out = gradient.at(y, x0), first = (size_t)y * width, at = first + x0;
        const Row row = {image.rgb + in, image.transmittance + in, target.rgb + at, target.mask + at, gradient.rgb + out,
                         gradient.transmittance + out, image.plane, pixels, gradient.plane, x1 - x0};
        auto empty = [&](int x, int n) { return compare_empty(target.rgb + first + x, target.mask + first + x, pixels, n, target.background); };
        errors[y] = empty(0, x0) + compare_row(row, target.background, colour_scale, mask_scale) + empty(x1, width - x1);
    }
}

double Comparison::loss() const {
    double colour = 0., coverage = 0.;
    for (const RowError &e : errors) colour += e.colour, coverage += e.coverage;
    return (colour / 3. + target.mask_weight * coverage) / pixels;
}

double Comparison::squared_error() const {
    double square = 0.;
    for (const RowError &e : errors) square += e.square;
    return square / (3. * pixels);
}

double rs_l1(const float *rgb, const float *transmittance, const RsTarget *target, int height, int width, int threads, float *grad_rgb,
             float *grad_transmittance) {
    Comparison comparison(*target, height, width);
    const size_t plane = (size_t)height * width;
    const Planes<const float> image{rgb, transmittance, plane, 0, width, 0};
    const Planes<float> gradient{grad_rgb, grad_transmittance, plane, 0, width, 0};
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int y = 0; y < height; y++) comparison.rows(y, y + 1, image, gradient);
    return comparison.loss();
}
