"""Time from nothing to the first result: compilation, imports, and the shipped kernels."""
