// Tiles along rows: shared by tiles.cpp and pictures.cpp.

#pragma once

#include "lanes.h"

extern "C" {

// The columns of tiles that an ellipse touches in one row of tiles; none if the last is before the first.
struct Strip {
    int32_t from, to;
};

}  // extern "C"

namespace {

// First tile with a pixel centre at or after a position.
inline int64_t tile_from(float position, int64_t tiles) {
    const float tile = std::ceil((position - (TILE - 0.5f)) / TILE);
    return static_cast<int64_t>(std::min(std::max(tile, 0.0f), static_cast<float>(tiles)));
}

// Last tile with a pixel centre at or before a position.
inline int64_t tile_to(float position, int64_t tiles) {
    const float tile = std::floor((position - 0.5f) / TILE);
    return static_cast<int64_t>(std::min(std::max(tile, -1.0f), static_cast<float>(tiles - 1)));
}

}  // namespace
