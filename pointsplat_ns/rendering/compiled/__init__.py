"""The rasterizer's inner loops in C++, for float32 on a CPU; torch is the fallback."""
