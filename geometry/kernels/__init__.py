"""monopart.geometry.kernels."""
