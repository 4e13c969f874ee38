// Mean absolute error with its gradient in one pass over the image.
#include <cstddef>
#include <vector>

#include "layout.h"

static inline float sign(float x, float scale) { return x > 0.f ? scale : x < 0.f ? -scale : 0.f; }

double rs_l1(const float *rgb, const float *transmittance, const uint8_t *target, const uint8_t *mask, int height, int width,
             float background, float mask_weight, int threads, float *grad_rgb, float *grad_transmittance) {
    const size_t HW = (size_t)height * width;
    const float colour_scale = 1.f / (3.f * HW), mask_scale = mask_weight / HW, byte = 1.f / 255.f;
    std::vector<double> colour(height), coverage(height);  // by row, added in order: the same for any number of threads
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int y = 0; y < height; y++) {
        float row_colour = 0.f, row_coverage = 0.f;
        const size_t o = (size_t)y * width;
        for (int x = 0; x < width; x++) {
            const size_t i = o + x;
            const float T = transmittance[i], opaque = mask[i] * byte;
            float g_t = 0.f;
            for (int p = 0; p < 3; p++) {
                const float d = rgb[p * HW + i] - target[3 * i + p] * byte + background * (T - 1.f + opaque);
                row_colour += d < 0.f ? -d : d;
                const float g = sign(d, colour_scale);
                grad_rgb[p * HW + i] = g, g_t += g;
            }
            const float e = 1.f - T - opaque;
            row_coverage += e < 0.f ? -e : e;
            grad_transmittance[i] = background * g_t - sign(e, mask_scale);
        }
        colour[y] = row_colour, coverage[y] = row_coverage;
    }
    double total_colour = 0., total_coverage = 0.;
    for (int y = 0; y < height; y++) total_colour += colour[y], total_coverage += coverage[y];
    return total_colour / (3. * HW) + mask_weight * total_coverage / HW;
}
