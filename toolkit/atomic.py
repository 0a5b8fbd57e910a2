"""The whole-or-nothing writers of ``monopart.geometry.atomic`` under the toolkit's name."""

from monopart.geometry.atomic import replacing, write_bytes, write_json, write_text

__all__ = ["replacing", "write_bytes", "write_json", "write_text"]
