"""Body files of a subject: a shape made the mean one, a size, a level of detail.

The files have the layout of SMPL bodies that `BodyModel.load` reads. A body of fewer faces keeps
its joints exactly, for the mean shape and for every shape coefficient.
"""

import dataclasses
import io
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from monopart.geometry.atomic import write_bytes
from monopart.geometry.body_io import BodyArrays, check_body, read_body
from monopart.geometry.errors import InputError
from monopart.geometry.weight_transfer import closest_faces

from .bake_uv import carried_uv
from .meshio import Mesh

_FEWEST = 50  # faces of the coarsest body


def _default_path() -> Path:
    import importlib.resources

    return Path(str(importlib.resources.files("monopart.geometry") / "assets" / "body.npz"))


def shaped_body(
    body: BodyArrays, betas: Sequence[float] | Float[np.ndarray, "B"], height: float | None = None
) -> BodyArrays:
    """A body whose mean shape is that of given coefficients, scaled to a height.

    Shape directions stay, so coefficients of the new body add to those given here.

    Args:
        body: arrays of a body file.
        betas: shape coefficients; at most as many as the body has.
        height: extent along y in the rest pose, metres; None leaves the size.

    Returns:
        Arrays of the new body.

    Raises:
        InputError: too many coefficients, or numbers that are not finite or not positive.
    """
    given = np.asarray(betas, np.float64).reshape(-1)
    count = body.shapedirs.shape[2]
    if len(given) > count or not np.isfinite(given).all():
        raise InputError(
            f"betas: expected at most {count} finite numbers (the body's), found {len(given)}: "
            f"{given.tolist()}; cut them or take a body with more"
        )
    verts = body.v_template + body.shapedirs[..., : len(given)] @ given
    scale = 1.0
    if height is not None:
        tall = float(np.ptp(verts[:, 1]))
        if not (math.isfinite(height) and height > 0 and tall > 0):
            raise InputError(f"height: expected a positive number of metres, found {height}")
        scale = height / tall
    return dataclasses.replace(
        body,
        v_template=scale * verts,
        shapedirs=scale * body.shapedirs,
        posedirs=scale * body.posedirs,
    )


def coarse_body(body: BodyArrays, num_faces: int) -> BodyArrays:
    """A body of fewer faces, its vertices on the surface of the old one.

    Edges collapse by least quadric error; weights, shape and pose directions are those of the
    surface points, texture coordinates are carried without crossing a seam, and the regressor of
    the joints is corrected by least squares so that joints stay where they were.

    Args:
        body: arrays of a body file, a manifold mesh.
        num_faces: faces to reach; a body of as few or fewer is returned as it is.

    Returns:
        Arrays of the new body.

    Raises:
        InputError: too few faces asked for, or a mesh that cannot be thinned out so far.
    """
    if num_faces >= len(body.faces):
        return body
    if num_faces < _FEWEST:
        raise InputError(f"faces: expected at least {_FEWEST}, found {num_faces}; ask for more")
    verts, faces = _thinned(body, num_faces)
    face, bary, _ = closest_faces(verts, body.v_template, body.faces)
    corners = body.faces[face]

    def carried(values: np.ndarray) -> np.ndarray:
        wide = values.reshape(len(values), -1)
        return np.einsum("vk,vkx->vx", bary, wide[corners]).reshape(-1, *values.shape[1:])

    template, shapedirs = carried(body.v_template), carried(body.shapedirs)
    weights = carried(body.weights)
    uv = None
    if body.corner_uv is not None:
        source = Mesh(body.v_template, body.faces, corner_uv=body.corner_uv)
        uv = carried_uv(source, Mesh(template, faces))[0]
    return dataclasses.replace(
        body,
        v_template=template,
        faces=faces,
        weights=weights / weights.sum(1, keepdims=True),
        joint_regressor=_regressor(body, template, shapedirs),
        shapedirs=shapedirs,
        posedirs=carried(body.posedirs),
        corner_uv=uv,
    )


def _thinned(body: BodyArrays, num_faces: int) -> tuple[np.ndarray, np.ndarray]:
    import igl

    from .topology import topology

    shape = topology(body.faces, len(body.v_template))
    if len(shape.branching_edges) or len(shape.pinched_verts):
        raise InputError(
            f"faces: expected a manifold mesh to thin out, found {len(shape.branching_edges)} "
            f"branching edges and {len(shape.pinched_verts)} pinched vertices; clean the body first"
        )
    start = np.asfortranarray(body.v_template), np.asfortranarray(body.faces.astype(np.int32))
    found = igl.qslim(start[0], start[1], num_faces)
    verts, faces = np.asarray(found[0]), np.asarray(found[1])
    used, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int64)
    if not _FEWEST // 2 <= len(faces) <= num_faces + 2:
        raise InputError(
            f"faces: expected to reach {num_faces}, found that edges cannot collapse below "
            f"{len(faces)}; ask for more"
        )
    return np.ascontiguousarray(verts[used]), faces


