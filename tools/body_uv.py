"""The texture coordinates of the body that ships with the package: made anew, or compared.

``python -m monopart.tools.body_uv FILE`` writes a body file with coordinates by `unwrap` in place
of its own; ``--check`` says how those that it has differ from that, and writes nothing.
"""

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int

from monopart.geometry.atomic import write_bytes
from monopart.geometry.body import BodyModel
from monopart.geometry.errors import InputError
from monopart.geometry.unwrap import unwrap


def indexed_uv(
    corner_uv: Float[np.ndarray, "F 3 2"], charts: Int[np.ndarray, "F"]
) -> tuple[Float[np.ndarray, "W 2"], Int[np.ndarray, "F 3"]]:
    """Coordinates per corner as a list of different ones and indices into it.

    Args:
        corner_uv: coordinates per face corner.
        charts: chart of each face; corners of different charts do not share an entry.

    Returns:
        Coordinates, float32, and indices, int32: the arrays ``vt`` and ``ft`` of a body file.

    >>> corner = np.zeros((2, 3, 2))
    >>> corner[:, 1, 0] = corner[:, 2, 1] = 1
    >>> vt, ft = indexed_uv(corner, np.array([0, 0]))
    >>> len(vt), ft.tolist()
    (3, [[0, 2, 1], [0, 2, 1]])
    """
    chart = np.repeat(charts, 3)[:, None].astype(np.float64)
    rows = np.concatenate([chart, corner_uv.reshape(-1, 2)], 1)
    found, index = np.unique(rows, axis=0, return_inverse=True)
    return found[:, 1:].astype(np.float32), index.reshape(-1, 3).astype(np.int32)


def with_layout(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a body file, ``vt`` and ``ft`` made by `unwrap` with its usual options.

    Args:
        path: a body file, `.npz`.

    Returns:
        All its arrays by name.

    Raises:
        InputError: no such file, or one that is no body.
    """
    body = BodyModel.load(path)
    if path.suffix != ".npz":
        raise InputError(f"{path}: expected an .npz file, found {path.suffix}; convert it first")
    layout = unwrap(body.v_template, body.faces)
    with np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    corner = layout.corner_uv.double().numpy()
    arrays["vt"], arrays["ft"] = indexed_uv(corner, layout.charts.numpy())
    return arrays


def main(argv: Sequence[str] | None = None) -> int:
    """Write or check the coordinates of a body file.

    Args:
        argv: arguments after the program's name; those of the process if None.

    Returns:
        0 when written, or the same; 1 when ``--check`` finds a difference.
    """
    parser = argparse.ArgumentParser(prog="python -m monopart.tools.body_uv", description=__doc__)
    parser.add_argument("body", type=Path, metavar="FILE")
    parser.add_argument("--check", action="store_true", help="compare, write nothing")
    arguments = parser.parse_args(argv)
    own = BodyModel.load(arguments.body).uv
    arrays = with_layout(arguments.body)
    corner = torch.from_numpy(arrays["vt"])[torch.from_numpy(arrays["ft"]).long()]
    if arguments.check:
        gap = None if own is None else float((own.corner_uv - corner).abs().max())
        print("no coordinates" if gap is None else f"largest difference: {gap:g}")
        return 0 if gap is not None and gap < 2**-12 else 1
    memory = io.BytesIO()
    np.savez_compressed(memory, allow_pickle=False, **arrays)
    write_bytes(arguments.body, memory.getvalue())
    return 0


if __name__ == "__main__":
    sys.exit(main())
