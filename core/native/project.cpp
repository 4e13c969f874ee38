// From canonical Gaussians to splats: skin, find each Gaussian's own time, project, shade.
#include <algorithm>

#include "geometry.h"

// Own time of a mean: Newton on f(tau) = tau - (rate v(tau) + start). The row moves almost linearly in tau, so three
// steps leave less than 1e-5 px. The polynomial must not extrapolate: tau stays within [-1, 1].
static Floats own_time(const Blend &blend, int D, const Vec3 &x, const RsRows &rows, const RsCamera &cam, float near) {
    Floats y[MAX_COEFFICIENTS], z[MAX_COEFFICIENTS];  // camera-space coefficients; the row needs no others
    const float *R = cam.rotation;
    for (int d = 0; d < D; d++) {
        const Floats *b = blend.c[d];
        Vec3 p = {b[0] * x.x + b[1] * x.y + b[2] * x.z + b[3], b[4] * x.x + b[5] * x.y + b[6] * x.z + b[7],
                  b[8] * x.x + b[9] * x.y + b[10] * x.z + b[11]};
        y[d] = p.x * R[3] + p.y * R[4] + p.z * R[5], z[d] = p.x * R[6] + p.y * R[7] + p.z * R[8];
    }
    y[0] += cam.translation[1], z[0] += cam.translation[2];
    Floats tau = {};
    for (int step = 0; step < 3; step++) {
        Floats Y = y[D - 1], Z = z[D - 1], Yd = {}, Zd = {};
        for (int d = D - 2; d >= 0; d--) Yd = Yd * tau + Y, Zd = Zd * tau + Z, Y = Y * tau + y[d], Z = Z * tau + z[d];
        Floats iz = 1.f / select(Z >= near, Z, splat(near));
        Floats v = Y * iz * cam.fy + cam.cy, vd = (Yd - Y * iz * Zd) * iz * cam.fy;
        tau = clamp(tau - (tau - (v * rows.rate + rows.start)) / scan_slack(rows.rate, vd, 1e-2f), -1.f, 1.f);
    }
    return tau;
}

static Vec3 mean_of(const Block &block, const RsGaussians &g) {
    size_t M = g.count;
    return {block.get(g.means), block.get(g.means + M), block.get(g.means + 2 * M)};
}

// log2 of sigmoid(x), and the sigmoid: the logit is kept where the exponential neither overflows nor vanishes.
static void opacity_of(Floats logit, Floats &opacity, Floats &log2_opacity) {
    opacity = 1.f / (1.f + exp2(clamp(logit, -80.f, 80.f) * -LOG2_E));
    log2_opacity = log2(opacity);
}

// Where every number that a Gaussian consists of, its pose's among them, is finite. By the sum's exponent bits: GCC folds
// arithmetic that is meant to tell NaN.
static Ints finite(const Block &block, const RsGaussians &g, const Posed &p, const Footprint &f, const Shading &s) {
    size_t M = g.count;
    Floats all = p.world.x + p.world.y + p.world.z + p.velocity.x + p.velocity.y + p.velocity.z + block.get(g.opacity_logits);
    for (int i = 0; i < 4; i++) all += f.q[i];
    for (int i = 0; i < 3; i++) all += block.get(g.log_scales + i * M) + s.colour[i];
    all += block.get(g.screen) + block.get(g.screen + M);
    return ((Ints)all & 0x7f800000) != 0x7f800000;
}

// Index of the first pixel whose centre is not before `edge`, within [lo, hi].
static Floats first_centre(Floats edge, float lo, float hi) { return round_up(clamp(edge - 0.5f, lo, hi)); }

