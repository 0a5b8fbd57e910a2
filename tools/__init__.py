"""Mesh tools and benchmarks; no room is built yet."""

if __name__ != "monopart.tools":  # a bare import would copy every class
    raise ImportError(f"import monopart.tools, not {__name__!r}")
