// Adam (Kingma and Ba, 2015) on a list of parameters, in one pass: what torch does in a dozen calls.
#include <algorithm>
#include <new>
#include <vector>

#include "layout.h"
#include "simd.h"

constexpr int64_t PIECE = 1 << 13;  // floats that a thread takes at a time: with its moments and gradient, in L2

struct Piece {
    int parameter;
    int64_t begin, end;
};

static std::vector<Piece> pieces_of(const RsParameter *parameters, int count) {
    std::vector<Piece> pieces;
    for (int i = 0; i < count; i++)
        for (int64_t begin = 0; begin < parameters[i].size; begin += PIECE)
            pieces.push_back({i, begin, std::min(begin + PIECE, parameters[i].size)});
    return pieces;
}

static bool finite(const float *p, int64_t n) {
    const int32_t exponent = 0x7f800000;  // all its bits are set in NaN and infinity, and in nothing else
    Ints bad = {};
    int64_t i = 0;
    for (; i + LANES <= n; i += LANES) bad |= ((Ints)load(p + i) & exponent) == exponent;
    for (; i < n; i++) bad[0] |= -!std::isfinite(p[i]);
    return !any(bad);
}

static void advance(const RsParameter &p, const Piece &piece, float beta1, float beta2, float epsilon) {
    // m / (1 - beta1^t) / (sqrt(v / (1 - beta2^t)) + epsilon)
    const double correction1 = 1 - std::pow((double)beta1, p.step), correction2 = 1 - std::pow((double)beta2, p.step);
    const float pace = p.rate / correction1, root = 1 / std::sqrt(correction2);
    for (int64_t i = piece.begin; i < piece.end; i++) {
        float g = p.gradient[i], m = p.mean[i] + (1 - beta1) * (g - p.mean[i]), v = beta2 * p.square[i] + (1 - beta2) * (g * g);
        p.mean[i] = m, p.square[i] = v;
        p.value[i] -= pace * m / (std::sqrt(v) * root + epsilon);
    }
}

int rs_adam(const RsParameter *parameters, int count, float beta1, float beta2, float epsilon, int threads) try {
    const std::vector<Piece> pieces = pieces_of(parameters, count);
    const int n = pieces.size();
    int broken = 0;
#pragma omp parallel for schedule(static) num_threads(threads) reduction(| : broken)
    for (int k = 0; k < n; k++) broken |= !finite(parameters[pieces[k].parameter].gradient + pieces[k].begin, pieces[k].end - pieces[k].begin);
    if (broken) return 3;
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int k = 0; k < n; k++)
        if (parameters[pieces[k].parameter].value) advance(parameters[pieces[k].parameter], pieces[k], beta1, beta2, epsilon);
    return 0;
} catch (const std::bad_alloc &) {
    return 1;
}
