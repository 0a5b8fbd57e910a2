"""A Gaussian avatar on the geometry of monopart: the proof that its parts serve other methods."""