static void project_block(const RsFrame &frame, const RsGaussians &g, const float *pose, int first, const Slot &slot, Splat *projected) {
    const RsCamera &cam = frame.camera;
    const RsOptions &o = frame.options;
    int D = frame.coefficients;
    Block block(first, g.count);
    Blend blend;
    blend_pose(block, g, pose, D, blend);
    Vec3 x = mean_of(block, g);
    Floats tau = slot.rows.rate != 0.f ? own_time(blend, D, x, slot.rows, cam, o.near) : splat(slot.rows.start);
    Posed p;
    pose_at(blend, D, tau, x, cam, o.near, p);
    Footprint f;
    footprint(block, g, p, cam, o.dilation, f);
    Shading s;
    shade(block, g, p, cam, s);
    Floats opacity, log2_opacity;
    opacity_of(block.get(g.opacity_logits), opacity, log2_opacity);

    // Within the footprint the mean moves (a, b) pixels per row: the conic is sheared, and so is its box.
    float moving = o.flags & RS_NO_SHEAR ? 0.f : slot.rows.rate;
    Floats a = p.ud * moving, slack = scan_slack(moving, p.vd), shear = a / slack;
    Floats reach = maximum((log2_opacity - log2(splat(o.alpha_min))) * (2.f / LOG2_E) * 1.0001f + 1e-4f, Floats{});
    Floats half_x = square_root(reach * maximum(f.sxx + 2.f * shear * f.sxy + shear * shear * f.syy, Floats{}));
    Floats half_y = square_root(reach * f.syy) / maximum(slack, -slack);

    const Floats u = p.u + block.get(g.screen), v = p.v + block.get(g.screen + g.count);
    const Floats qxx = f.A * (-0.5f * LOG2_E), tilt = -(slack * f.r + a), qyy = slack * slack * f.inverse_syy * (-0.5f * LOG2_E);
    // Who can reach a pixel of the slot. Comparisons are written so that NaN is dropped.
    const float top = slot.rows.lo, bottom = slot.rows.hi, width = cam.width;
    const Ints seen = p.in_front & (log2_opacity > log2(splat(o.alpha_min))) & (qxx <= 0.f) & (v + half_y > top) & (v - half_y < bottom) &
                      (u + half_x > 0.f) & (u - half_x < width);
    const Ints sound = finite(block, g, p, f, s);
    const Floats x_lo = first_centre(u - half_x, 0.f, width), x_hi = first_centre(u + half_x, 0.f, width);
    const Floats y_lo = first_centre(v - half_y, top, bottom), y_hi = first_centre(v + half_y, top, bottom);
    for (int i = 0; i < LANES; i++) {
        Splat &out = projected[i];
        out.u = u[i], out.v = v[i], out.qxx = qxx[i], out.tilt = tilt[i], out.qyy = qyy[i], out.log2_opacity = log2_opacity[i];
        out.r = std::max(s.colour[0][i], 0.f), out.g = std::max(s.colour[1][i], 0.f), out.b = std::max(s.colour[2][i], 0.f);
        out.x_lo = x_lo[i], out.x_hi = x_hi[i], out.y_lo = y_lo[i], out.y_hi = y_hi[i];
        out.depth = p.camera.z[i], out.depth_rate = p.velocity.z[i], out.tau = tau[i];
        out.fate = first + i >= g.count ? ABSENT : !sound[i] ? BROKEN : seen[i] ? SURVIVES : UNSEEN;
    }
}

void project(const RsFrame &frame, const RsGaussians &g, const float *pose, const Slot &slot, const int32_t *blocks, int count, Splat *projected) {
    for (int k = 0; k < count; k++) project_block(frame, g, pose, blocks[k], slot, projected + (size_t)k * LANES);
}

// ---- backward ---------------------------------------------------------------------------------------------------------

// Gradients of what the rasteriser saw: from moments of g = dL/dalpha * alpha over the splat's pixels.
struct SplatGradient {
    Floats u, v, A, tilt, S, logit, colour[3];  // log alpha = -(A (dx + tilt dy)^2 + S dy^2) / 2
};

