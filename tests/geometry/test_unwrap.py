"""Unwrapping: no flips, no overlaps, discs, determinism, on meshes of every kind."""

import itertools
from fractions import Fraction

import igl
import numpy as np
import pytest
import torch
from scipy.sparse import csc_matrix
from torch import Tensor

from monopart.geometry.body import BodyModel
from monopart.geometry.errors import InputError
from monopart.geometry.parts import PartMap
from monopart.geometry.unwrap import GRID, Method, UVLayout, unwrap
from monopart.geometry.uv_energy import face_energy, newton_terms
from monopart.geometry.uv_measure import uv_report
from monopart.geometry.uv_mesh import CutMesh, MeshEdges
from monopart.geometry.uv_newton import factorised
from monopart.geometry.uv_overlap import face_signs, orientation, overlapping_pairs
from monopart.geometry.uv_seams import Surface, cut_to_discs


def _mesh(verts: np.ndarray, faces: np.ndarray) -> tuple[Tensor, Tensor]:
    return torch.tensor(verts, dtype=torch.float32), torch.tensor(faces, dtype=torch.int64)


def torus() -> tuple[Tensor, Tensor]:
    m, n = 24, 12
    i, j = np.meshgrid(np.arange(m), np.arange(n), indexing="ij")
    a, b = 2 * np.pi * i / m, 2 * np.pi * j / n
    ring = 1 + 0.4 * np.cos(b)
    verts = np.stack([ring * np.cos(a), ring * np.sin(a), 0.4 * np.sin(b)], -1).reshape(-1, 3)

    def at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return (x % m * n + y % n).reshape(-1)

    p, q, r, s = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
    faces = np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])
    return _mesh(verts, faces)


def genus_two() -> tuple[Tensor, Tensor]:
    sizes = (29, 17, 9)
    axes = [np.linspace(-e, e, n) for e, n in zip((2.8, 1.6, 0.6), sizes, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij")

    def tube(c: float) -> np.ndarray:
        return np.hypot(np.hypot(x - c, y) - 1, z) - 0.42

    field = np.minimum(tube(-1.1), tube(1.1)).transpose(2, 1, 0).reshape(-1)
    grid = np.stack([x, y, z], -1).transpose(2, 1, 0, 3).reshape(-1, 3)
    verts, faces = igl.marching_cubes(field, np.ascontiguousarray(grid), *sizes, 0.0)[:2]
    return _mesh(np.asarray(verts), np.asarray(faces))


def holes() -> tuple[Tensor, Tensor]:
    verts, faces = igl.icosahedron()
    for _ in range(3):
        verts, faces = igl.upsample(verts, faces)
    verts, faces = np.asarray(verts), np.asarray(faces)
    verts = verts / np.linalg.norm(verts, axis=1, keepdims=True)
    centre = verts[faces].mean(1)
    keep = np.ones(len(faces), bool)
    for hole in ([1, 0, 0], [0, 1, 0], [-0.6, -0.6, 0.53]):
        keep &= np.linalg.norm(centre - np.array(hole), axis=1) > 0.35
    return _mesh(verts, faces[keep])


def moebius() -> tuple[Tensor, Tensor]:
    count = 30
    turn = np.repeat(np.linspace(0, 2 * np.pi, count, endpoint=False), 2)
    s = np.tile([-0.5, 0.5], count)
    ring = 2 + s * np.cos(turn / 2)
    verts = np.stack([ring * np.cos(turn), ring * np.sin(turn), s * np.sin(turn / 2)], 1)
    rows = np.arange(2 * count).reshape(-1, 2)
    after = np.concatenate([rows[1:], rows[:1, ::-1]])
    faces = np.concatenate(
        [
            np.stack([rows[:, 0], rows[:, 1], after[:, 0]], 1),
            np.stack([after[:, 0], rows[:, 1], after[:, 1]], 1),
        ]
    )
    return _mesh(verts, faces)


def non_manifold() -> tuple[Tensor, Tensor]:
    """Three faces at an edge, two that disagree, two bodies that meet in a point, one apart."""
    verts = torch.tensor(
        [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [2, 2, 2], [3, 2, 2], [2, 3, 2]]
    )
    faces = [[0, 1, 2], [0, 1, 3], [1, 0, 4], [0, 3, 4], [5, 6, 7]]
    return verts, torch.tensor(faces)


def needles() -> tuple[Tensor, Tensor]:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 0, 0], [0, 1, 0]])
    return verts, torch.tensor([[0, 1, 2], [2, 1, 3], [0, 2, 3]])


