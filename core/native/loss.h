// Mean absolute error of rows of an image: see rs_l1.
#pragma once
#include <cstddef>
#include <vector>

#include "layout.h"

// Planes of an image, or of the gradient of one, from its row `top` on.
template <class Value> struct Planes {
    Value *rgb, *transmittance;
    size_t plane;  // values of a colour
    int width, top;

    size_t row(int y) const { return (size_t)(y - top) * width; }
};

struct RowError {  // sums over a row
    double colour, coverage;
};

class Comparison {
    RsTarget target;
    size_t pixels;
    int width;
    std::vector<RowError> errors;  // added in row order: the same for any number of threads

public:
    Comparison(const RsTarget &target, int height, int width) : target(target), pixels((size_t)height * width), width(width), errors(height) {}

    // Rows [lo, hi); each once. Overwrites the gradient's.
    void rows(int lo, int hi, const Planes<const float> &image, const Planes<float> &gradient);
    double loss() const;
};
