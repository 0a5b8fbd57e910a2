"""Differentiable body geometry, importable alone.

Every public name can be imported from here or from its room; the rooms load on first use, so
importing this package costs nothing and has no effects. Three names are those of rooms and stay
rooms here: take the functions with ``from monopart.geometry.rigid import rigid``,
``from monopart.geometry.skinning import unskin`` and
``from monopart.geometry.unwrap import unwrap``.
"""

if __name__ != "monopart.geometry":  # a bare import would copy every class
    raise ImportError(f"import monopart.geometry, not {__name__!r}")

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .alignment import Similarity as Similarity
    from .alignment import align as align
    from .body import BodyModel as BodyModel
    from .body import BodyPose as BodyPose
    from .body import PosedBody as PosedBody
    from .body import convert_smplx_translation as convert_smplx_translation
    from .body_io import read_body_arrays as read_body_arrays
    from .body_io import read_npy_object as read_npy_object
    from .bone_heat import heat_weights as heat_weights
    from .boxes import box_mask as box_mask
    from .boxes import box_of as box_of
    from .boxes import in_box as in_box
    from .boxes import ray_box as ray_box
    from .camera_conventions import BlenderCamera as BlenderCamera
    from .camera_conventions import PyTorch3DCamera as PyTorch3DCamera
    from .camera_conventions import camera_from_blender as camera_from_blender
    from .camera_conventions import camera_from_opengl as camera_from_opengl
    from .camera_conventions import camera_from_pytorch3d as camera_from_pytorch3d
    from .camera_conventions import camera_to_blender as camera_to_blender
    from .camera_conventions import camera_to_opengl as camera_to_opengl
    from .camera_conventions import camera_to_pytorch3d as camera_to_pytorch3d
    from .camera_paths import blend_cameras as blend_cameras
    from .camera_paths import orbit_cameras as orbit_cameras
    from .camera_paths import ring_of_cameras as ring_of_cameras
    from .cameras import Camera as Camera
    from .cameras import Rays as Rays
    from .consistency import consistency_loss as consistency_loss
    from .consistency import round_trip as round_trip
    from .culling import BodyShell as BodyShell
    from .culling import ShellSamples as ShellSamples
    from .diffused_weights import DiffusedField as DiffusedField
    from .errors import BackendError as BackendError
    from .errors import InputError as InputError
    from .errors import MonopartError as MonopartError
    from .geodesics import PartBands as PartBands
    from .geodesics import part_bands as part_bands
    from .geodesics import surface_distance as surface_distance
    from .kinematics import KinematicTree as KinematicTree
    from .kinematics import forward_kinematics as forward_kinematics
    from .mesh_graph import MeshGraph as MeshGraph
    from .mesh_graph import face_graph as face_graph
    from .mesh_graph import vertex_graph as vertex_graph
    from .moving_parts import MovingParts as MovingParts
    from .part_cleaning import clean_face_labels as clean_face_labels
    from .part_cleaning import remove_islands as remove_islands
    from .part_cleaning import smooth_labels as smooth_labels
    from .part_tables import preset_table as preset_table
    from .part_tables import regions_by_name as regions_by_name
    from .part_tables import table_by_name as table_by_name
    from .parts import PartMap as PartMap
    from .pose_motion import joint_motion as joint_motion
    from .posed_parts import PartPairs as PartPairs
    from .posed_parts import PosedParts as PosedParts
    from .posed_parts import RestPoints as RestPoints
    from .rigid import invert_affine as invert_affine
    from .rigid import transform_points as transform_points
    from .rotations import axis_angle_to_rotmat as axis_angle_to_rotmat
    from .rotations import quat_wxyz_to_rotmat as quat_wxyz_to_rotmat
    from .rotations import rotation_angle as rotation_angle
    from .rotations import rotmat_to_axis_angle as rotmat_to_axis_angle
    from .rotations import rotmat_to_quat_wxyz as rotmat_to_quat_wxyz
    from .skinning import SkinWeights as SkinWeights
    from .skinning import blend_skin as blend_skin
    from .skinning import blend_transforms as blend_transforms
    from .skinning import skin as skin
    from .surface import SurfaceHit as SurfaceHit
    from .surface import SurfaceIndex as SurfaceIndex
    from .surface import closest_point as closest_point
    from .surface import signed_distance as signed_distance
    from .surface import vertex_normals as vertex_normals
    from .unskin import Unskinned as Unskinned
    from .unskin import inverse_skin as inverse_skin
    from .unskin_roots import UnskinnedRoots as UnskinnedRoots
    from .unskin_roots import inverse_skin_all as inverse_skin_all
    from .unwrap import UnwrapOptions as UnwrapOptions
    from .unwrap import UVLayout as UVLayout
    from .uv import UVMap as UVMap
    from .uv_lookup import UVHit as UVHit
    from .uv_lookup import UVIndex as UVIndex
    from .uv_lookup import transfer_uv as transfer_uv
    from .uv_measure import UVReport as UVReport
    from .uv_measure import uv_report as uv_report
    from .uv_texture import TexelMap as TexelMap
    from .uv_texture import fill_gutter as fill_gutter
    from .uv_texture import sample_texture as sample_texture
    from .uv_texture import texel_map as texel_map
    from .weight_transfer import closest_faces as closest_faces
    from .weight_transfer import transfer_rows as transfer_rows

