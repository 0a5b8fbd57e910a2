"""monopart.toolkit."""

if __name__ != "monopart.toolkit":  # a bare import would copy every class
    raise ImportError(f"import monopart.toolkit, not {__name__!r}")