// Sums `scale` times the moments of each lane's splat over its strips, in order. False where nothing of the block reached a
// pixel.
static bool gather_moments(const Slot &slot, const Block &block, float scale, float out[MOMENTS][LANES]) {
    constexpr int WIDTH = 16 / LANES;  // vectors in a pair's row of 16
    Ints seen = {};
    for (int lane = 0; lane < LANES; lane++) {
        Floats sums[WIDTH] = {};
        if (block.live[lane]) {
            const int k = block.survivors[lane];
            for (int pair = slot.first_pair[k]; pair < slot.first_pair[k + 1]; pair++)
                for (int i = 0; i < WIDTH; i++) sums[i] += load(&slot.moments[(size_t)pair * 16 + i * LANES]);
        }
        for (int i = 0; i < WIDTH; i++) seen |= sums[i] != 0.f;
        for (int m = 0; m < MOMENTS; m++) out[m][lane] = scale * sums[m / LANES][m % LANES];
    }
    return any(seen);
}

static SplatGradient splat_gradient(const float m[MOMENTS][LANES], Floats A, Floats tilt, Floats S, Floats opacity) {
    SplatGradient s;
    s.u = A * load(m[MX]), s.v = tilt * s.u + S * load(m[MY]);
    s.A = load(m[MXX]) * -0.5f, s.tilt = -A * load(m[MXY]), s.S = load(m[MYY]) * -0.5f;
    s.logit = load(m[M0]) * (1.f - opacity);
    for (int k = 0; k < 3; k++) s.colour[k] = load(m[MR + k]);
    return s;
}

// What flows back to the posed Gaussian.
struct PosedGradient {
    Vec3 camera, velocity;  // dL / d camera-space mean, and its rate
    Vec3 world;             // dL / d world mean, directly (from the view direction)
    Mat3 M;                 // dL / d (B_linear R S)
};

// Through the shear (a, slack), the conic, the projected covariance and the projection.
static PosedGradient through_projection(SplatGradient s, const Posed &p, const Footprint &f, const RsCamera &cam, float rate) {
    // tilt = -(slack r + a), S = slack^2 / syy, a = rate ud, slack = 1 - rate vd
    Floats slack = scan_slack(rate, p.vd), gr = -slack * s.tilt, gS = slack * slack * s.S;
    const Ints free = (slack > LEAST_SLACK) | (slack < -LEAST_SLACK);
    Floats gud = s.tilt * -rate, gvd = keep(free, (f.r * s.tilt - 2.f * slack * f.inverse_syy * s.S) * rate);
    // dr = (dsxy - r dsyy) / syy, d(1/A) = dsxx - 2 r dsxy + r^2 dsyy, gathered around e = k0 - r k1, which is small on needles
    Vec3 e = f.k0 - f.k1 * f.r;
    Floats of_e = -2.f * f.A * f.A * s.A, of_r = gr * f.inverse_syy;
    Vec3 gk0 = e * of_e + f.k1 * of_r;
    Vec3 gk1 = e * (of_r - f.r * of_e) - f.k1 * (f.r * of_r + 2.f * gS * f.inverse_syy * f.inverse_syy);
    PosedGradient out;
    const Floats *a0 = &f.g0.x, *a1 = &f.g1.x;
    for (int i = 0; i < 3; i++) out.M.r[i] = gk0 * a0[i] + gk1 * a1[i];
    Vec3 gg0 = to_camera(cam, mul(f.M, gk0)), gg1 = to_camera(cam, mul(f.M, gk1));  // of (jx, 0, jxz) and (0, jy, jyz)
    Floats gjx = gg0.x, gjxz = gg0.z, gjy = gg1.y, gjyz = gg1.z;
    // u = fx X/Z + cx, jx = fx/Z, jxz = -fx X/Z^2; the same in y
    out.camera.x = (s.u - gjxz * p.iz) * f.jx;
    out.camera.y = (s.v - gjyz * p.iz) * f.jy;
    out.camera.z = s.u * f.jxz + s.v * f.jyz - (gjx * f.jx + gjy * f.jy + 2.f * (gjxz * f.jxz + gjyz * f.jyz)) * p.iz;
    // ud = jx (Xd - X/Z Zd), vd likewise
    out.velocity = {gud * f.jx, gvd * f.jy, gud * f.jxz + gvd * f.jyz};
    out.camera.x -= gud * f.jx * p.iz * p.velocity.z;
    out.camera.y -= gvd * f.jy * p.iz * p.velocity.z;
    out.camera.z += ((gud * f.jx * p.xz + gvd * f.jy * p.yz) * p.velocity.z - gud * p.ud - gvd * p.vd) * p.iz;
    out.world = {Floats{}, Floats{}, Floats{}};
    return out;
}

