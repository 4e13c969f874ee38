// A block of LANES Gaussians, posed and projected: what the forward and the backward pass both need.
#pragma once
#include "frame.h"

// LANES Gaussians. Mostly a window of consecutive ids, read and written as vectors, whose lanes need not all be alive;
// where survivors are sparse, the next survivors, gathered.
struct Block {
    int32_t ids[LANES], survivors[LANES];  // survivors: index into Slot::ids, of lanes that are alive
    Ints live;
    int used;  // survivors taken from the list
    bool window;

    Block(int first, int count) : live(Ints{} - 1), used(0), window(first + LANES <= count) {  // all of [first, count)
        for (int i = 0; i < LANES; i++) ids[i] = first + i < count ? first + i : count - 1;
    }
    // Of the survivors list[first, last), as many as fit; `count` Gaussians in all.
    Block(const int32_t *list, int first, int last, int count) : live{}, used(0) {
        const int half = LANES / 2;
        window = first + half <= last && list[first + half - 1] - list[first] < LANES && list[first] + LANES <= count;
        for (; used < LANES && first + used < last; used++) {
            const int lane = window ? list[first + used] - list[first] : used;
            if (lane >= LANES) break;
            live[lane] = -1, survivors[lane] = first + used, ids[lane] = list[first + used];
        }
        for (int i = 0; i < LANES; i++)
            if (window) ids[i] = list[first] + i;
            else if (!live[i]) ids[i] = ids[0];
    }
    Floats get(const float *p) const {
        if (window) return load(p + ids[0]);
        Floats v;
        for (int i = 0; i < LANES; i++) v[i] = p[ids[i]];
        return v;
    }
    void add(float *p, Floats v) const {
        if (window) return store(p + ids[0], load(p + ids[0]) + keep(live, v));
        for (int i = 0; i < used; i++) p[ids[i]] += v[i];
    }
};