MESHES = {
    "torus": torus,
    "genus two": genus_two,
    "holes": holes,
    "moebius": moebius,
    "non-manifold": non_manifold,
    "a face without area": needles,
}


def _is_sound(verts: Tensor, faces: Tensor, layout: UVLayout) -> None:
    assert layout.report.flips == layout.report.overlaps == 0
    assert layout.corner_uv.min() >= 0 and layout.corner_uv.max() <= 1
    assert layout.corner_uv.dtype == verts.dtype and layout.charts.shape == (len(faces),)
    grid = layout.corner_uv.double() / GRID
    assert torch.equal(grid, grid.round())
    assert int(layout.charts.max()) + 1 == layout.report.charts
    again = uv_report(verts, faces, layout.corner_uv, layout.report.size)
    assert again.to_dict() == layout.report.to_dict()


@pytest.mark.slow
@pytest.mark.parametrize("name", MESHES)
def test_any_mesh_comes_without_flips_or_overlaps_twice_the_same(name: str) -> None:
    verts, faces = MESHES[name]()
    layout = unwrap(verts, faces, size=512, chart_share=0.5)
    _is_sound(verts, faces, layout)
    if len(faces) < 700:
        assert torch.equal(
            layout.corner_uv, unwrap(verts, faces, size=512, chart_share=0.5).corner_uv
        )
    assert layout.report.symmetric_dirichlet <= 4.0301


@pytest.mark.slow
def test_default_body_by_parts_few_charts() -> None:
    body = BodyModel.default()
    parts = PartMap.preset("six").face_parts(body.weights, body.faces)
    layout = unwrap(body.v_template, body.faces, parts=parts, target=4.15)
    _is_sound(body.v_template, body.faces, layout)
    report = layout.report
    assert report.charts <= 25 and report.symmetric_dirichlet <= 4.15
    assert report.packing >= 0.6 and report.seam_length <= 20
    # no chart crosses from one part to another
    for chart in range(report.charts):
        assert len(parts[layout.charts == chart].unique()) == 1


@pytest.mark.slow
def test_decimated_body_by_parts() -> None:
    body = BodyModel.default()
    parts = PartMap.preset("six").face_parts(body.weights, body.faces)
    points, corners = body.v_template.double().numpy(), body.faces.numpy()
    verts, faces, birth = igl.qslim(points, corners, 1200)[:3]
    mesh = _mesh(np.asarray(verts), np.asarray(faces))
    labels = parts[torch.tensor(np.asarray(birth)).long()]
    layout = unwrap(*mesh, parts=labels, target=4.3, size=256)
    _is_sound(*mesh, layout)
    assert layout.report.symmetric_dirichlet <= 4.3
    for chart in range(layout.report.charts):
        assert len(labels[layout.charts == chart].unique()) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "shift"), [(1e-30, 0.0), (1e30, 0.0), (1.0, 1e6), (0.0, 0.0)])
def test_meshes_of_any_size_and_place(scale: float, shift: float) -> None:
    verts, faces = (np.asarray(x) for x in igl.icosahedron())
    mesh = torch.tensor(verts * scale + shift), torch.tensor(faces).long()
    layout = unwrap(*mesh, size=256, target=4.5)
    _is_sound(*mesh, layout)


@pytest.mark.slow
def test_triangles_too_small_for_the_grid_of_coordinates() -> None:
    # a fan around a hub of a millionth of the size of the mesh
    turn = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    ring = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    verts = np.concatenate([ring, 1e-9 * ring])
    i, j = np.arange(8), (np.arange(8) + 1) % 8
    faces = [np.stack([i, j, j + 8], 1), np.stack([i, j + 8, i + 8], 1)]
    faces.append(np.stack([np.full(6, 8), np.arange(9, 15), np.arange(10, 16)], 1))
    mesh = torch.tensor(verts), torch.tensor(np.concatenate(faces))
    _is_sound(*mesh, unwrap(*mesh, size=256, target=5.0))


