"""monopart.tools.bench."""