def _regressor(body: BodyArrays, template: np.ndarray, shapedirs: np.ndarray) -> np.ndarray:
    """Rows over the new vertices that give the old joints, for every shape."""
    from scipy.spatial import KDTree

    # first each old vertex hands its share to the nearest new one
    nearest = KDTree(template).query(body.v_template)[1]
    rows = np.zeros((len(body.joint_regressor), len(template)))
    np.add.at(rows.T, nearest, body.joint_regressor.T)

    def facts(verts: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """[V, 1 + 3 (B + 1)] what a row of the regressor is summed over."""
        return np.concatenate(
            [np.ones((len(verts), 1)), verts, directions.reshape(len(verts), -1)], 1
        )

    new = facts(template, shapedirs)
    scale = np.maximum(np.abs(new).max(0), 1e-12)
    wanted = body.joint_regressor @ facts(body.v_template, body.shapedirs)
    missing = (wanted - rows @ new) / scale
    # then the smallest change among vertices near the joint, if that is enough, else among all
    joints = wanted[:, 1:4]
    for joint in range(len(rows)):
        order = np.argsort(np.linalg.norm(template - joints[joint], axis=1))
        for count in (4 * new.shape[1], len(template)):
            near = order[:count]
            change = np.linalg.lstsq((new[near] / scale).T, missing[joint], rcond=1e-10)[0]
            left = missing[joint] - change @ (new[near] / scale)
            if np.abs(left * scale).max() < 1e-8 or count >= len(template):
                rows[joint, near] += change
                break
    return rows


def body_members(body: BodyArrays) -> dict[str, np.ndarray]:
    """The arrays of a body under the names of SMPL files.

    Args:
        body: arrays of a body.

    Returns:
        Name → array, float32 but for the regressor, whose digits place the joints.
    """
    parents = np.array(body.tree.parents)
    members = {
        "v_template": body.v_template.astype(np.float32),
        "f": body.faces.astype(np.int32),
        "weights": body.weights.astype(np.float32),
        "kintree_table": np.stack([parents, np.arange(len(parents))]).astype(np.int32),
        "J_regressor": body.joint_regressor,
        "shapedirs": body.shapedirs.astype(np.float32),
    }
    if body.posedirs.any():
        members["posedirs"] = body.posedirs.astype(np.float32)
    if body.corner_uv is not None:
        flat, place = np.unique(body.corner_uv.reshape(-1, 2), axis=0, return_inverse=True)
        members["vt"] = flat.astype(np.float32)
        members["ft"] = place.reshape(-1, 3).astype(np.int32)
    return members


def build_body(
    source: str | os.PathLike[str] | None = None,
    *,
    betas: Sequence[float] | Float[np.ndarray, "B"] = (),
    height: float | None = None,
    num_faces: int | None = None,
) -> BodyArrays:
    """The body of a subject.

    Args:
        source: an SMPL, SMPL-H or SMPL-X file; None is the free body of the package.
        betas: shape coefficients that become the mean shape.
        height: extent along y in the rest pose, metres; None leaves the size.
        num_faces: level of detail; None keeps all faces.

    Returns:
        Its arrays.

    Raises:
        InputError: a file that is no body, or requests that it does not fit.

    >>> build_body(height=1.5, num_faces=400).faces.shape
    (400, 3)
    """
    body = shaped_body(read_body(_default_path() if source is None else source), betas, height)
    return body if num_faces is None else coarse_body(body, num_faces)


def write_body(path: str | os.PathLike[str], body: BodyArrays) -> Path:
    """Write a body file that `BodyModel.load` reads, whole or not at all.

    Args:
        path: the file, ending in .npz; its folder must exist.
        body: what to write; it is checked first as a reader would.

    Returns:
        The path.

    Raises:
        InputError: another ending, no such folder, or arrays that do not agree.
    """
    target = Path(path)
    if target.suffix.lower() != ".npz":
        raise InputError(f"{target}: expected a file that ends in .npz, found {target.suffix!r}")
    members: dict[str, Any] = {**body_members(body)}
    check_body(dict(members), str(target))
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **members)
    return write_bytes(target, buffer.getvalue())