@pytest.mark.slow
def test_many_charts_go_on_shelves() -> None:
    verts, faces = torus()
    faces = faces[:180]
    apart = verts[faces].reshape(-1, 3), torch.arange(faces.numel()).reshape(-1, 3)
    size, margin = 1024, 2
    layout = unwrap(*apart, size=size, margin=margin)
    _is_sound(*apart, layout)
    assert layout.report.charts == len(faces) and layout.report.packing > 0.4
    low, high = layout.corner_uv.amin(1) * size, layout.corner_uv.amax(1) * size
    assert low.min() >= 0.99 * margin / 2 and high.max() <= size - 0.99 * margin / 2
    gap = torch.maximum(low[:, None] - high, low - high[:, None]).amax(-1)
    gap.fill_diagonal_(torch.inf)
    assert gap.min() >= 0.99 * margin


@pytest.mark.parametrize("share", [0.0, 1e-14])
def test_a_singular_matrix_is_held(share: float) -> None:
    matrix = np.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, share]])
    found = factorised(csc_matrix(matrix)).solve(np.array([1.0, -1.0, 0.0]))
    assert np.isfinite(found).all() and abs(found[0] - found[1] - 1) < 1e-3
    with pytest.raises(InputError, match="float64"):
        factorised(csc_matrix(matrix * np.nan))


@pytest.mark.parametrize("method", ["harmonic", "lscm", "arap"])
def test_quick_methods_lay_a_plane_out(method: Method) -> None:
    verts, faces = igl.triangulated_grid(6, 5)
    verts3, faces = _mesh(np.pad(np.asarray(verts), ((0, 0), (0, 1))), np.asarray(faces))
    report = unwrap(verts3, faces, method=method, chart_share=1.0, size=256).report
    assert report.charts == 1 and report.overlaps == 0
    assert report.flips == 0
    if method != "harmonic":
        assert report.angle_p99 < 1.01


def test_xatlas_engine_covers_every_face() -> None:
    verts, faces = torus()
    layout = unwrap(verts, faces, engine="xatlas", size=512)
    assert layout.report.overlaps == layout.report.flips == 0 and layout.charts.min() == 0
    assert 0.2 < layout.report.packing < 1


def test_margin_is_kept_between_charts() -> None:
    verts, faces = non_manifold()
    size, margin = 256, 8
    layout = unwrap(verts, faces, size=size, margin=margin)
    share = torch.linspace(0, 1, 40)[:, None]
    points = [
        torch.cat([a + share * (b - a) for a, b in itertools.pairwise([*c, c[0]])])
        for c in layout.corner_uv
    ]
    assert min(p.min() for p in points) * size >= margin / 2
    for i, j in itertools.combinations(range(len(faces)), 2):
        if layout.charts[i] != layout.charts[j]:
            assert torch.cdist(points[i], points[j]).min() * size >= margin * 0.99


@pytest.mark.parametrize("name", ["torus", "genus two", "holes", "moebius"])
def test_cut_to_discs(name: str) -> None:
    verts, faces = (x.double().numpy() for x in MESHES[name]())
    surface = Surface.of(verts, faces.astype(np.int64))
    seams = cut_to_discs(surface, ~surface.edges.joinable)
    cut = CutMesh.of(surface.edges, seams)
    assert (cut.euler == 1).all() and len(cut.loops()) == cut.num_charts


def test_a_mesh_and_its_corners() -> None:
    edges = MeshEdges.of(np.array([[0, 1, 2], [0, 2, 3]]))
    assert CutMesh.of(edges, ~edges.joinable).euler.tolist() == [1]
    assert len(CutMesh.of(edges, np.ones(5, bool)).origin) == 6


