// How far the trajectories of consecutive frames are from joining up, with the gradient; see rs_continuity. In double.
#include <algorithm>
#include <cmath>
#include <vector>

#include "layout.h"
#include "vector3.h"

namespace {

constexpr int CHANNELS = JOINTS + 1;
constexpr double TINY = 1e-20;  // added to a squared length before its root: the gradient of a length stays finite at 0

struct Gap {
    double length;
    V3 first, second;  // its gradient
};

Gap distance(V3 a, V3 b) {
    const V3 d = a - b;
    const double length = std::sqrt(dot(d, d) + TINY);
    return {length, 1. / length * d, -1. / length * d};
}

// Unit quaternion of an axis-angle vector r: (cos h, s r), h = |r| / 2, s = sin h / |r|; and ds/dr = slope r.
struct Half {
    double c, s, slope;
    V3 r, v;
};

Half half(V3 r) {
    const double t2 = dot(r, r), t = std::sqrt(t2), h = t / 2, c = std::cos(h);
    const double s = t < 1e-8 ? 0.5 : std::sin(h) / t;
    return {c, s, t < 1e-2 ? -1. / 24. + t2 / 960. : (c / 2 - s) / t2, r, s * r};
}

// dL/dr from dL/dc and dL/dv: dc = -s r.dr / 2, dv = s dr + slope r (r.dr).
V3 backward(const Half &q, double gc, V3 gv) { return (q.slope * dot(q.r, gv) - gc * q.s / 2) * q.r + q.s * gv; }

// Angle between exp(a) and exp(b): twice that of their quaternions, whose relative rotation is (c, w).
Gap angle(V3 a, V3 b) {
    const Half p = half(a), q = half(b);
    const V3 w = p.c * q.v - q.c * p.v - cross(p.v, q.v);
    const double c = p.c * q.c + dot(p.v, q.v), sine = std::sqrt(dot(w, w) + TINY);
    const double gc = c < 0 ? 2 * sine : -2 * sine;
    const V3 gw = 2 * std::fabs(c) / sine * w;
    return {2 * std::atan2(sine, std::fabs(c)), backward(p, gc * q.c + dot(gw, q.v), gc * q.v - q.c * gw - cross(q.v, gw)),
            backward(q, gc * p.c - dot(gw, p.v), gc * p.v + p.c * gw - cross(gw, p.v))};
}

}  // namespace

double rs_continuity(const float *control, int frames, int points, const double *ends, const double *meeting, int translation,
                     int threads, float *gradient) {
    const size_t frame = (size_t)points * CHANNELS * 3;
    std::vector<double> sums(CHANNELS);  // each channel is one thread's, and they are added in order
    std::fill(gradient, gradient + frames * frame, 0.f);
#pragma omp parallel for schedule(static) num_threads(threads)
    for (int j = 0; j < CHANNELS; j++) {
        if (j == JOINTS && !translation) continue;
        auto at = [&](int n, const double *weights) {
            V3 v = {};
            for (int p = 0; p < points; p++) {
                const float *c = control + n * frame + (p * CHANNELS + j) * 3;
                v = v + weights[p] * V3{c[0], c[1], c[2]};
            }
            return v;
        };
        auto add = [&](int n, const double *weights, V3 g) {
            for (int p = 0; p < points; p++) {
                float *c = gradient + n * frame + (p * CHANNELS + j) * 3;
                c[0] += weights[p] * g.x, c[1] += weights[p] * g.y, c[2] += weights[p] * g.z;
            }
        };
        for (int n = 0; n + 1 < frames; n++) {
            const double weight = j == JOINTS ? meeting[n] : meeting[n] / JOINTS;
            if (weight == 0.) continue;
            const V3 last = at(n, ends), first = at(n + 1, ends + points);
            const Gap gap = j == JOINTS ? distance(last, first) : angle(last, first);
            sums[j] += weight * gap.length;
            add(n, ends, weight * gap.first), add(n + 1, ends + points, weight * gap.second);
        }
    }
    double sum = 0.;
    for (double s : sums) sum += s;
    return sum;
}
