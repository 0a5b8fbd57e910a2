"""Which stress measures which public operation, and which operations have none, with the reason.

A test compares this list with the public names of geometry and fields, and runs every stress that
is named here to see that it calls what it is said to measure.
"""

import importlib
import inspect
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType
from typing import Any

_ALSO = {
    "rigid": ("geometry.rigid", "rigid"),
    "unskin": ("geometry.skinning", "unskin"),
    "unwrap": ("geometry.unwrap", "unwrap"),
    "attend": ("fields.fusion", "attend"),
    "visible_samples": ("fields.occupancy", "visible_samples"),
    "row_adam": ("fields.row_adam", "row_adam"),
}
"""Operations that share their name with a room, or are public in their room alone."""

COVERED: dict[str, str] = {
    # rotations, maps, bodies
    "axis_angle_to_rotmat": "axis_angle_to_rotmat",
    "rotmat_to_quat_wxyz": "rotmat_to_quat_wxyz",
    "rotmat_to_axis_angle": "rotmat_to_axis_angle",
    "quat_wxyz_to_rotmat": "quat_wxyz_to_rotmat",
    "rotation_angle": "rotation_angle",
    "invert_affine": "invert_affine",
    "transform_points": "transform_points",
    "forward_kinematics": "forward_kinematics",
    "blend_skin": "blend_skin",
    "blend_transforms": "unskin",
    "skin": "blend_skin",
    "joint_motion": "joint_motion",
    "unskin": "unskin",
    "BodyModel.__call__": "body",
    "BodyModel.shaped": "body",
    "PosedBody.to_world": "to_world",
    "PosedBody.to_local": "to_local",
    "convert_smplx_translation": "smplx_translation",
    "inverse_skin": "inverse_skin",
    "inverse_skin_all": "inverse_skin_all",
    "DiffusedField.weights_at": "diffused_weights",
    "DiffusedField.search": "diffused_weights",
    "DiffusedField.maps": "diffused_jacobian",
    "DiffusedField.at": "diffused_jacobian",
    "DiffusedField.weights_on": "diffused_jacobian",
    # surfaces, shells, parts
    "SurfaceIndex.query": "closest_point",
    "closest_point": "closest_point",
    "signed_distance": "signed_distance",
    "vertex_normals": "vertex_normals",
    "consistency_loss": "consistency_loss",
    "round_trip": "round_trip",
    "BodyShell.occupied": "shell",
    "BodyShell.bits": "shell",
    "BodyShell.intervals": "shell_intervals",
    "BodyShell.sample": "shell_sample",
    "PosedParts.pairs": "posed_parts",
    "PosedParts.unskin": "posed_parts_unskin",
    "PosedParts.on_part": "on_part",
    "PosedParts.reskin": "reskin",
    "PosedParts.world_normals": "world_normals",
    "PosedParts.interpolate": "world_normals",
    "MovingParts.follow": "follow",
    "MovingParts.like": "follow",
    "PartMap.vertex_parts": "part_map",
    "PartMap.face_parts": "part_map",
    # cameras, rays, boxes
    "Camera.look_at": "look_at",
    "Camera.project": "project",
    "Camera.pixel_slopes": "pixel_slopes",
    "Camera.to_camera": "to_camera",
    "Camera.visible": "visible",
    "Camera.valid_pixels": "visible",
    "Camera.rays": "rays",
    "Camera.rays_with_mask": "undistort",
    "Camera.pixel_grid": "undistorted",
    "Camera.undistorted": "undistorted",
    "Camera.without_lens": "undistorted",
    "Camera.resized": "resized_cropped",
    "Camera.cropped": "resized_cropped",
    "Camera.from_legacy_pixels": "resized_cropped",
    "Rays.at": "rays_at",
    "orbit_cameras": "orbit_cameras",
    "ring_of_cameras": "ring_of_cameras",
    "blend_cameras": "blend_cameras",
    "camera_to_opengl": "camera_conventions",
    "camera_from_opengl": "camera_conventions",
    "camera_to_blender": "camera_conventions",
    "camera_from_blender": "camera_conventions",
    "camera_to_pytorch3d": "camera_conventions",
    "camera_from_pytorch3d": "camera_conventions",
    "ray_box": "ray_box",
    "box_of": "box_of",
    "in_box": "in_box",
    "box_mask": "box_mask",
    # textures
    "UVMap.at_faces": "uv",
    "UVMap.at": "uv",
    "UVHit.point": "uv_locate",
    "UVIndex.locate": "uv_locate",
    "transfer_uv": "transfer_uv",
    "uv_report": "uv_report",
    "texel_map": "texel_map",
    "TexelMap.of_corners": "texel_map",
    "fill_gutter": "fill_gutter",
    "sample_texture": "sample_texture",
    # meshes as arrays
    "surface_distance": "surface_distance",
    "part_bands": "part_bands",
    "face_graph": "mesh_graphs",
    "vertex_graph": "mesh_graphs",
    "smooth_labels": "labels",
    "remove_islands": "labels",
    "heat_weights": "heat_weights",
    "transfer_rows": "transfer_rows",
    "closest_faces": "closest_faces",
    "Similarity.__call__": "similarity",
    "Similarity.inverse": "similarity",
    "align": "align",
    # fields
    "HashGrid.forward": "hash_grid",
    "FrequencyEncoding.forward": "frequency",
    "irradiance_basis": "irradiance_basis",
    "PartMLP.forward": "mlp",
    "ResidualField.forward": "residual",
    "ResidualField.encode": "residual",
    "PartOccupancy.cells_of": "occupancy",
    "PartOccupancy.see": "occupancy_memory",
    "PartOccupancy.keep": "occupancy_keep",
    "visible_samples": "visible_samples",
    "DistancePrior.forward": "distance_prior",
    "PartField.encode": "part_field",
    "PartField.density": "part_field",
    "PartField.color": "part_field",
    "PoseBank.forward": "pose_bank_weights",
    "PoseBank.blend": "pose_bank_blend",
    "CodeFusion.forward": "code_fusion",
    "attend": "attention",
    "row_adam": "row_adam",
    "RowAdam.step": "row_adam_steps",
    "RowAdam.zero_grad": "row_adam_steps",
    "RowAdam.load_state_dict": "row_adam_steps",
    "composite": "composite",
    "project_gaussians": "project_gaussians",
    "render_gaussians": "render_gaussians",
    "union_by_density": "part_union",
}
"""Operation → the stress that calls it."""

