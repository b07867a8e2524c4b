// Blending: what blending.cpp has, for other kernels.

#pragma once

#include <cstdint>

extern "C" {

// Input and output of blending. Tiles are those of some rows of tiles of an image, row by row.
struct Task {
    const float* table;        // [M, COLOR + channels], of pointsplat_tabulate
    const int64_t* gaussians;  // [P] rows of the table, by tile and front to back
    const int64_t* offsets;    // [tiles + 1] where each tile's Gaussians start
    const int64_t* chunks;     // [tiles + 1] where each tile's chunks start
    int64_t tiles, columns, top, width, height, channels;
    float log2_alpha_min, alpha_max, clamped_from, transmittance_min;
    float* image;        // [tiles, channels, PIXELS]
    float* final_;       // [tiles, PIXELS] transmittance left
    float* before;       // [chunks, PIXELS] transmittance in front of each chunk; null where it is not wanted
    int64_t* blended;    // [tiles] Gaussians passed before all pixels were finished
    const float* grad_image;  // as image
    const float* grad_final;  // as final_
    float* sums;              // [P, MOMENTS + channels (+ 2)] gradient sums of each pair
    int64_t absolute;         // whether sums has two columns more
};

void pointsplat_weigh(const Task* task, int64_t* next);

}  // extern "C"
