"""monopart.fields.kernels."""
