// One image's plan, as the stages hand it on: cull -> project -> bin -> raster, and back.
#pragma once
#include <atomic>
#include <new>
#include <vector>

#include "layout.h"
#include "loss.h"
#include "simd.h"

// A projected Gaussian, packed for the rasteriser: one cache line.
struct alignas(64) Splat {
    float u, v;                        // mean, pixels
    float qxx, tilt, qyy;              // log2 alpha = qxx (dx + tilt dy)^2 + qyy dy^2 + log2_opacity; qxx, qyy <= 0
    float log2_opacity;
    float r, g, b;
    int16_t x_lo, x_hi, y_lo, y_hi;    // where alpha >= alpha_min can hold, clipped to the slot and the image
    float depth, depth_rate, tau;      // depth at its own tau, and its derivative in tau
    int32_t fate;                      // see Fate
};
static_assert(sizeof(Splat) == 64, "one cache line");

// A splat in a strip's list; `pair` is where its moments lie. Tied to the entry before it: see order.h.
struct Entry {
    int32_t splat;
    uint32_t pair : 31, tied : 1;
};

struct Rows {
    int lo, hi;
};

// Gradient of one splat; the sums over pixels that everything else follows from. g = dL/dalpha * alpha at a pixel, its
// coordinates x = dx + tilt dy and y = dy.
enum Moment { M0, MX, MY, MXX, MXY, MYY, MR, MG, MB, MOMENTS };

// Broken: a number of the Gaussian's, or of its pose's, is not finite. Absent: there is no such Gaussian.
enum Fate { SURVIVES = 0, UNSEEN = -1, BROKEN = -2, ABSENT = -3 };

struct Slot {
    RsRows rows;
    int strips;
    int projected, broken;             // Gaussians; the latter of that fate
    std::vector<int32_t> ids;          // surviving Gaussians, ascending
    std::vector<Splat> splats;         // theirs
    std::vector<int32_t> first_pair;   // splat -> its first pair; a splat's pairs are its strips, from the top; [n + 1]
    std::vector<int32_t> strip_begin;  // strip -> its first entry; [strips + 1]
    std::vector<int16_t> strip_x_lo, strip_x_hi;  // columns that the strip's splats reach
    std::vector<Entry> entries;        // the strips' lists, by depth
    std::vector<float> moments;        // [pairs][16], written by the backward raster
};

struct Group {  // slots that share their rows
    int first_slot, slots;
};

struct Task {  // what one thread rasterises at a time
    int group, strip;
};

// What LANES consecutive Gaussians keep to, in canonical space; see cull.cpp.
struct Ball {
    float centre[3], radius;  // of their means, metres
    float size;               // their longest axis, metres
    float shift;              // of their rows by `screen`, pixels
    uint32_t joints;          // a bit for each that one of them is bound to
    bool bounded;             // whether all this holds
};

struct RsFrame {
    RsCamera camera;
    RsOptions options;
    int coefficients;
    std::vector<RsRows> rows;          // of every slot
    std::vector<int> waves;            // wave -> its first slot; [waves + 1]. One wave is planned at a time
    RsTarget target;                   // of a comparison that several waves repeat on the way back
    std::vector<Ball> balls;           // block of LANES Gaussians -> what bounds it; none where nothing is culled
    int first_slot = 0, slot_count = 0;  // the wave's
    std::vector<Slot> slots;           // capacity is kept between images: slots[0, slot_count) are in use
    std::vector<Group> groups;
    std::vector<Task> tasks;
    std::vector<int32_t> blocks;       // of the only slot: first Gaussian of each block that is projected,
    std::vector<Splat> projected;      // and LANES splats for each; of several slots, each thread has its own
    std::vector<float> pose_sums;      // [chunks][slots of the wave][D * 24 * 12]

    bool in_waves() const { return waves.size() > 2; }
};

static inline Rows rows_of(const RsFrame &frame, const Slot &slot, int strip) {
    int lo = slot.rows.lo + strip * frame.options.strip_rows;
    return {lo, lo + frame.options.strip_rows < slot.rows.hi ? lo + frame.options.strip_rows : slot.rows.hi};
}

void surround(RsFrame &frame, const RsGaussians &gaussians);
void cull(const RsFrame &frame, const RsGaussians &gaussians, const float *pose, const Slot &slot, std::vector<int32_t> &blocks);
void project(const RsFrame &frame, const RsGaussians &gaussians, const float *pose, const Slot &slot, const int32_t *blocks, int count, Splat *projected);
void bin(RsFrame &frame, Slot &slot, const std::vector<int32_t> &blocks, const std::vector<Splat> &projected);
void order(const RsFrame &frame, Slot &slot, int strip);
void raster(RsFrame &frame, const Planes<float> &image);
void raster_backward(RsFrame &frame, const Planes<const float> &image, const Planes<const float> &gradient);
void raster_compared(RsFrame &frame, Comparison &comparison, bool walks_back);  // both, through the loss; keeps no image
void project_backward(RsFrame &frame, const RsGaussians &gaussians, const float *pose, float scale, const RsGradients &gradients);

// Runs work within a parallel region, which no exception may leave: that memory ran out is noted, and thrown after it.
class Attempt {
    std::atomic<bool> failed{false};

public:
    template <class Work> void operator()(Work work) {
        try {
            if (!failed) work();
        } catch (const std::bad_alloc &) {
            failed = true;
        }
    }
    void settle() const {
        if (failed) throw std::bad_alloc();
    }
};