_ROOM = {
    "BackendError": "errors",
    "BlenderCamera": "camera_conventions",
    "BodyModel": "body",
    "BodyPose": "body",
    "BodyShell": "culling",
    "Camera": "cameras",
    "DiffusedField": "diffused_weights",
    "InputError": "errors",
    "KinematicTree": "kinematics",
    "MeshGraph": "mesh_graph",
    "MonopartError": "errors",
    "MovingParts": "moving_parts",
    "PartBands": "geodesics",
    "PartMap": "parts",
    "PartPairs": "posed_parts",
    "PosedBody": "body",
    "PosedParts": "posed_parts",
    "PyTorch3DCamera": "camera_conventions",
    "Rays": "cameras",
    "RestPoints": "posed_parts",
    "ShellSamples": "culling",
    "Similarity": "alignment",
    "SkinWeights": "skinning",
    "SurfaceHit": "surface",
    "SurfaceIndex": "surface",
    "TexelMap": "uv_texture",
    "UVHit": "uv_lookup",
    "UVIndex": "uv_lookup",
    "UVLayout": "unwrap",
    "UVMap": "uv",
    "UVReport": "uv_measure",
    "Unskinned": "unskin",
    "UnskinnedRoots": "unskin_roots",
    "UnwrapOptions": "unwrap",
    "align": "alignment",
    "axis_angle_to_rotmat": "rotations",
    "blend_cameras": "camera_paths",
    "blend_skin": "skinning",
    "blend_transforms": "skinning",
    "box_mask": "boxes",
    "box_of": "boxes",
    "camera_from_blender": "camera_conventions",
    "camera_from_opengl": "camera_conventions",
    "camera_from_pytorch3d": "camera_conventions",
    "camera_to_blender": "camera_conventions",
    "camera_to_opengl": "camera_conventions",
    "camera_to_pytorch3d": "camera_conventions",
    "clean_face_labels": "part_cleaning",
    "closest_faces": "weight_transfer",
    "closest_point": "surface",
    "consistency_loss": "consistency",
    "convert_smplx_translation": "body",
    "face_graph": "mesh_graph",
    "fill_gutter": "uv_texture",
    "forward_kinematics": "kinematics",
    "heat_weights": "bone_heat",
    "in_box": "boxes",
    "inverse_skin": "unskin",
    "inverse_skin_all": "unskin_roots",
    "invert_affine": "rigid",
    "joint_motion": "pose_motion",
    "orbit_cameras": "camera_paths",
    "part_bands": "geodesics",
    "preset_table": "part_tables",
    "quat_wxyz_to_rotmat": "rotations",
    "ray_box": "boxes",
    "read_body_arrays": "body_io",
    "read_npy_object": "body_io",
    "regions_by_name": "part_tables",
    "remove_islands": "part_cleaning",
    "ring_of_cameras": "camera_paths",
    "rotation_angle": "rotations",
    "rotmat_to_axis_angle": "rotations",
    "rotmat_to_quat_wxyz": "rotations",
    "round_trip": "consistency",
    "sample_texture": "uv_texture",
    "signed_distance": "surface",
    "skin": "skinning",
    "smooth_labels": "part_cleaning",
    "surface_distance": "geodesics",
    "table_by_name": "part_tables",
    "texel_map": "uv_texture",
    "transfer_rows": "weight_transfer",
    "transfer_uv": "uv_lookup",
    "transform_points": "rigid",
    "uv_report": "uv_measure",
    "vertex_graph": "mesh_graph",
    "vertex_normals": "surface",
}
__all__ = list(_ROOM)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> object:
    if name not in _ROOM:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_ROOM[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_ROOM})
