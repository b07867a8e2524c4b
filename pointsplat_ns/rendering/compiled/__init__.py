"""The rasterizer's inner loops in C++, for float32 on a CPU where they were built; elsewhere torch
does the same."""
