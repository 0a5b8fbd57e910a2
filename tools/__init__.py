"""Mesh tools (`meshio`, `check`, `partition`, `bake`, `remesh`, `body`, `cli`) and benchmarks."""

if __name__ != "monopart.tools":  # a bare import would copy every class
    raise ImportError(f"import monopart.tools, not {__name__!r}")
