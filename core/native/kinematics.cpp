// Forward kinematics: joint angles to world transforms, and back. In double: a chain of nine products, a few hundred
// numbers, and no time worth saving.
#include <cmath>

#include "layout.h"
#include "vector3.h"

namespace {

constexpr double TINY = 1e-8;  // angle under which the exponential's coefficients are taken from their series

struct M3 {
    double m[9];
};

V3 read(const float *p) { return {p[0], p[1], p[2]}; }
void add(float *p, const V3 &v) { p[0] += v.x, p[1] += v.y, p[2] += v.z; }
V3 mul(const M3 &a, V3 v) {
    const double *m = a.m;
    return {m[0] * v.x + m[1] * v.y + m[2] * v.z, m[3] * v.x + m[4] * v.y + m[5] * v.z, m[6] * v.x + m[7] * v.y + m[8] * v.z};
}
M3 transposed(const M3 &a) {
    const double *m = a.m;
    return {{m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]}};
}
M3 operator*(const M3 &a, const M3 &b) {
    M3 c;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) c.m[3 * i + j] = a.m[3 * i] * b.m[j] + a.m[3 * i + 1] * b.m[3 + j] + a.m[3 * i + 2] * b.m[6 + j];
    return c;
}
void accumulate(M3 &a, const M3 &b) {
    for (int i = 0; i < 9; i++) a.m[i] += b.m[i];
}
M3 outer(V3 a, V3 b) { return {{a.x * b.x, a.x * b.y, a.x * b.z, a.y * b.x, a.y * b.y, a.y * b.z, a.z * b.x, a.z * b.y, a.z * b.z}}; }

// exp on SO(3): I + a [r] + b [r]^2, a = sin t / t, b = (1 - cos t) / t^2
M3 exponential(V3 r) {
    double t2 = dot(r, r), t = std::sqrt(t2);
    double a = t < TINY ? 1. : std::sin(t) / t, b = t < TINY ? 0.5 : 2. * std::pow(std::sin(0.5 * t) / t, 2);
    return {{1. - b * (r.y * r.y + r.z * r.z), b * r.x * r.y - a * r.z, b * r.x * r.z + a * r.y,
             b * r.x * r.y + a * r.z, 1. - b * (r.x * r.x + r.z * r.z), b * r.y * r.z - a * r.x,
             b * r.x * r.z - a * r.y, b * r.y * r.z + a * r.x, 1. - b * (r.x * r.x + r.y * r.y)}};
}

// dL/dr from dL/dE, E = exp(r): dE = [J dr] E with the left Jacobian J = I + b [r] + c [r]^2, c = (t - sin t) / t^3.
V3 exponential_backward(V3 r, const M3 &E, const M3 &gE) {
    const M3 m = gE * transposed(E);
    const V3 v = {m.m[7] - m.m[5], m.m[2] - m.m[6], m.m[3] - m.m[1]};
    double t2 = dot(r, r), t = std::sqrt(t2);
    double b = t < TINY ? 0.5 : 2. * std::pow(std::sin(0.5 * t) / t, 2);
    double c = t < 1e-3 ? 1. / 6. - t2 / 120. : (t - std::sin(t)) / (t2 * t);
    const V3 rv = cross(r, v);
    return v - b * rv + c * cross(r, rv);  // J^T v
}

struct Chain {
    M3 angle[JOINTS], residual[JOINTS], local[JOINTS], world[JOINTS];
    V3 place[JOINTS];
};

// W_0 = R(Rh), P_0 = R(Rh) J_0 + Th; W_j = W_p R_j, P_j = P_p + W_p (J_j - J_p), R_j = exp(angle_j) exp(residual_j)
void walk(const RsBody &body, int b, Chain &c) {
    c.world[0] = exponential(read(body.root_rotation + 3 * b));
    c.place[0] = mul(c.world[0], read(body.rest_joints)) + read(body.root_translation + 3 * b);
    for (int j = 1; j < JOINTS; j++) {
        const int p = body.parents[j];
        const size_t at = ((size_t)b * JOINTS + j) * 3;
        c.local[j] = c.angle[j] = exponential(read(body.angles + at));
        if (body.residuals) c.residual[j] = exponential(read(body.residuals + at)), c.local[j] = c.angle[j] * c.residual[j];
        c.world[j] = c.world[p] * c.local[j];
        c.place[j] = c.place[p] + mul(c.world[p], read(body.rest_joints + 3 * j) - read(body.rest_joints + 3 * p));
    }
}

}  // namespace

void rs_pose(const RsBody *body, int states, float *transforms) {
    for (int b = 0; b < states; b++) {
        Chain c;
        walk(*body, b, c);
        for (int j = 0; j < JOINTS; j++) {
            float *out = transforms + ((size_t)b * JOINTS + j) * 12;
            const V3 shift = c.place[j] - mul(c.world[j], read(body->rest_joints + 3 * j));
            for (int r = 0; r < 3; r++)
                for (int k = 0; k < 3; k++) out[4 * r + k] = (float)c.world[j].m[3 * r + k];
            out[3] = (float)shift.x, out[7] = (float)shift.y, out[11] = (float)shift.z;
        }
    }
}

void rs_pose_backward(const RsBody *body, int states, const float *grad_transforms, float *grad_angles, float *grad_residuals,
                      float *grad_root_rotation, float *grad_root_translation, float *grad_rest_joints) {
    for (int b = 0; b < states; b++) {
        Chain c;
        walk(*body, b, c);
        M3 gW[JOINTS] = {};
        V3 gP[JOINTS] = {};
        for (int j = 0; j < JOINTS; j++) {  // transform = [W | P - W J]
            const float *g = grad_transforms + ((size_t)b * JOINTS + j) * 12;
            const V3 shift = {g[3], g[7], g[11]}, J = read(body->rest_joints + 3 * j);
            const M3 through_shift = outer(shift, J);
            for (int r = 0; r < 3; r++)
                for (int k = 0; k < 3; k++) gW[j].m[3 * r + k] = g[4 * r + k] - through_shift.m[3 * r + k];
            gP[j] = shift;
            add(grad_rest_joints + 3 * j, -1. * mul(transposed(c.world[j]), shift));
        }
        for (int j = JOINTS - 1; j > 0; j--) {
            const int p = body->parents[j];
            const size_t at = ((size_t)b * JOINTS + j) * 3;
            const M3 up = transposed(c.world[p]), gR = up * gW[j];
            accumulate(gW[p], gW[j] * transposed(c.local[j]));
            accumulate(gW[p], outer(gP[j], read(body->rest_joints + 3 * j) - read(body->rest_joints + 3 * p)));
            gP[p] = gP[p] + gP[j];
            const V3 gJ = mul(up, gP[j]);
            add(grad_rest_joints + 3 * j, gJ), add(grad_rest_joints + 3 * p, -1. * gJ);
            M3 g_angle = gR;
            if (body->residuals) {
                g_angle = gR * transposed(c.residual[j]);
                add(grad_residuals + at, exponential_backward(read(body->residuals + at), c.residual[j], transposed(c.angle[j]) * gR));
            }
            add(grad_angles + at, exponential_backward(read(body->angles + at), c.angle[j], g_angle));
        }
        accumulate(gW[0], outer(gP[0], read(body->rest_joints)));
        add(grad_rest_joints, mul(transposed(c.world[0]), gP[0]));
        add(grad_root_translation + 3 * b, gP[0]);
        add(grad_root_rotation + 3 * b, exponential_backward(read(body->root_rotation + 3 * b), c.world[0], gW[0]));
    }
}
