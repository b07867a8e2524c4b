// The tiles that each Gaussian touches: what tiles.cpp has, for other kernels.

#pragma once

#include "lanes.h"

extern "C" {

// The columns of tiles that an ellipse touches in one row of tiles; none if the last is before the first.
struct Strip {
    int32_t from, to;
};

// Gaussians, front to back, and the tiles that they touch in some rows of tiles.
struct Listing {
    const float* table;
    int64_t stride;         // numbers in a row of the table
    const int64_t* order;   // [M] rows, front to back
    int64_t count;          // M
    int32_t* boxes;         // [M, 4] in this order, first and last row of tiles, first and last column
    int64_t height, rows, columns, top, bottom;  // of the image, pixels and tiles; rows of tiles from top on, before bottom
    float log2_alpha_min, slack;
    Strip* strips;                // one for each row of tiles of each Gaussian
    int64_t* offsets;             // [tiles + 1] counts, in the next place, then where each tile's pairs start
    int64_t* counts;              // [M] pairs of each Gaussian; or null
    int64_t *gaussians, *places;  // [P] rows of the table by tile; where each pair stands by Gaussian, or null
};

void pointsplat_by_depth(const float* depths, int64_t count, int64_t* order);
void pointsplat_boxes(const Listing* listing, int64_t* next);
void pointsplat_count(const Listing* listing);
void pointsplat_list(const Listing* listing);

}  // extern "C"
