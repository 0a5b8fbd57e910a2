"""The shell skips only what it may: against surfaces, exact voxel walks and dense lattices."""

import itertools

import numpy as np
import pytest
import torch

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.cameras import Rays
from monopart.geometry.culling import BodyShell, _vertex_reach
from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap
from monopart.geometry.surface import SurfaceIndex

RADIUS = torch.tensor([0.06, 0.04, 0.05, 0.03, 0.03])
BODY = BodyModel.default()
FACE_PART = PartMap.default().face_parts(BODY.weights, BODY.faces)


def posed_verts(count: int) -> torch.Tensor:
    """The rest pose and others, at different places."""
    generator = torch.Generator().manual_seed(3)
    pose = BodyPose.zeros(BODY, (count,))
    pose.pose[1:] = 0.35 * torch.randn(count - 1, 24, 3, generator=generator)
    return BODY(pose).verts + torch.arange(count)[:, None, None]


@pytest.fixture(scope="module")
def shell() -> BodyShell:
    return BodyShell(posed_verts(3), BODY.faces, RADIUS, FACE_PART, voxel=0.025)


def around(verts: torch.Tensor, count: int, spread: float) -> torch.Tensor:
    return verts[torch.randint(len(verts), (count,))] + spread * torch.randn(count, 3)


def aimed_rays(verts: torch.Tensor, count: int) -> Rays:
    """Rays from around the bodies; most pass near a vertex, many miss."""
    origins = verts.mean(0) + 2.5 * torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    directions = torch.nn.functional.normalize(around(verts, count, 0.15) - origins, dim=-1)
    return Rays(origins, directions)


def test_no_point_within_the_radius_is_lost(shell: BodyShell) -> None:
    for b, verts in enumerate(posed_verts(3)):
        points = around(verts, 3000, 0.05)
        bits = shell.bits(points, b)
        for part, radius in enumerate(RADIUS.tolist()):
            faces = BODY.faces[FACE_PART == part]
            near = SurfaceIndex(verts, faces).query(points, radius).found
            assert 50 < int(near.sum()) < 2900
            assert bool(((bits[near] >> part) & 1).all())
        assert torch.equal(shell.occupied(points, b), bits != 0)


def test_far_points_are_skipped(shell: BodyShell) -> None:
    """The shell is not a box: what is well beyond the radius is free."""
    for b, verts in enumerate(posed_verts(3)):
        points = around(verts, 3000, 0.2)
        distance = SurfaceIndex(verts, BODY.faces).query(points).distance
        slack = float(RADIUS.max()) + 0.025 * 3**0.5 + 0.06
        assert not bool(shell.occupied(points[distance > slack], b).any())
        assert int((distance > slack).sum()) > 200
    assert not bool(shell.occupied(torch.full((1, 3), 1e6)).any())


def test_one_body_per_point(shell: BodyShell) -> None:
    body = torch.randint(3, (2000,))
    points = around(BODY.v_template, 2000, 0.05) + body[:, None]
    mixed = shell.bits(points, body)
    for b in range(3):
        assert torch.equal(mixed[body == b], shell.bits(points[body == b], b))
    assert int((mixed != 0).sum()) > 1000


def segments(shell: BodyShell, rays: Rays, b: int) -> list[list[tuple[float, float, bool]]]:
    """Per ray, (start, end, occupied) between all crossings of voxel planes, in float64."""
    lo, dims = shell.lo[b].double().numpy(), shell.dims[b].numpy()
    first = int(shell.offset[b])
    grid = shell.grid[first : first + int(dims.prod())].reshape(dims[2], dims[1], dims[0]).numpy()
    result = []
    for o, d in zip(rays.origins.double().numpy(), rays.directions.double().numpy(), strict=True):
        cuts = [0.0]
        for a in range(3):
            if d[a] != 0.0:
                cuts += list((lo[a] + shell.voxel * np.arange(dims[a] + 1) - o[a]) / d[a])
        ends = sorted(t for t in cuts if t >= 0.0)
        row = []
        for start, end in itertools.pairwise(ends):
            cell = np.floor((o + d * (start + end) / 2 - lo) / shell.voxel).astype(int)
            inside = bool((cell >= 0).all() and (cell < dims).all())
            row.append((start, end, inside and bool(grid[cell[2], cell[1], cell[0]])))
        result.append(row)
    return result


def check_intervals(shell: BodyShell, rays: Rays, b: int) -> int:
    """Compare with the exact walk; segments too short for float32 may count or not."""
    near, far, hit = (t.tolist() for t in shell.intervals(rays, b))
    for i, row in enumerate(segments(shell, rays, b)):
        full = [s for s in row if s[2]]
        # a rounded coordinate moves the crossing of a plane that the ray almost lies in
        slope = float(rays.directions[i][rays.directions[i] != 0].abs().min())
        slack = 1e-6 + 1e-6 / slope
        long = [s for s in full if s[1] - s[0] > 2 * slack]
        if not hit[i]:
            assert near[i] == far[i] == 0.0
        if not full:
            assert not hit[i]
        if long:
            assert hit[i]
            assert full[0][0] - slack <= near[i] <= long[0][0] + slack
            assert long[-1][1] - slack <= far[i] <= full[-1][1] + slack
    return sum(hit)


