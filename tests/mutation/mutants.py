"""Small numerical bugs to plant: where, what stands there, what a slip would have written.

Each text must occur exactly once in its file (`test_mutants.py` checks it on every run of the
suite), so that a mutant cannot silently stop to apply when code moves.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Mutant:
    """One planted bug.

    Attributes:
        name: short and unique.
        kind: class of slip.
        file: the file, from the root of the repository.
        old: text in it.
        new: what the slip would have written.
        tests: test files that should see it, in the order in which they are run.
    """

    name: str
    kind: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


def _geometry(*names: str) -> tuple[str, ...]:
    return tuple(f"tests/geometry/test_{name}.py" for name in names)


def _fields(*names: str) -> tuple[str, ...]:
    return tuple(f"tests/fields/test_{name}.py" for name in names)


def _toolkit(*names: str) -> tuple[str, ...]:
    return tuple(f"tests/toolkit/test_{name}.py" for name in names)


GEOMETRY = (
    Mutant(
        "rotations turn left",
        "wrong hand",
        "geometry/rotations.py",
        "ax, ay, az = a * x, a * y, a * z",
        "ax, ay, az = -a * x, -a * y, -a * z",
        _geometry("rotations"),
    ),
    Mutant(
        "a term of the series of the sine",
        "sign",
        "geometry/rotations.py",
        "_SINC_SERIES = (1.0, -1 / 6, 1 / 120, -1 / 5040,",
        "_SINC_SERIES = (1.0, -1 / 6, 1 / 120, 1 / 5040,",
        _geometry("rotations"),
    ),
    Mutant(
        "a length without a guard at zero",
        "missing eps",
        "geometry/norms.py",
        "torch.where(zero, 1.0, square).sqrt()",
        "square.sqrt()",
        _geometry("consistency", "surface"),
    ),
    Mutant(
        "the inverse does not turn the shift",
        "ignored rotation",
        "geometry/rigid.py",
        "rigid(inverse, -apply_linear(inverse, offset))",
        "rigid(inverse, -offset)",
        _geometry("rigid"),
    ),
    Mutant(
        "kinematics: gradient through the parent",
        "transposed matrix",
        "geometry/kernels/kinematics.py",
        "grad_offset = wp.transpose(up) * grad_offset",
        "grad_offset = up * grad_offset",
        _geometry("kinematics"),
    ),
    Mutant(
        "skinning: gradient of the translation",
        "ignored translation",
        "geometry/kernels/skin.py",
        "p = points[v]\n        q = wp.vec4(p[0], p[1], p[2], 1.0)",
        "p = points[v]\n        q = wp.vec4(p[0], p[1], p[2], 0.0)",
        _geometry("skinning", "body"),
    ),
    Mutant(
        "skinning: the last, incomplete run is not summed",
        "wrong reduction",
        "geometry/skinning.py",
        "for at in range(0, count, _RUN)]",
        "for at in range(0, count - _RUN + 1, _RUN)]",
        _geometry("skinning", "body"),
    ),
    Mutant(
        "world to local",
        "transposed matrix",
        "geometry/body.py",
        "(points - self.translation[..., None, :]) @ self.rotation\n",
        "(points - self.translation[..., None, :]) @ self.rotation.mT\n",
        _geometry("body"),
    ),
    Mutant(
        "entries of the pose blend feature",
        "transposed matrix",
        "geometry/body.py",
        "feature = (rotmats[..., 1:, :, :] - identity)",
        "feature = (rotmats[..., 1:, :, :].mT - identity)",
        _geometry("body"),
    ),
    Mutant(
        "a refit keeps the old vertices for its hits",
        "stale vertices",
        "geometry/surface.py",
        "        self.verts = verts\n        if self._tree is not None:",
        "        if self._tree is not None:",
        _geometry("face_tree", "surface"),
    ),
    Mutant(
        "boxes of inner nodes",
        "swapped axis",
        "geometry/kernels/face_tree.py",
        "wp.vec3(boxes[row + 3, k], boxes[row + 4, k], boxes[row + 5, k])",
        "wp.vec3(boxes[row + 3, k], boxes[row + 5, k], boxes[row + 4, k])",
        _geometry("face_tree", "surface"),
    ),
    Mutant(
        "pixel centres of old captures, in y",
        "half a pixel",
        "geometry/cameras.py",
        "shift[:2, 2] = 0.5",
        "shift[:1, 2] = 0.5",
        _geometry("cameras"),
    ),
    Mutant(
        "the skew of K",
        "transposed matrix",
        "geometry/cameras.py",
        "plane @ K[:2, :2].mT + K[:2, 2]",
        "plane @ K[:2, :2] + K[:2, 2]",
        (*_geometry("cameras"), "tests/properties/test_cameras_and_boxes.py"),
    ),
    Mutant(
        "a tangential term of the lens's Jacobian",
        "wrong factor",
        "geometry/distortion.py",
        "du_dx = factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x",
        "du_dx = factor + 2 * x * x * slope + 2 * p1 * y + 2 * p2 * x",
        _geometry("distortion"),
    ),
    Mutant(
        "boxes behind the eye are hit",
        "missing clamp",
        "geometry/boxes.py",
        "(leave >= enter) & (leave >= 0) & ~parallel",
        "(leave >= enter) & ~parallel",
        _geometry("boxes"),
    ),
    Mutant(
        "voxels are marked about their corners",
        "half a pixel",
        "geometry/kernels/shell.py",
        "p = (verts[b, v] - origin) * inverse - wp.vec3(0.5, 0.5, 0.5)",
        "p = (verts[b, v] - origin) * inverse",
        _geometry("culling"),
    ),
    Mutant(
        "texture coordinates of two corners",
        "wrong seam UV",
        "geometry/kernels/closest.py",
        "corner_uv[f, 1] * w[1] + corner_uv[f, 2] * w[2]",
        "corner_uv[f, 1] * w[2] + corner_uv[f, 2] * w[1]",
        _geometry("posed_parts"),
    ),
    Mutant(
        "one corner in Newton's Jacobian",
        "wrong corner",
        "geometry/kernels/newton.py",
        "r1 += gb * wp.dot(b1 - a1, h) + gc * wp.dot(c1 - a1, h)",
        "r1 += gb * wp.dot(b1 - a1, h) + gc * wp.dot(c1 - b1, h)",
        _geometry("unskin"),
    ),
    Mutant(
        "the implicit derivative of a rest point",
        "sign",
        "geometry/unskin.py",
        "step = apply_linear(inverse, points - at.image)",
        "step = apply_linear(inverse, at.image - points)",
        _geometry("unskin"),
    ),
    Mutant(
        "distances at the threshold count",
        "wrong threshold side",
        "geometry/consistency.py",
        "over = ~(distance <= threshold)",
        "over = ~(distance < threshold)",
        _geometry("consistency"),
    ),
    Mutant(
        "axes in which a joint turns",
        "wrong frame",
        "geometry/pose_motion.py",
        "transforms[parents, :3, :3].mT.clone()",
        "transforms[parents, :3, :3].clone()",
        _geometry("pose_motion"),
    ),
)

FIELDS = (
    Mutant(
        "hash grid: shares of two corners in the scatter",
        "swapped axis",
        "fields/kernels/hash_grid.py",
        "s * t * r, u[j] * t * r, s * v[j] * r, u[j] * v[j] * r,",
        "s * t * r, s * v[j] * r, u[j] * t * r, u[j] * v[j] * r,",
        _fields("hash_grid"),
    ),
    Mutant(
        "hash grid: slope above one",
        "missing clamp",
        "fields/kernels/hash_grid.py",
        "if raw[axis] < 0.0 or raw[axis] > 1.0:",
        "if raw[axis] < 0.0:",
        _fields("hash_grid"),
    ),
    Mutant(
        "compositing: what a sample hides, in the gradient",
        "missing term",
        "fields/kernels/volume.py",
        "grad_optical[i] = behind[i] * g - suffix",
        "grad_optical[i] = behind[i] * g",
        _fields("volume"),
    ),
    Mutant(
        "opacity of thin samples by a difference",
        "missing eps",
        "fields/kernels/volume.py",
        "    if x < 0.1:",
        "    if x < 0.0:",
        _fields("volume"),
    ),
    Mutant(
        "equal densities go to the last part",
        "wrong threshold side",
        "fields/part_union.py",
        "better = ~(table[k] <= value)",
        "better = ~(table[k] < value)",
        _fields("part_union"),
    ),
    Mutant(
        "nodes of the distance grid",
        "half a pixel",
        "fields/distance_prior.py",
        "align_corners=True",
        "align_corners=False",
        _fields("distance_prior"),
    ),
    Mutant(
        "the remembered maximum never falls",
        "stale memory",
        "fields/occupancy.py",
        "torch.where(first, 0.0, old * self.decay)",
        "torch.where(first, 0.0, old)",
        _fields("occupancy"),
    ),
    Mutant(
        "a wall hides itself",
        "off by one",
        "fields/occupancy.py",
        "before = total - wall",
        "before = total",
        _fields("occupancy"),
    ),
    Mutant(
        "steps that a row has missed",
        "off by one",
        "fields/kernels/adam.py",
        "wp.min(now - seen[i] - 1, decay.shape[0] - 1)",
        "wp.min(now - seen[i], decay.shape[0] - 1)",
        _fields("row_adam"),
    ),
)

TOOLKIT = (
    Mutant(
        "translations of a capture",
        "wrong unit",
        "toolkit/captures/annots.py",
        "T.reshape(-1) / 1000",
        "T.reshape(-1) / 100",
        _toolkit("captures"),
    ),
    Mutant(
        "the map of undistortion",
        "half a pixel",
        "toolkit/captures/records.py",
        ".undistorted()[1].numpy() - 0.5",
        ".undistorted()[1].numpy()",
        _toolkit("captures"),
    ),
    Mutant(
        "pixels of a batch",
        "half a pixel",
        "toolkit/captures/patches.py",
        "torch.stack([x, y], -1).float() + 0.5",
        "torch.stack([x, y], -1).float()",
        _toolkit("patches", "metamorphic"),
    ),
    Mutant(
        "the forward map reuses the weights of the way back",
        "stale weights",
        "toolkit/losses.py",
        "    hit = canonical_parts.on_part(points, part)\n",
        "    hit = canonical_parts.on_part(points, part)\n"
        "    two = pairs.bary[rows]\n"
        "    full = torch.cat([two, 1 - two.sum(-1, keepdim=True)], -1)\n"
        "    hit = type(hit)(pairs.face[rows], full, hit.uv, hit.found)\n",
        _toolkit("losses"),
    ),
    Mutant(
        "the background of the target lies on the person",
        "wrong side of the mask",
        "toolkit/train.py",
        "(~batch.mask)[:, None] * ground",
        "batch.mask[:, None] * ground",
        _toolkit("losses"),
    ),
    Mutant(
        "gradients of appearance codes add up in any order",
        "order of a sum",
        "toolkit/appearance.py",
        "frames.code.index_select(0, owner)",
        "frames.code[owner]",
        _toolkit("determinism"),
    ),
    Mutant(
        "depth does not heed the light that is left",
        "missing factor",
        "toolkit/march.py",
        "depth += light * distance(out)",
        "depth += distance(out)",
        _toolkit("model", "metamorphic"),
    ),
    Mutant(
        "rays of a batch in local axes",
        "transposed matrix",
        "toolkit/scene.py",
        '"ni,nij->nj", rays.directions',
        '"nj,nij->ni", rays.directions',
        _toolkit("model", "metamorphic"),
    ),
    Mutant(
        "data range of the published SSIM",
        "wrong unit",
        "toolkit/metrics.py",
        'data_range = 1.0 if protocol == "strict" else 2.0',
        "data_range = 1.0",
        _toolkit("metrics"),
    ),
    Mutant(
        "weights of remembered poses",
        "missing square",
        "toolkit/memory.py",
        "(first - near) * (first + near) / (2 * width**2)",
        "(first - near) / (2 * width**2)",
        _toolkit("memory"),
    ),
    Mutant(
        "a surface takes its picture along",
        "wrong sign",
        "toolkit/pose_alignment.py",
        "change = -torch.einsum(",
        "change = torch.einsum(",
        _toolkit("pose_alignment"),
    ),
)

MUTANTS = GEOMETRY + FIELDS + TOOLKIT
ALLOWED_TO_SURVIVE = 1
