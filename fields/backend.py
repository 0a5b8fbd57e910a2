"""Which implementation runs: the rule of `monopart.geometry.backend`, for the fields."""

from monopart.geometry.backend import Backend, choose_backend, warp_is_installed

__all__ = ["Backend", "choose_backend", "warp_is_installed"]
