// LANES floats at a time, in GCC/Clang vector extensions; the few intrinsics are those that the extensions spell badly.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>
#if defined(__AVX__)
#include <immintrin.h>
#endif

#ifndef RS_LANES
#if defined(__AVX512F__)
#define RS_LANES 16
#else
#define RS_LANES 8
#endif
#endif

constexpr int LANES = RS_LANES;
typedef float Floats __attribute__((vector_size(4 * LANES)));
typedef int32_t Ints __attribute__((vector_size(4 * LANES)));  // also masks: 0 or -1 a lane

constexpr float LOG2_E = 1.44269504088896f;

static inline Floats splat(float x) { return Floats{} + x; }

static inline Floats load(const float *p) {
    Floats v;
    memcpy(&v, p, sizeof v);
    return v;
}

static inline Floats load_bytes(const uint8_t *p) {
#if defined(__AVX512F__) && RS_LANES == 16
    return (Floats)_mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_loadu_si128((const __m128i *)p)));
#elif defined(__AVX2__) && RS_LANES == 8
    return (Floats)_mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64((const __m128i *)p)));
#else
    Floats v;
    for (int i = 0; i < LANES; i++) v[i] = p[i];
    return v;
#endif
}

static inline void store(float *p, Floats v) { memcpy(p, &v, sizeof v); }

static inline Floats select(Ints mask, Floats a, Floats b) { return mask ? a : b; }

static inline Floats keep(Ints mask, Floats a) { return (Floats)(mask & (Ints)a); }

static inline Floats negative(Floats a) { return (Floats)((Ints)a | INT32_MIN); }  // -|a|

static inline bool any(Ints mask) {
#if defined(__AVX512F__) && RS_LANES == 16
    return _mm512_test_epi32_mask((__m512i)mask, (__m512i)mask) != 0;
#elif defined(__AVX__) && RS_LANES == 8
    return _mm256_movemask_ps((__m256)mask) != 0;
#else
    int32_t r = 0;
    for (int i = 0; i < LANES; i++) r |= mask[i];
    return r != 0;
#endif
}

static inline Floats minimum(Floats a, Floats b) {
#if defined(__AVX512F__) && RS_LANES == 16
    return (Floats)_mm512_min_ps((__m512)a, (__m512)b);
#elif defined(__AVX__) && RS_LANES == 8
    return (Floats)_mm256_min_ps((__m256)a, (__m256)b);
#else
    return select(a < b, a, b);
#endif
}

static inline Floats maximum(Floats a, Floats b) { return -minimum(-a, -b); }

static inline Floats clamp(Floats x, float lo, float hi) { return maximum(minimum(x, splat(hi)), splat(lo)); }

static inline Floats square_root(Floats a) {
#if defined(__AVX512F__) && RS_LANES == 16
    return (Floats)_mm512_sqrt_ps((__m512)a);
#elif defined(__AVX__) && RS_LANES == 8
    return (Floats)_mm256_sqrt_ps((__m256)a);
#else
    Floats r;
    for (int i = 0; i < LANES; i++) r[i] = __builtin_sqrtf(a[i]);
    return r;
#endif
}

static inline Floats round_up(Floats a) {  // |a| < 2^31
    const Floats whole = __builtin_convertvector(__builtin_convertvector(a, Ints), Floats);
    return whole + keep(whole < a, splat(1.f));
}

// Sum of the lanes in a fixed order (halves, quarters, ...): repeatable, and short for the compiler.
static inline float sum(Floats v) {
    float a[LANES];
    store(a, v);
    for (int width = LANES / 2; width; width /= 2)
        for (int i = 0; i < width; i++) a[i] += a[i + width];
    return a[0];
}

typedef float Eight __attribute__((vector_size(32)));

static inline Eight halved(Floats v) {  // to eight lanes
#if RS_LANES == 16
    Eight half[2];
    memcpy(half, &v, sizeof half);
    return half[0] + half[1];
#else
    return v;
#endif
}

// Sums of the lanes of eight vectors, to eight floats: pairs of vectors are merged, three times. In a fixed order.
static inline void sum_eight(const Floats *v, float *out) {
    typedef int32_t Lanes __attribute__((vector_size(32)));
    Eight a[4], b[2];
    for (int i = 0; i < 4; i++) {
        Eight l = halved(v[2 * i]), r = halved(v[2 * i + 1]);
        a[i] = __builtin_shuffle(l, r, Lanes{0, 8, 2, 10, 4, 12, 6, 14}) + __builtin_shuffle(l, r, Lanes{1, 9, 3, 11, 5, 13, 7, 15});
    }
    for (int i = 0; i < 2; i++) {
        Eight l = a[2 * i], r = a[2 * i + 1];
        b[i] = __builtin_shuffle(l, r, Lanes{0, 1, 8, 9, 4, 5, 12, 13}) + __builtin_shuffle(l, r, Lanes{2, 3, 10, 11, 6, 7, 14, 15});
    }
    Eight all = __builtin_shuffle(b[0], b[1], Lanes{0, 1, 2, 3, 8, 9, 10, 11}) + __builtin_shuffle(b[0], b[1], Lanes{4, 5, 6, 7, 12, 13, 14, 15});
    memcpy(out, &all, sizeof all);
}

// 2^x for |x| < 120, relative error 2e-7: round by adding 1.5 * 2^23, a degree-5 polynomial on [-1/2, 1/2], then add the
// integer part to the exponent bits. -ffast-math would fold the rounding away.
static inline Floats exp2(Floats x) {
    const float rounder = 12582912.f;
    Floats shifted = x + rounder, f = x - (shifted - rounder);
    Ints whole = (Ints)shifted;
    Floats p = splat(1.3333558e-3f);
    p = p * f + 9.6181291e-3f;
    p = p * f + 5.5504109e-2f;
    p = p * f + 2.4022651e-1f;
    p = p * f + 6.9314718e-1f;
    p = p * f + 1.0f;
    return (Floats)((Ints)p + (whole << 23));
}

// log2(x) for normal x > 0, absolute error 2e-7: mantissa into [sqrt(1/2), sqrt(2)), then the atanh series.
static inline Floats log2(Floats x) {
    Ints bits = (Ints)x, exponent = (bits - 0x3f3504f3) >> 23;
    Floats f = (Floats)(bits - (exponent << 23)) - 1.f, s = f / (f + 2.f), z = s * s;
    Floats p = splat(0.22222222f);
    p = p * z + 0.28571429f;
    p = p * z + 0.4f;
    p = p * z + 0.66666667f;
    p = p * z + 2.f;
    return __builtin_convertvector(exponent, Floats) + s * p * LOG2_E;
}