_READS = "reads a file; wrong files are tested in tests/geometry/test_body_io.py"
_WHOLE = "whole numbers and names alone, no arithmetic of floats"
_MOVES = "moves numbers to another precision or device, or copies them"
_SHAPE = "picks or stacks rows, no arithmetic"

EXEMPT: dict[str, str] = {
    "BodyModel.load": _READS,
    "BodyModel.default": _READS,
    "read_body_arrays": _READS,
    "read_npy_object": _READS,
    "BodyModel.from_arrays": _MOVES,
    "BodyModel.to": _MOVES,
    "BodyPose.to": _MOVES,
    "Camera.to": _MOVES,
    "UVMap.to": _MOVES,
    "BodyPose.zeros": "makes zeros",
    "BodyModel.canonical": "BodyModel.__call__ in one constant pose",
    "rigid": "puts a rotation and a translation into one matrix, no arithmetic",
    "KinematicTree.from_parents": _WHOLE,
    "PartMap.default": _WHOLE,
    "PartMap.preset": _WHOLE,
    "PartMap.by_name": _WHOLE,
    "PartMap.from_table": _WHOLE,
    "PartMap.joints_of": _WHOLE,
    "preset_table": _WHOLE,
    "table_by_name": _WHOLE,
    "regions_by_name": _WHOLE,
    "PartMap.clean": "smooth_labels and remove_islands over the graphs that are stressed",
    "clean_face_labels": "smooth_labels and remove_islands over the graphs that are stressed",
    "BodyShell.filled": _WHOLE,
    "BodyShell.joined": _SHAPE,
    "ShellSamples.rows": _SHAPE,
    "PosedParts.unculled": _SHAPE,
    "SurfaceIndex.refit": "the search of closest_point over other vertices; equal to a new tree in "
    "tests/geometry/test_face_tree.py",
    "DiffusedField.of": "keeps the last field",
    "MovingParts.unskin": "PosedParts.unskin, poses as constants",
    "MovingParts.reskin": "PosedParts.reskin, poses as constants",
    "unwrap": "minutes of optimisation; tests/geometry/test_unwrap.py counts flips and overlaps, "
    "exactly, over meshes of any size and place",
    "UVReport.to_dict": "a dictionary of a result",
    "PartFieldSpec.grid_specs": "sizes of tables, whole numbers",
    "HashGrid.extra_repr": "text for print",
    "PartMLP.extra_repr": "text for print",
    "PoseBank.extra_repr": "text for print",
}
"""Operation → why no stress measures it."""


def operations() -> dict[str, Callable[..., Any]]:
    """Every public function, and every public method of a public class, of geometry and fields.

    Constructors of result classes, properties and exceptions are no operations.
    """
    out = {}
    for package in ("geometry", "fields"):
        home = importlib.import_module(f"monopart.{package}")
        for name in home.__all__:
            out |= dict(_of(name, getattr(home, name)))
    for name, (room, attribute) in _ALSO.items():
        out[name] = getattr(importlib.import_module(f"monopart.{room}"), attribute)
    return out


def _of(name: str, thing: Any) -> Iterator[tuple[str, Callable[..., Any]]]:
    if inspect.isfunction(thing):
        yield name, thing
    elif inspect.isclass(thing) and not issubclass(thing, Exception):
        for key, value in vars(thing).items():
            plain = getattr(value, "__func__", value)  # of class methods and static ones
            if isinstance(plain, FunctionType) and (key == "__call__" or not key.startswith("_")):
                yield f"{name}.{key}", plain


def code_of(function: Callable[..., Any]) -> CodeType:
    """Code of a function below all decorators: what a profiler sees of a call to it alone."""
    return inspect.unwrap(function).__code__