def test_intervals_are_the_first_and_last_occupied_voxel(shell: BodyShell) -> None:
    for b, verts in enumerate(posed_verts(3)):
        hits = check_intervals(shell, aimed_rays(verts, 120), b)
        assert 40 < hits < 120


def test_intervals_of_axis_parallel_rays(shell: BodyShell) -> None:
    verts = posed_verts(1)[0]
    for axis in range(3):
        for sign in (1.0, -1.0):
            directions = torch.full((40, 3), -0.0 if sign < 0 else 0.0)
            directions[:, axis] = sign
            origins = around(verts, 40, 0.1)
            origins[:, axis] -= 3.0 * sign
            assert 10 < check_intervals(shell, Rays(origins, directions), 0) <= 40


def test_intervals_from_inside_and_away(shell: BodyShell) -> None:
    verts = posed_verts(1)[0]
    origins = verts[::300]
    directions = torch.nn.functional.normalize(torch.randn_like(origins), dim=-1)
    near, far, hit = shell.intervals(Rays(origins, directions))
    assert bool(hit.all()) and not bool(near.any()) and bool((far > 0.02).all())
    check_intervals(shell, Rays(origins, directions), 0)
    beyond = Rays(origins + 10 * directions, directions)
    assert not bool(shell.intervals(beyond)[2].any())


def test_intervals_hold_what_is_within_the_radius(shell: BodyShell) -> None:
    verts = posed_verts(3)[1]
    rays = aimed_rays(verts, 150)
    near, far, hit = shell.intervals(rays, 1)
    depth = torch.arange(0.0, 5.0, 0.01)
    points = rays.origins[:, None] + depth[:, None] * rays.directions[:, None]
    index = SurfaceIndex(verts, BODY.faces)
    within = index.query(points.reshape(-1, 3), float(RADIUS.min())).found.reshape(150, -1)
    assert int(within.sum()) > 500
    inside = (depth >= near[:, None] - 1e-6) & (depth <= far[:, None] + 1e-6) & hit[:, None]
    assert not bool((within & ~inside).any())


@pytest.mark.parametrize("with_jitter", [False, True])
def test_samples_are_the_dense_lattice_in_the_shell(shell: BodyShell, with_jitter: bool) -> None:
    step, count = 0.02, 200
    body = torch.randint(3, (count,), dtype=torch.int32)
    rays = aimed_rays(posed_verts(1)[0], count)
    rays = Rays(rays.origins + body[:, None], rays.directions)
    jitter = torch.rand(2 * count)[::2] if with_jitter else None  # not contiguous
    samples = shell.sample(rays, step, body, jitter)
    shift = torch.full((count,), 0.5) if jitter is None else jitter

    depth = (torch.arange(300) + shift[:, None]) * step
    points = rays.origins[:, None] + depth[..., None] * rays.directions[:, None]
    flat, owner = points.reshape(-1, 3), body.repeat_interleave(300)
    bits = shell.bits(flat, owner).reshape(count, 300)
    place = torch.round(samples.depth / step - shift[samples.ray]).long()
    torch.testing.assert_close(samples.depth, depth[samples.ray, place])
    torch.testing.assert_close(samples.points, points[samples.ray, place], atol=2e-6, rtol=0)
    assert torch.equal(samples.body, body[samples.ray])

    found = torch.zeros_like(bits)
    found[samples.ray, place] = samples.candidates
    cell = (flat - shell.lo[owner]) / shell.voxel
    on_a_plane = ((cell - cell.round()).abs().amin(-1) < 2e-4).reshape(count, 300)
    assert torch.equal(found[~on_a_plane], bits[~on_a_plane])
    assert int((found != 0).sum()) > 2000

    # sorted, and ray_start tells the rows of a ray
    assert bool((samples.ray.diff() >= 0).all())
    same_ray = samples.ray.diff() == 0
    assert bool((samples.depth.diff()[same_ray] > 0).all())
    rows = torch.bincount(samples.ray, minlength=count)
    assert samples.ray_start.tolist() == [0, *rows.cumsum(0).tolist()]
    upper = shell.dims[owner] * shell.voxel
    in_box = ((flat >= shell.lo[owner]) & (flat <= shell.lo[owner] + upper)).all(-1)
    assert samples.dense == pytest.approx(int(in_box.sum()), abs=3)
    assert samples.dense > 3 * len(samples.points)


def test_a_ray_is_sampled_alike_alone_and_among_others(shell: BodyShell) -> None:
    rays = aimed_rays(posed_verts(1)[0], 50)
    every = shell.sample(rays, 0.015)
    for r in (0, 17, 49):
        alone = shell.sample(Rays(rays.origins[r : r + 1], rays.directions[r : r + 1]), 0.015)
        rows = slice(int(every.ray_start[r]), int(every.ray_start[r + 1]))
        assert torch.equal(alone.points, every.points[rows])
        assert torch.equal(alone.candidates, every.candidates[rows])


