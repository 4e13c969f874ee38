// Mean absolute error with its gradient in one pass over the image.
#include <algorithm>
#include <vector>

#include "layout.h"
#include "simd.h"

static inline Floats load_bytes(const uint8_t *p, int n) {
    typedef uint8_t Bytes __attribute__((vector_size(LANES)));
    Bytes v = {};
    memcpy(&v, p, n == LANES ? LANES : n);
    return __builtin_convertvector(v, Floats) * (1.f / 255.f);
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

// One row: returns the sums of |colour error| and |coverage error|. Lanes beyond the row hold zeros and add nothing.
struct RowError {
    double colour, coverage;
};

struct Row {
    const float *rgb, *transmittance;
    const uint8_t *target, *mask;
    float *grad_rgb, *grad_transmittance;
};

static RowError row_error(const Row &row, size_t plane, int width, float background, float colour_scale, float mask_scale) {
    Floats colour = {}, coverage = {};
    for (int x = 0; x < width; x += LANES) {
        const int n = std::min(LANES, width - x);
        Floats T = load_some(row.transmittance + x, n), opaque = load_bytes(row.mask + x, n), g_t = {};
        if (n < LANES)
            for (int i = n; i < LANES; i++) T[i] = 1.f;
        for (int p = 0; p < 3; p++) {
            Floats d = load_some(row.rgb + p * plane + x, n) - load_bytes(row.target + p * plane + x, n) +
                       background * (T - 1.f + opaque);
            Floats g = sign(d, colour_scale);
            colour += magnitude(d), g_t += g;
            store_some(row.grad_rgb + p * plane + x, g, n);
        }
        Floats e = 1.f - T - opaque;
        coverage += magnitude(e);
        store_some(row.grad_transmittance + x, background * g_t - sign(e, mask_scale), n);
    }
    return {sum(colour), sum(coverage)};
}

double rs_l1(const float *rgb, const float *transmittance, const uint8_t *target, const uint8_t *mask, int height, int width,
             float background, float mask_weight, int threads, float *grad_rgb, float *grad_transmittance) {
    const size_t plane = (size_t)height * width;
    const float colour_scale = 1.f / (3.f * plane), mask_scale = mask_weight / plane;
    std::vector<RowError> errors(height);  // added in row order: the same for any number of threads
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int y = 0; y < height; y++) {
        const size_t o = (size_t)y * width;
        const Row row = {rgb + o, transmittance + o, target + o, mask + o, grad_rgb + o, grad_transmittance + o};
        errors[y] = row_error(row, plane, width, background, colour_scale, mask_scale);
    }
    double colour = 0., coverage = 0.;
    for (const RowError &e : errors) colour += e.colour, coverage += e.coverage;
    return colour / (3. * plane) + mask_weight * coverage / plane;
}
