// Mean absolute error of rows of an image: see rs_l1.
#pragma once
#include <cstddef>
#include <vector>

#include "layout.h"

// Columns [x0, x1) of an image, or of the gradient of one, from its row `top` on.
template <class Value> struct Planes {
    Value *rgb, *transmittance;
    size_t plane;  // values of a colour
    int x0, x1, top;

    size_t at(int y, int x) const { return (size_t)(y - top) * (x1 - x0) + (x - x0); }
    operator Planes<const Value>() const { return {rgb, transmittance, plane, x0, x1, top}; }
};

struct RowError {  // sums over a row
    double colour, coverage, square;
};

class Comparison {
    RsTarget target;
    size_t pixels;
    int width;
    std::vector<RowError> errors;  // added in row order: the same for any number of threads

public:
    Comparison(const RsTarget &target, int height, int width) : target(target), pixels((size_t)height * width), width(width), errors(height) {}

    // Rows [lo, hi), each once, of an image that is empty outside the columns that are given. Overwrites the gradient there.
    void rows(int lo, int hi, const Planes<const float> &image, const Planes<float> &gradient);
    double loss() const;
    double squared_error() const;  // mean, of the colours
};
