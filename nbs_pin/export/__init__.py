"""Laws as C: what the kernels do, written out for one arm."""