// Through the colour; adds the view direction's part to the world mean.
static void through_shading(const Block &block, const RsGaussians &g, const RsGradients &out, const Shading &s, SplatGradient &sg,
                            PosedGradient &pg) {
    for (int k = 0; k < 3; k++) sg.colour[k] = keep(s.colour[k] > 0.f, sg.colour[k]);
    Floats gb[4] = {};
    for (int b = 0; b < g.bases; b++)
        for (int k = 0; k < 3; k++) {
            size_t row = ((size_t)b * 3 + k) * g.count;
            gb[b] += sg.colour[k] * block.get(g.sh + row);
            if (out.sh) block.add(out.sh + row, sg.colour[k] * s.basis[b]);
        }
    Vec3 gd = {gb[3] * -SH1, gb[1] * -SH1, gb[2] * SH1};
    pg.world = (gd - s.direction * dot(s.direction, gd)) * s.inverse_distance;
}

// Of the quaternion, through normalisation, and of the log scales.
static void rotation_and_scale(const Block &block, const RsGaussians &g, const RsGradients &out, const Footprint &f, const Mat3 &gRS) {
    size_t M = g.count;
    Floats gR[9], gs[3] = {};
    const Floats *scale = &f.scale.x;
    for (int r = 0; r < 3; r++) {
        const Floats *row = &gRS.r[r].x, *R = &f.R.r[r].x;
        for (int c = 0; c < 3; c++) gR[3 * r + c] = row[c] * scale[c], gs[c] += row[c] * R[c];
    }
    if (out.log_scales)
        for (int c = 0; c < 3; c++) {
            Floats ls = block.get(g.log_scales + c * M);
            block.add(out.log_scales + c * M, keep((ls > -30.f) & (ls < 6.f), gs[c] * scale[c]));
        }
    if (!out.rotations) return;
    Floats w = f.q[0], x = f.q[1], y = f.q[2], z = f.q[3];
    Floats d[4] = {2.f * (x * (gR[7] - gR[5]) + y * (gR[2] - gR[6]) + z * (gR[3] - gR[1])),
                   2.f * (w * (gR[7] - gR[5]) - 2.f * x * (gR[4] + gR[8]) + y * (gR[1] + gR[3]) + z * (gR[2] + gR[6])),
                   2.f * (w * (gR[2] - gR[6]) + x * (gR[1] + gR[3]) - 2.f * y * (gR[0] + gR[8]) + z * (gR[5] + gR[7])),
                   2.f * (w * (gR[3] - gR[1]) + x * (gR[2] + gR[6]) + y * (gR[5] + gR[7]) - 2.f * z * (gR[0] + gR[4]))};
    Floats along = d[0] * w + d[1] * x + d[2] * y + d[3] * z;
    for (int i = 0; i < 4; i++) block.add(out.rotations + i * M, (d[i] - f.q[i] * along) * f.inverse_norm);
}

// dL/dB and dL/dBd of the block's transform, complete with the change of the block's own time.
struct TransformGradient {
    Floats B[12], Bd[12];
};

// tau = rate v(tau) + start, so dtau/dv = rate / (1 - rate dv/dtau) where tau is not clamped (rendering: implicit derivative).
static void through_own_time(const Posed &p, const Blend &blend, int D, Floats tau, float rate, const RsCamera &cam, const Vec3 &x,
                             TransformGradient &t, Vec3 &world) {
    Floats g_tau = {};
    for (int m = 0; m < 12; m++) {
        Floats second = {};
        for (int d = D - 1; d >= 2; d--) second = second * tau + blend.c[d][m] * (float)(d * (d - 1));
        g_tau += t.B[m] * p.Bd[m] + t.Bd[m] * second;
    }
    Floats gv = keep((tau > -1.f) & (tau < 1.f), g_tau * rate / scan_slack(rate, p.vd));
    Vec3 e = from_camera(cam, {Floats{}, gv * p.iz * cam.fy, gv * p.iz * p.yz * -cam.fy});
    world = world + e;
    const Floats *row = &e.x;
    for (int r = 0; r < 3; r++) {
        t.B[4 * r] += row[r] * x.x, t.B[4 * r + 1] += row[r] * x.y, t.B[4 * r + 2] += row[r] * x.z, t.B[4 * r + 3] += row[r];
    }
}

