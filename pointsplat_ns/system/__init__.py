"""Files, processes, threads, memory, compiled kernels and progress bars."""
