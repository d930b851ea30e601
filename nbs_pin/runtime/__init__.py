"""The mathematics of the laws as compiled kernels on packed arrays; no knowledge of robots, models or torch."""
