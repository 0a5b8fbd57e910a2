"""Bodies of a subject: shapes, heights, levels of detail, and files that are whole or not there."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.errors import InputError
from monopart.geometry.weight_transfer import closest_faces
from monopart.tools.body import build_body, coarse_body, write_body
from monopart.tools.check import check_mesh
from monopart.tools.meshio import Mesh, read_mesh


def test_an_unchanged_body_comes_back(tmp_path) -> None:
    path = write_body(tmp_path / "same.npz", build_body())
    body, again = BodyModel.default(), BodyModel.load(path)
    for name in ("v_template", "faces", "weights", "shapedirs", "posedirs"):
        assert torch.allclose(getattr(body, name), getattr(again, name), atol=1e-7), name
    assert torch.equal(body.uv.corner_uv, again.uv.corner_uv)
    assert body.tree == again.tree and body.joint_names == again.joint_names
    assert torch.equal(body.shaped(torch.ones(10))[1], again.shaped(torch.ones(10))[1])


@settings(max_examples=8)
@given(st.lists(st.floats(-2, 2), min_size=0, max_size=10))
def test_betas_become_the_mean_shape(betas: list[float]) -> None:
    body = BodyModel.from_arrays(build_body(betas=betas))
    verts, joints = BodyModel.default().shaped(torch.tensor(betas, dtype=torch.float32))
    assert torch.allclose(body.v_template, verts, atol=1e-6)
    assert torch.allclose(body.shaped(torch.zeros(0))[1], joints, atol=1e-6)
    # what is added later adds up
    more = torch.linspace(-1, 1, 10)
    total = more + torch.nn.functional.pad(torch.tensor(betas), (0, 10 - len(betas)))
    both = BodyModel.default().shaped(total.float())[0]
    assert torch.allclose(body.shaped(more)[0], both, atol=1e-5)


def test_height_scales_everything() -> None:
    body = BodyModel.from_arrays(build_body(height=1.23, betas=[1.0]))
    assert float(np.ptp(body.v_template[:, 1].numpy())) == pytest.approx(1.23, rel=1e-5)
    big = BodyModel.from_arrays(build_body(height=12.3, betas=[1.0]))
    betas = torch.linspace(-1, 1, 10)
    for one, ten in zip(body.shaped(betas), big.shaped(betas), strict=True):
        assert torch.allclose(10 * one, ten, atol=1e-4)


@pytest.mark.parametrize("num_faces", [4000, 600])
def test_a_coarse_body_moves_as_the_fine_one(num_faces: int, tmp_path) -> None:
    full = BodyModel.default()
    path = write_body(tmp_path / "lod.npz", build_body(num_faces=num_faces))
    body = BodyModel.load(path)
    assert abs(len(body.faces) - num_faces) <= 2
    betas = torch.tensor([[0.0] * 10, [1.0, -1, 0.5] + [0.3] * 7])
    for shape in betas:  # joints stay, for any shape
        assert torch.allclose(body.shaped(shape)[1], full.shaped(shape)[1], atol=2e-6)
    pose = BodyPose.zeros(full)
    turned = 0.3 * torch.randn(24, 3, generator=torch.Generator().manual_seed(1))
    pose = BodyPose(turned, betas[1], pose.rotation, pose.translation)
    fine, coarse = full(pose).verts.double().numpy(), body(pose).verts.double().numpy()
    gap = closest_faces(coarse, fine, full.faces.numpy())[2]
    assert gap.mean() < 2e-3 and np.quantile(gap, 0.99) < 0.02
    assert (
        closest_faces(
            body.v_template.double().numpy(), full.v_template.double().numpy(), full.faces.numpy()
        )[2].max()
        < 1e-6
    )
    assert torch.allclose(body.weights.sum(1), torch.ones(len(body.weights)), atol=1e-6)
    report = check_mesh(read_mesh(path), intersections=False)
    assert report["open_edges"].count == report["branching_edges"].count == 0
    assert report["turned_edges"].count == report["weights_sum"].count == 0
    uv = body.uv.corner_uv
    assert 0 <= uv.min() and uv.max() <= 1
    ours, theirs = stretch(body).flatten(), stretch(full).flatten()
    assert ours.quantile(0.99) < 2 * theirs.quantile(0.99)
    assert ours.max() < 3 * theirs.max()  # no face is smeared over the texture


def stretch(body: BodyModel) -> torch.Tensor:
    """Length in the texture by length in space, of the edges of each face."""
    uv, corner = body.uv.corner_uv, body.v_template[body.faces]
    wide, long = (torch.linalg.norm(x - x.roll(1, 1), dim=-1) for x in (uv, corner))
    return wide / long


def test_requests_that_do_not_fit(tmp_path) -> None:
    with pytest.raises(InputError, match="betas"):
        build_body(betas=[0.0] * 1000)
    with pytest.raises(InputError, match="betas"):
        build_body(betas=[np.nan])
    with pytest.raises(InputError, match="height"):
        build_body(height=0.0)
    with pytest.raises(InputError, match="at least 50"):
        build_body(num_faces=3)
    with pytest.raises(InputError, match="readable file"):
        build_body(tmp_path / "none.npz")
    with pytest.raises(InputError, match=r"\.npz"):
        write_body(tmp_path / "body.txt", build_body())
    with pytest.raises(InputError, match="folder"):
        write_body(tmp_path / "none" / "body.npz", build_body())
    body = build_body()
    assert coarse_body(body, len(body.faces)) is body
    assert list(tmp_path.iterdir()) == []


def test_a_body_that_no_reader_would_take_is_not_written(tmp_path) -> None:
    import dataclasses

    body = build_body()
    broken = dataclasses.replace(body, weights=body.weights * 2)
    path = tmp_path / "body.npz"
    path.write_bytes(b"old")
    with pytest.raises(InputError, match="weights"):
        write_body(path, broken)
    assert path.read_bytes() == b"old"
    doubled = dataclasses.replace(
        body, faces=np.vstack([body.faces, body.faces[:3]]), corner_uv=None
    )
    with pytest.raises(InputError, match="manifold"):
        coarse_body(doubled, 1000)


def test_the_mesh_of_a_body_is_read_by_the_mesh_tools(tmp_path) -> None:
    path = write_body(tmp_path / "body.npz", build_body(num_faces=1000))
    mesh = read_mesh(path)
    assert isinstance(mesh, Mesh) and mesh.skeleton is not None and mesh.weights is not None
    fine = read_mesh(write_body(tmp_path / "fine.npz", build_body()))
    assert np.allclose(mesh.skeleton.joints, fine.skeleton.joints, atol=1e-6)