struct Vec3 {
    Floats x, y, z;
};
static inline Floats dot(const Vec3 &a, const Vec3 &b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
static inline Vec3 operator+(const Vec3 &a, const Vec3 &b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
static inline Vec3 operator-(const Vec3 &a, const Vec3 &b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
static inline Vec3 operator*(const Vec3 &a, Floats s) { return {a.x * s, a.y * s, a.z * s}; }
static inline Vec3 cross(const Vec3 &a, const Vec3 &b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

struct Mat3 {  // rows
    Vec3 r[3];
};
static inline Vec3 mul(const Mat3 &m, const Vec3 &v) { return {dot(m.r[0], v), dot(m.r[1], v), dot(m.r[2], v)}; }
static inline Vec3 mul_transposed(const Mat3 &m, const Vec3 &v) { return m.r[0] * v.x + m.r[1] * v.y + m.r[2] * v.z; }

// The camera's rotation is one for all lanes.
static inline Vec3 to_camera(const RsCamera &c, const Vec3 &v) {
    const float *R = c.rotation;
    return {v.x * R[0] + v.y * R[1] + v.z * R[2], v.x * R[3] + v.y * R[4] + v.z * R[5], v.x * R[6] + v.y * R[7] + v.z * R[8]};
}
static inline Vec3 from_camera(const RsCamera &c, const Vec3 &v) {
    const float *R = c.rotation;
    return {v.x * R[0] + v.y * R[3] + v.z * R[6], v.x * R[1] + v.y * R[4] + v.z * R[7], v.x * R[2] + v.y * R[5] + v.z * R[8]};
}

// Blended pose polynomial of the block: c[d] is the 3x4 coefficient of tau^d, row-major (paper, eq. lbs).
struct Blend {
    Floats c[MAX_COEFFICIENTS][12];
};

static inline void blend_pose(const Block &block, const RsGaussians &g, const float *pose, int D, Blend &out) {
    Floats weights[JOINTS];
    int joints[JOINTS], used = 0;  // most blocks are bound to two or three
    for (int j = 0; j < JOINTS; j++) {
        Floats w = block.get(g.skin_weights + (size_t)j * g.count);
        if (any(w != 0.f)) weights[used] = w, joints[used++] = j;
    }
    for (int d = 0; d < D; d++) {
        Floats c[12] = {};
        for (int k = 0; k < used; k++) {
            const float *a = pose + ((size_t)d * JOINTS + joints[k]) * 12;
            for (int m = 0; m < 12; m++) c[m] += weights[k] * a[m];
        }
        for (int m = 0; m < 12; m++) out.c[d][m] = c[m];
    }
}

// The transform B(tau), its derivative, and the mean that it carries to the image.
struct Posed {
    Floats B[12], Bd[12];
    Vec3 world, camera, velocity;  // mean in the world and in the camera; d camera / d tau
    Floats iz, xz, yz;             // 1/Z, X/Z, Y/Z
    Floats u, v, ud, vd;           // pixel and d pixel / d tau
    Ints in_front;

    Mat3 linear() const { return {{{B[0], B[1], B[2]}, {B[4], B[5], B[6]}, {B[8], B[9], B[10]}}}; }
    Mat3 linear_rate() const { return {{{Bd[0], Bd[1], Bd[2]}, {Bd[4], Bd[5], Bd[6]}, {Bd[8], Bd[9], Bd[10]}}}; }
};

static inline void pose_at(const Blend &blend, int D, Floats tau, const Vec3 &x, const RsCamera &cam, float near, Posed &o) {
    for (int m = 0; m < 12; m++) {  // Horner, value and derivative together
        Floats b = blend.c[D - 1][m], bd = {};
        for (int d = D - 2; d >= 0; d--) {
            bd = bd * tau + b;
            b = b * tau + blend.c[d][m];
        }
        o.B[m] = b, o.Bd[m] = bd;
    }
    o.world = mul(o.linear(), x) + Vec3{o.B[3], o.B[7], o.B[11]};
    Vec3 world_rate = mul(o.linear_rate(), x) + Vec3{o.Bd[3], o.Bd[7], o.Bd[11]};
    const float *t = cam.translation;
    o.camera = to_camera(cam, o.world) + Vec3{splat(t[0]), splat(t[1]), splat(t[2])};
    o.velocity = to_camera(cam, world_rate);
    o.in_front = o.camera.z >= near;
    o.iz = 1.f / select(o.in_front, o.camera.z, splat(near));  // finite arithmetic also for lanes that will be culled
    o.xz = o.camera.x * o.iz, o.yz = o.camera.y * o.iz;
    o.u = o.xz * cam.fx + cam.cx, o.v = o.yz * cam.fy + cam.cy;
    o.ud = (o.velocity.x - o.xz * o.velocity.z) * o.iz * cam.fx;
    o.vd = (o.velocity.y - o.yz * o.velocity.z) * o.iz * cam.fy;
}

// 1 - rate * dv/dtau: 0 at scan speed, where a point moves along with the row that is read. Its own time and its shear are first-order
// terms over this slack, which hold no longer where it is small, so it is held at this size: a tenth keeps one such Gaussian from
// outweighing all others in a gradient (docs/decisions/0019).
constexpr float LEAST_SLACK = 0.1f;

static inline Floats scan_slack(float rate, Floats vd, float least = LEAST_SLACK) {
    Floats s = 1.f - vd * rate;
    return select((s < least) & (s > -least), select(s < 0.f, splat(-least), splat(least)), s);
}

// Covariance factor and conic of the footprint.
struct Footprint {
    Floats inverse_norm;       // of the quaternion
    Floats q[4];               // unit quaternion
    Vec3 scale;
    Mat3 R, RS, M;             // rotation; rotation * scale; posed: B_linear R S
    Vec3 g0, g1;               // rows of the projection's Jacobian in the world, J R_cam
    Vec3 k0, k1;               // rows of K = J R_cam M; Sigma = K K^T + dilation I
    Floats sxx, sxy, syy;      // Sigma
    // d^T Sigma^-1 d = A (dx - r dy)^2 + dy^2 / syy: a sum of squares, where A dx^2 + 2 B dx dy + C dy^2 of a needle
    // cancels. r = sxy / syy; A = syy / det(Sigma).
    Floats A, r, inverse_syy;
    Floats jx, jy, jxz, jyz;   // fx/Z, fy/Z, -fx X/Z^2, -fy Y/Z^2
};

static inline Mat3 rotation_of(const Floats q[4]) {
    Floats w = q[0], x = q[1], y = q[2], z = q[3];
    return {{{1.f - 2.f * (y * y + z * z), 2.f * (x * y - w * z), 2.f * (x * z + w * y)},
             {2.f * (x * y + w * z), 1.f - 2.f * (x * x + z * z), 2.f * (y * z - w * x)},
             {2.f * (x * z - w * y), 2.f * (y * z + w * x), 1.f - 2.f * (x * x + y * y)}}};
}

static inline Vec3 times_columns(const Vec3 &row, const Mat3 &m) { return mul_transposed(m, row); }

static inline void footprint(const Block &block, const RsGaussians &g, const Posed &p, const RsCamera &cam, float eps, Footprint &f) {
    size_t M = g.count;
    Floats n2 = splat(1e-30f);  // a zero quaternion stays finite
    for (int i = 0; i < 4; i++) f.q[i] = block.get(g.rotations + i * M), n2 += f.q[i] * f.q[i];
    f.inverse_norm = 1.f / square_root(n2);
    for (int i = 0; i < 4; i++) f.q[i] *= f.inverse_norm;
    f.R = rotation_of(f.q);
    Floats *s = &f.scale.x;  // e^ls within [e^-30, e^6] metres: neither denormal nor overflowing when squared
    for (int i = 0; i < 3; i++) s[i] = exp2(clamp(block.get(g.log_scales + i * M), -30.f, 6.f) * LOG2_E);
    Mat3 L = p.linear();
    for (int i = 0; i < 3; i++) f.RS.r[i] = {f.R.r[i].x * s[0], f.R.r[i].y * s[1], f.R.r[i].z * s[2]};
    for (int i = 0; i < 3; i++) f.M.r[i] = times_columns(L.r[i], f.RS);
    f.jx = p.iz * cam.fx, f.jy = p.iz * cam.fy, f.jxz = -f.jx * p.xz, f.jyz = -f.jy * p.yz;
    f.g0 = from_camera(cam, {f.jx, Floats{}, f.jxz});
    f.g1 = from_camera(cam, {Floats{}, f.jy, f.jyz});
    f.k0 = times_columns(f.g0, f.M), f.k1 = times_columns(f.g1, f.M);
    f.sxx = dot(f.k0, f.k0) + eps, f.syy = dot(f.k1, f.k1) + eps, f.sxy = dot(f.k0, f.k1);
    // ac - b^2 cancels on needles; |k0 x k1|^2 + eps tr + eps^2 does not, and is never negative
    Vec3 n = cross(f.k0, f.k1);
    Floats inverse = 1.f / (dot(n, n) + eps * (f.sxx + f.syy - eps));
    f.inverse_syy = 1.f / f.syy;
    f.A = f.syy * inverse, f.r = f.sxy * f.inverse_syy;
}

// Real spherical harmonics of degree <= 1 in direction d (3D Gaussian splatting's signs).
constexpr float SH0 = 0.28209479177387814f, SH1 = 0.4886025119029199f;

struct Shading {
    Vec3 direction;
    Floats inverse_distance;
    Floats basis[4];
    Floats colour[3];  // before the clamp at 0
};

static inline void shade(const Block &block, const RsGaussians &g, const Posed &p, const RsCamera &cam, Shading &s) {
    const float *R = cam.rotation, *t = cam.translation;
    float centre[3];
    for (int i = 0; i < 3; i++) centre[i] = -(R[i] * t[0] + R[3 + i] * t[1] + R[6 + i] * t[2]);
    Vec3 d = p.world - Vec3{splat(centre[0]), splat(centre[1]), splat(centre[2])};
    s.inverse_distance = 1.f / square_root(dot(d, d) + 1e-12f);
    s.direction = d * s.inverse_distance;
    s.basis[0] = splat(SH0), s.basis[1] = s.direction.y * -SH1, s.basis[2] = s.direction.z * SH1, s.basis[3] = s.direction.x * -SH1;
    for (int k = 0; k < 3; k++) {
        s.colour[k] = splat(0.5f);
        for (int b = 0; b < g.bases; b++) s.colour[k] += s.basis[b] * block.get(g.sh + ((size_t)b * 3 + k) * g.count);
    }
}