def _exact_orientation(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> int:
    (ax, ay), (bx, by), (cx, cy) = ([Fraction(float(v)) for v in p] for p in (a, b, c))
    det = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    return (det > 0) - (det < 0)


def _overlap_oracle(p: np.ndarray, q: np.ndarray) -> bool:
    """Area of the intersection of two triangles, clipped in rational numbers."""
    poly = [tuple(Fraction(float(v)) for v in x) for x in p]
    clip = [tuple(Fraction(float(v)) for v in x) for x in q]

    def cross(a: tuple, b: tuple, c: tuple) -> Fraction:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    if cross(*poly) < 0:
        poly.reverse()
    if cross(*clip) < 0:
        clip.reverse()
    for k in range(3):
        a, b = clip[k], clip[(k + 1) % 3]
        out = []
        for s, e in zip(poly, poly[1:] + poly[:1], strict=True):
            ds, de = cross(a, b, s), cross(a, b, e)
            if ds >= 0:
                out.append(s)
            if ds * de < 0:
                t = ds / (ds - de)
                out.append((s[0] + t * (e[0] - s[0]), s[1] + t * (e[1] - s[1])))
        poly = out
        if len(poly) < 3:
            return False
    return sum(cross(poly[0], poly[i], poly[i + 1]) for i in range(1, len(poly) - 1)) > 0


@pytest.mark.parametrize("seed", range(4))
def test_overlaps_are_those_of_rational_clipping(seed: int) -> None:
    random = np.random.default_rng(seed)
    # small whole numbers: many touching corners, shared edges and faces without area
    corner = random.integers(0, 7, (40, 3, 2)).astype(float)
    corner = corner * 0.1 if seed % 2 else corner  # products that round
    signs = face_signs(corner)
    assert signs.tolist() == [_exact_orientation(*c) for c in corner]
    expected = [
        [i, j]
        for i, j in itertools.combinations(range(len(corner)), 2)
        if signs[i] and signs[j] and _overlap_oracle(corner[i], corner[j])
    ]
    assert overlapping_pairs(corner).tolist() == expected


def test_orientation_where_rounding_fails() -> None:
    step = 2.0**-53
    grid = np.array([[0.5 + i * step, 0.5 + j * step] for i in range(8) for j in range(8)])
    a, b = np.tile([12.0, 12.0], (64, 1)), np.tile([24.0, 24.0], (64, 1))
    expected = [_exact_orientation(*p) for p in zip(grid, a, b, strict=True)]
    assert orientation(grid, a, b).tolist() == expected
    assert set(expected) == {-1, 0, 1}


def test_newton_terms_are_the_derivatives_of_the_energy() -> None:
    random = np.random.default_rng(0)
    jacobian = random.normal(size=(60, 2, 2))
    jacobian = jacobian[np.linalg.det(jacobian) > 0.2]
    gradient, hessian = newton_terms(jacobian)
    step, numeric = 1e-6, np.zeros_like(gradient)
    second = np.zeros_like(hessian)
    for k in range(4):
        move = np.zeros(4)
        move[k] = step
        move = move.reshape(2, 2)
        numeric.reshape(-1, 4)[:, k] = (
            face_energy(jacobian + move) - face_energy(jacobian - move)
        ) / (2 * step)
        ahead, back = newton_terms(jacobian + move)[0], newton_terms(jacobian - move)[0]
        second[:, k] = (ahead - back).reshape(-1, 4) / (2 * step)
    np.testing.assert_allclose(gradient, numeric, rtol=1e-5, atol=1e-5)
    values, basis = np.linalg.eigh((second + second.transpose(0, 2, 1)) / 2)
    clamped = np.einsum("fij,fj,fkj->fik", basis, np.maximum(values, 0), basis)
    np.testing.assert_allclose(hessian, clamped, rtol=1e-4, atol=1e-4 * np.abs(clamped).max())
    assert (face_energy(-np.eye(2)[None] * [[1, 1], [1, -1]]) == np.inf).all()


BAD = [
    ({"target": 4.0}, "target"),
    ({"method": "magic"}, "method"),
    ({"engine": "blender"}, "engine"),
    ({"size": 4}, "size"),
    ({"chart_share": 0.0}, "chart_share"),
    ({"colour": 1}, "colour"),
    ({"parts": torch.zeros(2, dtype=torch.int64)}, "parts"),
]


@pytest.mark.parametrize(("options", "name"), BAD)
def test_wrong_options_are_named(options: dict, name: str) -> None:
    with pytest.raises(InputError, match=name):
        unwrap(*needles(), **options)


@pytest.mark.parametrize(
    ("verts", "faces", "name"),
    [
        (torch.zeros(3, 3), torch.zeros(0, 3, dtype=torch.int64), "at least one"),
        (torch.zeros(3, 3), torch.tensor([[0, 1, 3]]), "indices"),
        (torch.zeros(3, 3), torch.tensor([[0, 1, 1]]), "different"),
        (torch.full((3, 3), torch.nan), torch.tensor([[0, 1, 2]]), "finite"),
    ],
)
def test_wrong_meshes_are_named(verts: Tensor, faces: Tensor, name: str) -> None:
    with pytest.raises(InputError, match=name):
        unwrap(verts, faces)
