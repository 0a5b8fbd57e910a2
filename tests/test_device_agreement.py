"""The fast paths give on a GPU what they give on the CPU.

``cuda`` needs a GPU and is skipped without one. ``pretend`` runs everywhere: it shows that each
path finds all it needs on the device, takes its CUDA branches and computes the same there, with
the kernels run by the CPU (see `pretend_cuda`).
"""

import dataclasses
from collections.abc import Callable, Iterator

import pytest
import torch
from posing import around, pose_of
from pretend_cuda import DEVICE, HOST, pretend_cuda
from torch import Tensor

from monopart.fields.hash_grid import GridSpec, HashGrid
from monopart.fields.row_adam import RowAdam
from monopart.fields.volume import composite
from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.cameras import Rays
from monopart.geometry.diffused_weights import DiffusedField
from monopart.geometry.parts import PartMap
from monopart.geometry.posed_parts import PosedParts
from monopart.geometry.surface import closest_point
from monopart.geometry.unskin import inverse_skin

PARTS = PartMap.default()
Results = dict[str, Tensor]


@pytest.fixture(params=["pretend", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    if request.param == "cuda":
        yield torch.device("cuda", 0)
    else:
        with pretend_cuda():
            yield DEVICE


def slope(leaf: Tensor) -> Tensor:
    """The gradient that a backward pass has left."""
    assert leaf.grad is not None
    return leaf.grad.clone()


def body_on(device: torch.device) -> BodyModel:
    return BodyModel.default().to(torch.zeros((), device=device))


def random_poses(count: int) -> BodyPose:
    pose = BodyPose.zeros(BodyModel.default(), (count,))
    return dataclasses.replace(pose, pose=0.3 * torch.randn(count, 24, 3))


def body(device: torch.device) -> Results:
    """Joint chain and skinning, and their gradients."""
    pose = random_poses(3).to(torch.zeros((), device=device))
    leaves = [pose.pose.requires_grad_(), pose.betas.requires_grad_()]
    verts = body_on(device)(pose).verts
    verts.square().sum().backward()
    return {"verts": verts.detach(), **{f"gradient {i}": slope(p) for i, p in enumerate(leaves)}}


def surface(device: torch.device) -> Results:
    """Closest surface points, and their gradients."""
    rest = BodyModel.default()
    points = around(rest.v_template, rest.faces, 500).to(device).requires_grad_()
    there = body_on(device)
    verts = there.v_template.clone().requires_grad_()
    hit = closest_point(points, verts, there.faces, 0.1)
    hit.distance.sum().backward()
    found = {"distance": hit.distance.detach(), "point": hit.point.detach(), "found": hit.found}
    return found | {"points": slope(points), "verts": slope(verts)}


def inverse_skinning(device: torch.device) -> Results:
    """Newton's kernel and what surrounds it."""
    return _unskinned(device, None)


def diffused_weights(device: torch.device) -> Results:
    """The grid of weights, its sweeps, and Newton on it."""
    return _unskinned(device, DiffusedField(body_on(device), voxel=0.04))


def _unskinned(device: torch.device, field: DiffusedField | None) -> Results:
    rest, pose = BodyModel.default(), 0.2 * torch.randn(24, 3)
    points = around(pose_of(rest, pose).verts, rest.faces, 400).to(device)
    there = body_on(device)
    out = inverse_skin(points, pose_of(there, pose.to(device)), there, rest_verts=field)
    return {"points": out.points, "weights": out.weights, "valid": out.valid}


def parts(device: torch.device) -> Results:
    """Shell, ray samples, pairs of samples and parts, canonical points, and the way back."""
    rest, poses = BodyModel.default(), random_poses(2)
    target = rest(poses).verts[:, ::20].flatten(0, 1)
    directions = torch.nn.functional.normalize(torch.randn(len(target), 3), dim=-1)
    rays = Rays((target - 0.1 * directions).to(device), directions.to(device))
    which = (torch.arange(len(target)) // (len(target) // 2)).int().to(device)
    there = body_on(device)
    posed, canonical = (
        there(poses.to(there.v_template)),
        there.canonical(there.v_template.new_zeros(1)),
    )
    bodies = PosedParts(there, posed, canonical, PARTS)
    near, far, _ = bodies.shell.intervals(rays, which)
    samples = bodies.shell.sample(rays, 0.02, which)
    pairs = bodies.pairs(samples)
    unskinned = bodies.unskin(samples, pairs)
    hit = bodies.on_part(unskinned.points, pairs.part)
    back = bodies.reskin(unskinned.points, samples.body[pairs.sample].long(), hit, bodies)
    counts = torch.tensor([len(samples.depth), *pairs.counts], dtype=torch.float32)
    sums = [unskinned.points.double().abs().mean(0), unskinned.uv.double().mean(0)]
    sums += [back.double().abs().mean(0)]  # rounding may move a sample across a border
    return {
        "grid": bodies.shell.grid,
        "near": near,
        "far": far,
        "counts": counts,
        "means": torch.cat(sums).float(),
    }


def hash_grid(device: torch.device) -> Results:
    """Look-up and gradients for every width that has kernels, and a step of Adam on rows."""
    out: Results = {}
    for features in (1, 2, 4):
        specs = [GridSpec(4, features, 10, 4, 1.6), GridSpec(4, features, 8, 3, 1.5)]
        grid = HashGrid(specs, torch.Generator().manual_seed(1)).to(device)
        points = torch.rand(700, 3).to(device).requires_grad_()
        part = torch.randint(2, (700,)).to(device)
        encoded = grid(points, part, "warp")
        encoded.backward(torch.randn(encoded.shape).to(device))
        out |= {f"out {features}": encoded.detach(), f"points {features}": slope(points)}
        out[f"table {features}"] = slope(grid.table)
        RowAdam([grid.table], lr=0.01).step()
        out[f"after a step {features}"] = grid.table.detach()
    return out


def compositing(device: torch.device) -> Results:
    """Packed compositing and its gradients."""
    start = torch.tensor([0, 7, 7, 60, 61, 300]).to(device)
    sigma = (8 * torch.rand(300)).to(device).requires_grad_()
    color = torch.rand(300, 3).to(device).requires_grad_()
    delta, depth = (torch.rand(2, 300) * 0.2).to(device).unbind(0)
    out = composite(sigma, color, delta.contiguous(), start, depth.contiguous(), backend="warp")
    assert out.depth is not None
    (out.color.sum() + out.opacity.square().sum() + out.depth.sum()).backward()
    return {"color": out.color.detach(), "sigma": slope(sigma), "color gradient": slope(color)}


PATHS: list[Callable[[torch.device], Results]] = [
    body, surface, inverse_skinning, diffused_weights, parts, hash_grid, compositing
]  # fmt: skip


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.__name__)
def test_the_device_agrees_with_the_cpu(device: torch.device, path: Callable) -> None:
    torch.manual_seed(3)
    wanted = path(HOST)
    torch.manual_seed(3)
    found = path(device)
    assert wanted.keys() == found.keys()
    for name, want in wanted.items():
        got = found[name].cpu()
        assert got.shape == want.shape and got.dtype == want.dtype, name
        close = torch.isclose(got.double(), want.double(), rtol=1e-3, atol=1e-5)
        assert close.double().mean() >= 0.998, name  # ties may fall otherwise


@pytest.mark.gpu
def test_launches_can_be_captured_in_a_graph() -> None:
    device = torch.device("cuda", 0)
    grid = HashGrid([GridSpec(4, 2, 10, 4, 1.6)]).to(device)
    points = torch.rand(1000, 3, device=device)
    start = torch.arange(0, 1001, 10, device=device)
    ones = torch.ones(1000, device=device)

    def work() -> Tensor:
        encoded = grid(points, None, "warp")
        return composite(encoded[:, 0], encoded[:, :3], ones, start, ones, backend="warp").color

    with torch.no_grad():
        side = torch.cuda.Stream()
        with torch.cuda.stream(side):
            work()  # the first launch loads the kernels
        torch.cuda.synchronize()
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            replayed = work()
        points.uniform_()
        graph.replay()
        torch.testing.assert_close(replayed, work())


def test_the_pretended_device_refuses_what_cuda_would() -> None:
    with pretend_cuda() as mode:
        there, here = torch.rand(3, device=DEVICE), torch.rand(3)
        assert there.device == (there * 2).device == there.new_zeros(2).device == DEVICE
        assert here.device == there.cpu().device == torch.zeros(3).device == HOST
        with pytest.raises(AssertionError, match="add of tensors of the host"):
            torch.add(there, here)
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()
        with pytest.raises(AssertionError, match="generator"):
            torch.rand(3, generator=torch.Generator(), device=DEVICE)
        assert len(there[there > 2]) == 0
        assert mode.waits == {"outside copy to the host": 1, "outside mask": 1}
        with pytest.raises(AssertionError, match="argument 3 is on cpu"):
            grid = HashGrid([GridSpec(2, 2, 8, 4, 1.5)])
            grid(torch.rand(4, 3, device=DEVICE), None, "warp")