// B(tau) = sum_d tau^d sum_j w_j pose[d, j]: to the weights and to the pose's running sums [D][24][12]. Joints that move
// no Gaussian of the block are skipped, so a weight of 0 gets no gradient.
static void through_blend(const Block &block, const RsGaussians &g, const RsGradients &out, const float *pose, int D, Floats tau,
                          const TransformGradient &t, Floats *sums) {
    Floats of[MAX_COEFFICIENTS][12];  // dL / d (sum_j w_j pose[d, j])
    Floats power = splat(1.f), power_rate = {};  // tau^d and d tau^(d-1)
    for (int d = 0; d < D; d++) {
        for (int m = 0; m < 12; m++) of[d][m] = keep(block.live, power * t.B[m] + power_rate * t.Bd[m]);
        power_rate = power * (float)(d + 1), power *= tau;
    }
    for (int j = 0; j < JOINTS; j++) {
        size_t row = (size_t)j * g.count;
        Floats w = block.get(g.skin_weights + row);
        if (!any(w != 0.f)) continue;
        Floats of_weight = {};
        for (int d = 0; d < D; d++) {
            size_t at = ((size_t)d * JOINTS + j) * 12;
            for (int m = 0; m < 12; m++) of_weight += of[d][m] * pose[at + m];
            if (out.pose)
                for (int m = 0; m < 12; m++) sums[at + m] += w * of[d][m];
        }
        if (out.skin_weights) block.add(out.skin_weights + row, keep(w != 0.f, of_weight));
    }
}

static void backward_block(const RsFrame &frame, const RsGaussians &g, const RsGradients &out, const float *pose, const Slot &slot,
                           const Block &block, float scale, Floats *sums) {
    alignas(64) float moments[MOMENTS][LANES];
    if (!gather_moments(slot, block, scale, moments)) return;
    const RsCamera &cam = frame.camera;
    int D = frame.coefficients;
    float rate = slot.rows.rate;
    Floats tau = {};
    for (int i = 0; i < LANES; i++)
        if (block.live[i]) tau[i] = slot.splats[block.survivors[i]].tau;
    Blend blend;
    blend_pose(block, g, pose, D, blend);
    Vec3 x = mean_of(block, g);
    Posed p;
    pose_at(blend, D, tau, x, cam, frame.options.near, p);
    Footprint f;
    footprint(block, g, p, cam, frame.options.dilation, f);
    Shading shading;
    shade(block, g, p, cam, shading);
    Floats opacity, log2_opacity;
    opacity_of(block.get(g.opacity_logits), opacity, log2_opacity);

    int flags = frame.options.flags;
    float moving = flags & RS_NO_SHEAR ? 0.f : rate;
    Floats a = p.ud * moving, slack = scan_slack(moving, p.vd);
    SplatGradient sg = splat_gradient(moments, f.A, -(slack * f.r + a), slack * slack * f.inverse_syy, opacity);
    if (out.opacity_logits) block.add(out.opacity_logits, sg.logit);
    if (out.screen) block.add(out.screen, sg.u), block.add(out.screen + g.count, sg.v);
    PosedGradient pg = through_projection(sg, p, f, cam, moving);
    through_shading(block, g, out, shading, sg, pg);

    Vec3 world = from_camera(cam, pg.camera) + pg.world, world_rate = from_camera(cam, pg.velocity);
    TransformGradient t;
    const Floats *w = &world.x, *wd = &world_rate.x;
    for (int r = 0; r < 3; r++) {
        Vec3 from_shape = mul(f.RS, pg.M.r[r]);  // M = B_linear (R S)
        t.B[4 * r] = from_shape.x + w[r] * x.x, t.B[4 * r + 1] = from_shape.y + w[r] * x.y;
        t.B[4 * r + 2] = from_shape.z + w[r] * x.z, t.B[4 * r + 3] = w[r];
        t.Bd[4 * r] = wd[r] * x.x, t.Bd[4 * r + 1] = wd[r] * x.y, t.Bd[4 * r + 2] = wd[r] * x.z, t.Bd[4 * r + 3] = wd[r];
    }
    if (rate != 0.f && !(flags & RS_NO_IMPLICIT)) through_own_time(p, blend, D, tau, rate, cam, x, t, world);
    if (out.means) {
        Vec3 gx = mul_transposed(p.linear(), world) + mul_transposed(p.linear_rate(), world_rate);
        block.add(out.means, gx.x), block.add(out.means + g.count, gx.y), block.add(out.means + 2 * (size_t)g.count, gx.z);
    }
    Mat3 L = p.linear(), gRS;
    const Floats *l0 = &L.r[0].x, *l1 = &L.r[1].x, *l2 = &L.r[2].x;
    for (int k = 0; k < 3; k++) gRS.r[k] = pg.M.r[0] * l0[k] + pg.M.r[1] * l1[k] + pg.M.r[2] * l2[k];
    rotation_and_scale(block, g, out, f, gRS);
    through_blend(block, g, out, pose, D, tau, t, sums);
}

