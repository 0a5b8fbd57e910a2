"""One test per line of docs/conventions.md."""

import ast
import json
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from building import ROOT, source_files

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.cameras import Camera
from monopart.geometry.kinematics import KinematicTree, forward_kinematics
from monopart.geometry.parts import PartMap
from monopart.geometry.rigid import invert_affine, rigid, transform_points
from monopart.geometry.rotations import axis_angle_to_rotmat, rotmat_to_quat_wxyz
from monopart.geometry.skinning import blend_transforms, skin
from monopart.geometry.surface import closest_point, signed_distance, vertex_normals
from monopart.geometry.uv import UVMap
from monopart.toolkit.captures import read_capture
from monopart.toolkit.captures.records import CaptureRecord
from monopart.toolkit.video import write_video

X, Y, Z = torch.eye(3)
LEFT_WRIST, RIGHT_WRIST, HEAD, PELVIS, LEFT_FOOT, LEFT_ANKLE = 20, 21, 15, 0, 10, 7


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return BodyModel.default()


@pytest.fixture(scope="module")
def record() -> CaptureRecord:
    return read_capture(ROOT / "examples" / "capture")


def pinhole(**changes: object) -> Camera:
    values = {
        "K": torch.tensor([[100.0, 0.0, 32.0], [0.0, 100.0, 24.0], [0.0, 0.0, 1.0]]),
        "R": torch.eye(3),
        "t": torch.zeros(3),
        "size": (48, 64),
    }
    return Camera(**(values | changes))  # pyright: ignore[reportArgumentType]


def test_every_line_has_its_test_and_every_test_its_line() -> None:
    lines = [
        line
        for line in (ROOT / "docs" / "conventions.md").read_text().splitlines()
        if re.match(r"\d+\. ", line)
    ]
    found = [re.fullmatch(r"(\d+)\. .*[.)] `(test_\w+)`", line) for line in lines]
    assert all(found), [line for line, match in zip(lines, found, strict=True) if not match]
    assert [int(match[1]) for match in found if match] == list(range(1, len(lines) + 1))
    named = [match[2] for match in found if match]
    tests = [
        node.name
        for node in ast.parse(Path(__file__).read_text()).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    ]
    assert named == tests[1:]


def test_lengths_are_metres(body: BodyModel) -> None:
    extent = body.v_template.amax(0) - body.v_template.amin(0)
    assert 1.4 < float(extent[1]) < 2.2


def test_angles_are_radians() -> None:
    turned = axis_angle_to_rotmat(math.pi * Z) @ X
    torch.testing.assert_close(turned, -X, atol=1e-6, rtol=0)


