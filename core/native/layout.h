// The C interface of the kernels, and the layout of everything that crosses it.
//
// Axis letters: M Gaussians, B spherical-harmonics bases, J = 24 joints, T slots, D pose coefficients, H rows, W columns.
// All arrays are float32, contiguous, channel-first (structure of arrays), owned by the caller.
//
//   means          [3, M]           metres, canonical space
//   rotations      [4, M]           quaternions (w, x, y, z) of any length > 0
//   log_scales     [3, M]           natural logarithm of metres
//   opacity_logits [M]
//   sh             [B, 3, M]        B = 1 or 4
//   skin_weights   [24, M]
//   screen         [2, M]           pixels added to the projected means; its gradient drives density control
//   pose           [T, D, 24, 3, 4] joint transforms, canonical to world, as polynomials in tau: sum_d pose[t, d] tau^d
//   rgb            [3, H, W]        on black
//   transmittance  [H, W]           1 where nothing was hit
//
// A slot (RsRows) covers rows [lo, hi). rate == 0: every Gaussian is posed at tau = start. rate != 0: each Gaussian is
// posed at its own tau, the fixed point of tau = rate * v(tau) + start, v its projected row in pixels (centres at half
// integers), clamped to [-1, 1]. Row ranges of two slots are equal (then their images are averaged by weight) or disjoint.
#pragma once
#include <cstdint>

constexpr int JOINTS = 24;
constexpr int MAX_COEFFICIENTS = 12;  // D
constexpr int MAX_SIZE = 32767;       // H and W: boxes are 16-bit

#define RS_API __attribute__((visibility("default")))

extern "C" {

struct RsGaussians {
    int32_t count, bases;
    const float *means, *rotations, *log_scales, *opacity_logits, *sh, *skin_weights, *screen;
};

// Same shapes as RsGaussians; overwritten. A null pointer: not wanted, not computed. Skinning weights that are 0 get no
// gradient: a joint that a Gaussian is not bound to is not the optimiser's to add.
struct RsGradients {
    float *means, *rotations, *log_scales, *opacity_logits, *sh, *skin_weights, *screen, *pose;
};

struct RsRows {
    int32_t lo, hi;
    float rate, start, weight;
};

struct RsCamera {
    float rotation[9], translation[3];  // x_cam = rotation x_world + translation
    float fx, fy, cx, cy;
    int32_t height, width;
};

// Bits of RsOptions.flags: corrections of own time, and the culling of blocks, that are left out, to measure what each is worth.
enum RsFlag { RS_NO_SHEAR = 1, RS_NO_IMPLICIT = 2, RS_NO_RESORT = 4, RS_NO_CULL = 8 };

struct RsOptions {
    float near, dilation, alpha_min, alpha_max, transmittance_min;
    int32_t strip_rows, threads, flags;
};

// What the plan of a frame came to; see RsFrame.
struct RsCounters {
    int64_t projected;  // Gaussians in blocks that might reach a slot, summed over slots
    int64_t splats;     // those that survived, summed over slots
    int64_t pairs;      // (splat, strip) pairs rasterised
    int64_t broken;     // Gaussians not drawn because NaN or infinity is in them or in their pose, summed over slots
};

struct RsFrame;  // one image's plan and scratch, kept between forward and backward and reused between images

RS_API RsFrame *rs_frame_create(void);
RS_API void rs_frame_destroy(RsFrame *frame);

// 0 on success, 1 out of memory, 2 arguments outside the limits above.
RS_API int rs_render(RsFrame *frame, const RsGaussians *gaussians, const float *pose, int slots, int coefficients, const RsRows *rows,
              const RsCamera *camera, const RsOptions *options, float *rgb, float *transmittance, RsCounters *counters);

// Gradients of the image that `frame` rendered last, with the same arguments. rgb and transmittance are that image.
RS_API int rs_render_backward(RsFrame *frame, const RsGaussians *gaussians, const float *pose, const float *rgb,
                       const float *transmittance, const float *grad_rgb, const float *grad_transmittance,
                       const RsGradients *gradients);

// Mean absolute error of an image over a grey background and of its opacity against a mask, with its gradient.
//   loss = mean_{3HW} |rgb + background * transmittance - target/255| + mask_weight * mean_{HW} |1 - transmittance - mask/255|
// target is composited over the background by the mask (it holds premultiplied colour on black).
struct RsTarget {
    const uint8_t *rgb, *mask;  // [3, H, W], [H, W]
    float background, mask_weight;
};

// grad_rgb and grad_transmittance are overwritten.
RS_API double rs_l1(const float *rgb, const float *transmittance, const RsTarget *target, int height, int width, int threads, float *grad_rgb,
                    float *grad_transmittance);

// The loss of rs_render's image, and the mean squared error of its colours over the background. In one pass that keeps no image:
// each strip is drawn, compared, and its gradient walked back to the splats, while it is in the cache.
RS_API int rs_render_l1(RsFrame *frame, const RsGaussians *gaussians, const float *pose, int slots, int coefficients, const RsRows *rows,
                        const RsCamera *camera, const RsOptions *options, const RsTarget *target, RsCounters *counters, double *loss,
                        double *squared_error);

// Gradients of `scale` times the loss that `frame` computed last, with the same arguments; target's images are still there. Can be
// called once.
RS_API int rs_render_l1_backward(RsFrame *frame, const RsGaussians *gaussians, const float *pose, float scale, const RsGradients *gradients);

// Joint angles of B states of one body. Rotations are axis-angle, radians; lengths in metres.
//   angles, residuals  [B, 24, 3]  a joint turns by exp(angle) exp(residual) relative to its parent; the root's are ignored
//   root_rotation, root_translation [B, 3]  x_world = exp(Rh) x + Th
//   rest_joints [24, 3], parents [24] (-1 first, each before its children). residuals may be null.
struct RsBody {
    const float *angles, *residuals, *root_rotation, *root_translation, *rest_joints;
    const int32_t *parents;
};

// transforms [B, 24, 3, 4], rest to world.
RS_API void rs_pose(const RsBody *body, int states, float *transforms);
// Gradients are added to what is there. grad_residuals may be null where residuals is.
RS_API void rs_pose_backward(const RsBody *body, int states, const float *grad_transforms, float *grad_angles,
                             float *grad_residuals, float *grad_root_rotation, float *grad_root_translation,
                             float *grad_rest_joints);

// Mean gap between the trajectories of consecutive frames (paper, eq. reg), with its gradient.
//   control [N, P, 25, 3]  axis-angle of the root and of joints 1..23, radians, and a translation, metres
//   ends [2, P]            weights of the control points at a frame's end, and at its start
//   meeting [N - 1]        weights of the pairs (n, n + 1)
//   gap(n) = mean_{j<24} angle between exp(end_n,j) and exp(start_{n+1},j) + |end_n,24 - start_{n+1},24|, the latter where asked for
// gradient [N, P, 25, 3] is overwritten.
RS_API double rs_continuity(const float *control, int frames, int points, const double *ends, const double *meeting, int translation,
                            int threads, float *gradient);

// One step of Adam on `count` parameters; `step` counts from 1 with the step that is to be taken.
//   value, mean, square, gradient [size]; a null value: the gradient is checked only
struct RsParameter {
    int64_t size;
    float *value, *mean, *square;
    const float *gradient;
    float rate;
    int32_t step;
};

// 0 on success, 1 out of memory, 3 if a gradient is NaN or infinite: then nothing has changed.
RS_API int rs_adam(const RsParameter *parameters, int count, float beta1, float beta2, float epsilon, int threads);

RS_API int rs_lanes(void);  // SIMD lanes of this build, for reports
}