def test_rays_that_miss_and_no_rays(shell: BodyShell) -> None:
    up = torch.tensor([0.0, 1.0, 0.0])
    miss = Rays(torch.tensor([[5.0, 0, -5], [0, 9, 0]]), up.expand(2, 3))
    samples = shell.sample(miss, 0.01)
    assert samples.points.shape == (0, 3) and samples.ray_start.tolist() == [0, 0, 0]
    assert samples.dense == 0
    none = Rays(torch.zeros(0, 3), torch.zeros(0, 3))
    assert shell.sample(none, 0.01).ray_start.tolist() == [0]
    assert [len(t) for t in shell.intervals(none)] == [0, 0, 0]
    assert shell.bits(torch.zeros(0, 3)).shape == (0,)
    zero = Rays(torch.zeros(1, 3), torch.zeros(1, 3, dtype=torch.float32) + up)
    inside = shell.sample(zero, 0.01)
    assert inside.depth[0].item() == pytest.approx(0.005)  # the lattice starts at the origin


def test_nothing_is_lost_around_a_speck_and_little_is_kept() -> None:
    """A triangle of no size leaves the promise no slack: every point of a ball is tried."""
    speck, faces = 1e-6 * torch.eye(3), torch.tensor([[0, 1, 2]])
    way = torch.nn.functional.normalize(torch.randn(20000, 3), dim=-1)
    for voxel in (0.013, 0.04, 0.3):
        for _ in range(3):
            centre = torch.rand(3)
            shell = BodyShell(speck + centre, faces, 0.05, voxel=voxel)
            assert bool(shell.occupied(centre + 0.04999 * way).all())
            beyond = 0.05 + 3**0.5 * voxel + 1e-4  # the far corner of a voxel that is just marked
            assert not bool(shell.occupied(centre + beyond * way).any())


def test_large_triangles_are_covered() -> None:
    """The inside of a triangle is far from its corners, and the shell covers it nevertheless."""
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 0.866, 0]])
    shell = BodyShell(verts, torch.tensor([[0, 1, 2]]), 0.01, voxel=0.02)
    weights = torch.rand(500, 3)
    points = (weights / weights.sum(-1, keepdim=True)) @ verts
    assert bool(shell.occupied(points).all())


def test_parts_without_faces_and_many_parts() -> None:
    verts = torch.tensor(
        [[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [5, 0, 0], [5.1, 0, 0], [5, 0.1, 0]]
    )
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]])
    shell = BodyShell(verts, faces, 0.02, torch.tensor([1, 30]))
    assert shell.bits(verts[[0, 3]]).tolist() == [1 << 1, 1 << 30]


def test_bad_input() -> None:
    verts, faces = torch.eye(3), torch.tensor([[0, 1, 2]])
    for radius, voxel in ((0.0, 0.02), (-1.0, 0.02), (float("nan"), 0.02), (0.1, 0.0)):
        with pytest.raises(InputError, match="radius, voxel"):
            BodyShell(verts, faces, radius, voxel=voxel)
    with pytest.raises(InputError, match="1-31 parts"):
        BodyShell(verts, faces, 0.1, torch.tensor([31]))
    with pytest.raises(InputError, match="1-31 parts"):
        BodyShell(verts, faces, torch.tensor([0.1]), torch.tensor([1]))
    with pytest.raises(InputError, match="NaN"):
        BodyShell(verts * float("nan"), faces, 0.1)
    for unit in (1e3, 1e12):  # millimetres, and what no whole number of 32 bits counts
        with pytest.raises(InputError, match="in metres"):
            BodyShell(unit * verts, faces, 0.1)
    shell = BodyShell(verts, faces, 0.1)
    with pytest.raises(InputError, match="step"):
        shell.sample(Rays(verts, verts), 0.0)


def test_a_kept_grid_must_fit(shell: BodyShell) -> None:
    verts = posed_verts(2)
    built = BodyShell(verts, BODY.faces, 0.05)
    again = BodyShell(verts, BODY.faces, 0.05, grid=built.grid)
    points = around(verts[0], 500, 0.2)
    assert torch.equal(built.bits(points), again.bits(points))
    assert torch.equal(built.lo, again.lo) and torch.equal(built.offset, again.offset)
    for wrong in (built.grid[1:], built.grid.long(), shell.grid[:0]):
        with pytest.raises(InputError, match="grid"):
            BodyShell(verts, BODY.faces, 0.05, grid=wrong)


def test_the_reach_of_a_vertex_is_that_of_its_longest_edge() -> None:
    """Against a loop over the faces of every body."""
    verts, faces = posed_verts(2), BODY.faces.long()
    longest = torch.zeros(len(verts[0]))
    for body in verts:
        corners = body[faces]
        edge = torch.stack([(corners[:, i] - corners[:, i - 1]).norm(dim=-1) for i in range(3)])
        for corner in range(3):
            longest.scatter_reduce_(0, faces[:, corner], edge.amax(0), "amax")
    torch.testing.assert_close(_vertex_reach(verts, faces), longest / 3**0.5, rtol=1e-6, atol=1e-8)