def test_times_are_seconds(tmp_path: Path) -> None:
    frames = [np.full((32, 32, 3), i / 10, np.float32) for i in range(10)]
    write_video(tmp_path / "clip.mp4", frames, fps=5.0)
    video = cv2.VideoCapture(str(tmp_path / "clip.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) / video.get(cv2.CAP_PROP_FPS) == pytest.approx(2.0)


def test_vectors_are_columns() -> None:
    rotmat, shift = axis_angle_to_rotmat(torch.tensor([0.1, 0.7, -0.4])), torch.tensor([1.0, 2, 3])
    transform = rigid(rotmat, shift)
    torch.testing.assert_close(transform[:3, 3], shift)
    torch.testing.assert_close(transform[3], torch.tensor([0.0, 0, 0, 1]))
    torch.testing.assert_close(transform_points(transform, X), rotmat[:, 0] + shift)


def test_rotations_are_right_handed() -> None:
    quarter = math.pi / 2
    for axis, start, end in ((Z, X, Y), (X, Y, Z), (Y, Z, X)):
        turned = axis_angle_to_rotmat(quarter * axis) @ start
        torch.testing.assert_close(turned, end, atol=1e-6, rtol=0)


def test_quaternions_have_w_first() -> None:
    quat = rotmat_to_quat_wxyz(axis_angle_to_rotmat(torch.tensor([0.6, 0.0, 0.0])))
    expected = torch.tensor([math.cos(0.3), math.sin(0.3), 0.0, 0.0])
    torch.testing.assert_close(quat * quat[0].sign(), expected, atol=1e-6, rtol=0)


def test_world_to_camera() -> None:
    rotmat, shift = axis_angle_to_rotmat(torch.tensor([0.2, -0.3, 0.1])), torch.tensor([0.1, 0, 3])
    camera = pinhole(R=rotmat, t=shift)
    point = torch.tensor([0.3, -0.2, 0.5])
    local = rotmat @ point + shift
    pixels, depth = camera.project(point)
    homogeneous = camera.K @ local
    torch.testing.assert_close(depth, local[2])
    torch.testing.assert_close(pixels, homogeneous[:2] / homogeneous[2])
    torch.testing.assert_close(camera.center, -rotmat.T @ shift)


def test_camera_axes_are_opencv() -> None:
    camera = pinhole()
    centre, _ = camera.project(2 * Z)
    right, depth = camera.project(2 * Z + 0.1 * X)
    down, _ = camera.project(2 * Z + 0.1 * Y)
    assert right[0] > centre[0]
    assert down[1] > centre[1]
    assert float(depth) == 2.0
    assert float(camera.project(-2 * Z)[1]) == -2.0


def test_pixel_centres_are_at_one_half() -> None:
    grid = pinhole().pixel_grid()
    assert grid.shape == (48, 64, 2)
    assert grid[5, 7].tolist() == [7.5, 5.5]
    assert grid[-1, -1].tolist() == [63.5, 47.5]


def test_resize_and_crop_are_exact() -> None:
    camera, points = pinhole(), torch.randn(20, 3) * 0.2 + 3 * Z
    pixels, _ = camera.project(points)
    halved, _ = camera.resized(0.5).project(points)
    torch.testing.assert_close(halved, pixels / 2)
    cropped, _ = camera.cropped((10, 4, 40, 30)).project(points)
    torch.testing.assert_close(cropped, pixels - torch.tensor([10.0, 4.0]))


def test_sizes_are_height_width(record: CaptureRecord) -> None:
    assert pinhole().cropped((10, 4, 40, 30)).size == (26, 30)
    assert tuple(record.image(0, 0).shape[:2]) == record.image_size == record.cameras[0].size


def test_rays_have_unit_directions() -> None:
    camera = pinhole(t=torch.tensor([0.0, 0.0, 2.0]))
    rays = camera.rays(camera.pixel_grid())
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(48, 64))
    moved = rays.at(torch.full((48, 64), 3.0)) - camera.center
    torch.testing.assert_close(moved.norm(dim=-1), torch.full((48, 64), 3.0))


def test_distortion_is_in_opencv_order() -> None:
    coefficients = torch.tensor([-0.2, 0.05, 0.01, -0.02, 0.03])
    points = torch.rand(50, 3, dtype=torch.float64) - 0.5 + 2 * Z
    camera = pinhole(distortion=coefficients)
    zero = np.zeros(3)
    K = camera.K.double().numpy()
    expected, _ = cv2.projectPoints(points.numpy(), zero, zero, K, coefficients.double().numpy())
    pixels, _ = camera.project(points)
    np.testing.assert_allclose(pixels.numpy(), expected[:, 0], atol=1e-4)


def test_body_axes(body: BodyModel) -> None:
    _, joints = body.shaped(torch.zeros(body.num_betas))
    assert joints[HEAD, 1] > joints[PELVIS, 1] + 0.3
    assert joints[LEFT_WRIST, 0] > 0.3
    assert joints[RIGHT_WRIST, 0] < -0.3
    assert joints[LEFT_FOOT, 2] > joints[LEFT_ANKLE, 2] + 0.05


def test_faces_point_outwards(body: BodyModel) -> None:
    a, b, c = body.v_template[body.faces].unbind(1)
    volume = float((a * torch.linalg.cross(b, c)).sum() / 6)
    assert 0.03 < volume < 0.2  # cubic metres


def test_rh_and_th(body: BodyModel) -> None:
    still = BodyPose.zeros(body)
    turn, shift = torch.tensor([0.4, -1.1, 0.2]), torch.tensor([0.5, 1.0, -2.0])
    posed = body(BodyPose(still.pose, still.betas, turn, shift))
    expected = posed.verts @ axis_angle_to_rotmat(turn).T + shift
    torch.testing.assert_close(posed.verts_world, expected, atol=1e-6, rtol=0)
    origin = posed.to_world(torch.zeros(1, 3))
    torch.testing.assert_close(origin, shift[None])


def test_transforms_leave_pose_blend_shapes_out(body: BodyModel) -> None:
    pose = 0.5 * torch.randn(body.num_joints, 3)
    still = BodyPose.zeros(body)
    posed = body(BodyPose(pose, still.betas, still.rotation, still.translation))
    rest, joints = body.shaped(still.betas)
    expected = forward_kinematics(body.tree, axis_angle_to_rotmat(pose), joints)
    torch.testing.assert_close(posed.transforms, expected, atol=1e-6, rtol=0)
    rotmats = axis_angle_to_rotmat(pose)
    feature = (rotmats[1:] - torch.eye(3)).reshape(-1)
    offsets = body.posedirs @ feature
    blended = blend_transforms(posed.transforms, body.weights)
    torch.testing.assert_close(posed.verts, skin(rest + offsets, blended), atol=1e-5, rtol=0)


def test_canonical_is_the_big_pose(body: BodyModel) -> None:
    betas = torch.zeros(body.num_betas)
    pose = torch.zeros(body.num_joints, 3)
    pose[1, 2], pose[2, 2] = math.radians(30), -math.radians(30)
    expected = body(BodyPose(pose, betas, torch.zeros(3), torch.zeros(3)))
    canonical = body.canonical(betas)
    torch.testing.assert_close(canonical.verts, expected.verts)
    assert canonical.joints[LEFT_ANKLE, 0] > body.shaped(betas)[1][LEFT_ANKLE, 0] + 0.2


def test_parts_are_in_order(body: BodyModel) -> None:
    parts = PartMap.default()
    assert parts.names == ("body", "legs", "head", "left_arm", "right_arm")
    joints = [set(parts.joints_of(k)) for k in range(5)]
    assert joints[0] == {0, 3, 6, 9, 13, 14}
    assert joints[1] == {1, 2, 4, 5, 7, 8, 10, 11}
    assert joints[2:] == [{12, 15}, {16, 18, 20, 22}, {17, 19, 21, 23}]
    labels = parts.vertex_parts(body.weights)
    assert torch.equal(labels, torch.tensor(parts.joint_part)[body.weights.argmax(1)])
    assert bool((body.v_template[labels == 3, 0] > 0).all())  # left is +x


def test_uv_belongs_to_face_corners(body: BodyModel) -> None:
    corner_uv = torch.tensor(
        [[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], [[0.5, 0.5], [0.9, 0.5], [0.5, 0.9]]]
    )
    at_corner = UVMap(corner_uv).at_faces(torch.tensor([0, 1]), torch.tensor([[1.0, 0, 0]] * 2))
    torch.testing.assert_close(at_corner, corner_uv[:, 0])
    assert body.uv is not None
    assert body.uv.corner_uv.shape == (len(body.faces), 3, 2)


def test_barycentrics_follow_the_corners() -> None:
    verts, faces = torch.stack([X, Y, Z]), torch.tensor([[2, 0, 1]])
    hit = closest_point(Y[None] * 1.5, verts, faces)
    torch.testing.assert_close(hit.bary, torch.tensor([[0.0, 0.0, 1.0]]), atol=1e-6, rtol=0)


def test_signed_distance_is_negative_inside(body: BodyModel) -> None:
    chest = body.shaped(torch.zeros(body.num_betas))[1][9]
    probes = torch.stack([chest, chest + Z])
    hit = closest_point(probes, body.v_template, body.faces)
    normals = vertex_normals(body.v_template, body.faces)
    inside, outside = signed_distance(probes, hit, normals, body.faces).tolist()
    assert inside < 0 < outside


def test_images_are_rgb_in_unit_range(record: CaptureRecord) -> None:
    entry, image = record.frame(0, 0), record.image(0, 0)
    assert image.shape == (512, 512, 3)
    assert image.dtype == torch.float32
    stored = cv2.imread(str(entry.image_path))
    assert stored is not None
    np.testing.assert_array_equal(image.numpy(), stored[..., ::-1].astype(np.float32) / 255)


def test_masks_are_true_on_the_person(record: CaptureRecord) -> None:
    mask = record.mask(0, 0)
    assert mask.dtype == torch.bool
    posed = record.body(record.poses[0])
    pixels, _ = record.cameras[0].project(posed.to_world(posed.joints))
    column, row = pixels.long().T
    assert bool(mask[row, column].float().mean() > 0.9)
    assert not bool(mask[0].any())


def _cams() -> dict[str, list]:
    return json.loads((ROOT / "examples" / "capture" / "annots.json").read_text())["cams"]


def test_zju_translations_are_millimetres(record: CaptureRecord) -> None:
    for camera, millimetres in zip(record.cameras, _cams()["T"], strict=True):
        expected = torch.tensor(millimetres).reshape(3) / 1000
        torch.testing.assert_close(camera.t, expected.to(camera.t))


def test_zju_pixel_centres_are_whole_numbers(record: CaptureRecord) -> None:
    for camera, K in zip(record.cameras, _cams()["K"], strict=True):
        expected = torch.tensor(K)[:2, 2] + 0.5
        torch.testing.assert_close(camera.K[:2, 2], expected.to(camera.K))


def test_frames_are_numbered_by_file_stem(record: CaptureRecord) -> None:
    for (_, number), entry in record.frames.items():
        assert int(entry.image_path.stem) == number == entry.index


def test_any_leading_batch(body: BodyModel) -> None:
    pose = BodyPose(
        0.3 * torch.randn(2, 3, body.num_joints, 3),
        torch.randn(2, 3, body.num_betas),
        torch.randn(2, 3, 3),
        torch.randn(2, 3, 3),
    )
    posed = body(pose)
    for i, j in ((0, 0), (1, 2)):
        one = body(
            BodyPose(pose.pose[i, j], pose.betas[i, j], pose.rotation[i, j], pose.translation[i, j])
        )
        torch.testing.assert_close(posed.verts_world[i, j], one.verts_world, atol=1e-5, rtol=0)
    camera = pinhole()
    points = torch.randn(4, 1, 5, 3) * 0.1 + 2 * Z
    torch.testing.assert_close(camera.project(points)[0][2, 0], camera.project(points[2, 0])[0])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_device_and_dtype_come_from_the_inputs(body: BodyModel, dtype: torch.dtype) -> None:
    ref = torch.zeros(body.num_joints, 3, dtype=dtype)
    posed = body(BodyPose(ref, ref.new_zeros(body.num_betas), ref[0], ref[0]))
    assert {posed.verts.dtype, posed.joints.dtype, posed.transforms.dtype} == {dtype}
    assert axis_angle_to_rotmat(ref).dtype == dtype
    pixels, depth = pinhole().project(2 * Z.to(dtype))
    assert pixels.dtype == depth.dtype == dtype
    for path in source_files():
        if path.relative_to(ROOT).parts[0] in ("geometry", "fields"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                    names = {a.arg for a in (*node.args.args, *node.args.kwonlyargs)}
                    assert "device" not in names, f"{path.name}: {node.name}"


def test_sizes_come_from_the_data() -> None:
    tree = KinematicTree.from_parents([-1, 0, 1])
    rotmats = axis_angle_to_rotmat(torch.randn(3, 3))
    transforms = forward_kinematics(tree, rotmats, torch.randn(3, 3))
    weights = torch.softmax(torch.randn(7, 3), 1)
    assert skin(torch.randn(7, 3), blend_transforms(transforms, weights)).shape == (7, 3)
    parts = PartMap((0, 1, 1), ("lower", "upper"))
    assert set(parts.vertex_parts(weights).tolist()) <= {0, 1}


def test_failures_are_masked() -> None:
    transforms = torch.stack([torch.eye(4), torch.zeros(4, 4)])
    transforms[1, 3, 3] = 1.0
    inverse, valid = invert_affine(transforms)
    assert valid.tolist() == [True, False]
    assert bool(inverse.isfinite().all())