static void clear(const RsGradients &out, const RsGaussians &g, int begin, int end) {
    auto zero = [&](float *p, int rows) {
        for (int i = 0; p && i < rows; i++) std::fill(p + (size_t)i * g.count + begin, p + (size_t)i * g.count + end, 0.f);
    };
    zero(out.means, 3), zero(out.rotations, 4), zero(out.log_scales, 3), zero(out.opacity_logits, 1);
    zero(out.sh, 3 * g.bases), zero(out.skin_weights, JOINTS), zero(out.screen, 2);
}

// Chunks of Gaussian ids, as many for one thread as for sixty: each chunk walks the slots in order and owns its rows of
// every gradient; the pose sums of the chunks are added in order. So the result does not depend on the threads.
constexpr int CHUNKS = 16;

void project_backward(RsFrame &frame, const RsGaussians &g, const float *pose, float scale, const RsGradients &out) {
    const size_t n = (size_t)frame.coefficients * JOINTS * 12, slots = frame.slot_count, before = frame.first_slot * n;
    frame.pose_sums.assign(out.pose ? CHUNKS * slots * n : 0, 0.f);
    Attempt attempt;
#pragma omp parallel for schedule(dynamic, 1) num_threads(frame.options.threads)
    for (int chunk = 0; chunk < CHUNKS; chunk++) attempt([&, chunk] {
        int32_t begin = (int64_t)g.count * chunk / CHUNKS, end = (int64_t)g.count * (chunk + 1) / CHUNKS;
        if (frame.first_slot == 0) clear(out, g, begin, end);
        std::vector<Floats> sums(n);
        for (size_t t = 0; t < slots; t++) {
            const Slot &slot = frame.slots[t];
            int first = std::lower_bound(slot.ids.begin(), slot.ids.end(), begin) - slot.ids.begin();
            int last = std::lower_bound(slot.ids.begin() + first, slot.ids.end(), end) - slot.ids.begin();
            if (first == last) continue;
            std::fill(sums.begin(), sums.end(), Floats{});
            for (int k = first; k < last;) {
                const Block block(slot.ids.data(), k, last, end);
                backward_block(frame, g, out, pose + before + t * n, slot, block, scale, sums.data());
                k += block.used;
            }
            if (out.pose)
                for (size_t i = 0; i < n; i++) frame.pose_sums[(chunk * slots + t) * n + i] = sum(sums[i]);
        }
    });
    attempt.settle();
    if (out.pose)
        for (size_t i = 0; i < slots * n; i++) {
            float s = 0.f;
            for (int chunk = 0; chunk < CHUNKS; chunk++) s += frame.pose_sums[chunk * slots * n + i];
            out.pose[before + i] = s;
        }
}
