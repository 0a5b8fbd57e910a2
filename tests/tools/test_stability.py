"""monopart-bench stability: its fast core holds every promise, and broken operations are caught."""

import dataclasses
import json
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import oracles
import pytest
import torch
from torch import Tensor

from monopart.geometry.errors import InputError
from monopart.tools.bench import stability_page
from monopart.tools.bench.cli import main
from monopart.tools.bench.stability import ROOMS, chosen, run, stresses
from monopart.tools.bench.stability_cases import DOUBLE, SINGLE, Family, Stress, Way
from monopart.tools.bench.stability_meshes import exact_distance
from monopart.tools.bench.stability_page import BEGIN, END, failures, publish
from monopart.tools.bench.stability_rotations import exact_of_quat, exact_rotmat

EVERY = [stress for room in stresses().values() for stress in room]


@pytest.mark.parametrize("stress", EVERY, ids=[s.name for s in EVERY])
def test_the_promises_hold(stress: Stress) -> None:
    outcome = run([stress], 0.1, peers=False, say=lambda text: None)
    assert failures([stress], outcome) == []
    assert outcome.cells, "an operation without a measurement promises nothing"
    assert any(cell.value is not None for cell in outcome.cells)


def test_every_operation_is_complete() -> None:
    assert set(stresses()) == set(ROOMS)
    assert len({s.name for s in EVERY}) == len(EVERY)
    for stress in EVERY:
        names = [f.name for f in stress.families]
        assert len(set(names)) == len(names), stress.name
        assert stress.ways[0].ours and stress.domain and stress.error
        kinds = {kind for way in stress.ways if way.ours for kind in way.dtypes}
        assert SINGLE in kinds, stress.name


# --- a harness that cannot fail shows nothing --------------------------------------------------


def _toy(function, **changes) -> Stress:
    family = Family("any", lambda g, n: (torch.rand(n, 2, generator=g, dtype=DOUBLE) + 0.5,))
    return Stress(
        name="toy",
        title="squares",
        domain="any",
        error="1",
        families=(dataclasses.replace(family, **changes),),
        ways=(Way("monopart", lambda extra, x: function(x), True),),
        exact=lambda extra, x: x * x,
    )


class _WrongSlope(torch.autograd.Function):
    @staticmethod
    def forward(ctx: object, x: Tensor) -> Tensor:
        return x * x

    @staticmethod
    def backward(ctx: object, *grads: Tensor) -> Tensor:
        return grads[0]


def _tell(stress: Stress) -> str:
    return " ".join(failures([stress], run([stress], say=lambda text: None)))


def test_a_sound_operation_passes() -> None:
    assert _tell(_toy(lambda x: x * x)) == ""


def test_a_wrong_value_is_caught() -> None:
    assert "float32: error" in _tell(_toy(lambda x: x * x + 1e-5))
    assert "float64: error" in _tell(_toy(lambda x: (x.float() ** 2).to(x)))


def test_a_wrong_gradient_is_caught() -> None:
    assert "float64: gradient error" in _tell(_toy(_WrongSlope.apply))
    coarse = _toy(lambda x: x * x + (0 if x.dtype == DOUBLE else 0.01 * (x - x.detach())))
    assert "float32: gradient error" in _tell(coarse)


def test_what_is_not_finite_is_caught() -> None:
    assert "values not finite" in _tell(_toy(lambda x: torch.where(x > 1.0, torch.nan, x * x)))
    steep = _toy(lambda x: x * x + 0 * (x - x).abs().sqrt(), smooth=False)
    assert "gradients not finite" in _tell(steep)


def test_a_mask_excuses_values_but_not_gradients() -> None:
    def masked(x: Tensor) -> tuple[Tensor, Tensor]:
        return torch.where(x > 0, torch.nan, x), torch.zeros(len(x), dtype=torch.bool)

    cell = run([_toy(masked)], say=lambda text: None).cells[0]
    assert cell.masked == cell.cases and cell.bad_values == 0


def test_outside_the_domain_nothing_is_promised() -> None:
    assert _tell(_toy(lambda x: x * torch.nan, inside=False)) == ""


# --- the oracles -------------------------------------------------------------------------------


def test_rotation_oracles_against_plain_loops() -> None:
    vectors = np.random.default_rng(1).normal(size=(20, 3))
    exact = exact_rotmat(None, vectors)
    assert np.abs(exact - np.stack([oracles.rodrigues(v) for v in vectors])).max() < 1e-15
    angle = np.linalg.norm(vectors, axis=1, keepdims=True)
    quats = np.concatenate((np.cos(angle / 2), np.sin(angle / 2) * vectors / angle), 1)
    assert np.abs(exact_of_quat(None, 3.0 * quats) - exact).max() < 1e-15


def test_surface_oracle_against_plain_loops() -> None:
    rng = np.random.default_rng(2)
    verts, points = rng.normal(size=(12, 3)), rng.normal(size=(30, 3))
    faces = np.stack([rng.permutation(12)[:3] for _ in range(9)])
    faces[0] = 3, 5, 5
    loops = oracles.closest_on_mesh(points, verts, faces)[1]
    assert np.abs(exact_distance(torch.from_numpy(faces), points, verts) - loops).max() < 1e-14


# --- the program -------------------------------------------------------------------------------


def test_the_command_writes_tables_maps_and_json(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    only = ["--only", "quat_wxyz_to_rotmat", "--only", "invert_affine"]
    arguments = ["stability", "--quick", *only, "--out", str(tmp_path / "out")]
    assert main([*arguments, "--into", str(page)]) is None
    text = page.read_text()
    assert text.startswith("before\n") and text.endswith("after\n") and "\nold\n" not in text
    assert "quaternion to matrix" in text and "\\|det\\|" in text
    data = json.loads((tmp_path / "out" / "stability.json").read_text())
    assert data["schema"] == 2 and data["cases"] == sum(c["cases"] for c in data["cells"])
    assert {c["operation"] for c in data["cells"]} == {"quat_wxyz_to_rotmat", "invert_affine"}
    for folder in (tmp_path / "page", tmp_path / "out" / "stability"):
        root = ElementTree.parse(folder / "rotations.svg").getroot()
        words = " ".join(root.itertext())
        assert "length 1e-30" in words and "(infinite)" in words


def test_a_broken_promise_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = _toy(lambda x: x + x)
    monkeypatch.setattr(stability_page, "chosen", lambda only: {"rotations": [broken]})
    assert main(["stability", "--quick", "--out", str(tmp_path)]) == 2
    assert "promises broken" in capsys.readouterr().err
    assert (tmp_path / "stability.json").is_file(), "the figures are written first"


def test_bad_input_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="axis_angle_to_rotmat"):
        chosen(["nothing"])
    outcome = run([], say=lambda text: None)
    with pytest.raises(InputError, match="Markdown page"):
        publish({}, outcome, tmp_path / "none.md")
    (tmp_path / "page.md").write_text("no marks")
    with pytest.raises(InputError, match="marks"):
        publish({}, outcome, tmp_path / "page.md")


def test_a_missing_peer_is_named() -> None:
    toy = _toy(lambda x: x * x)
    peer = Way("other", lambda extra, x: x, modules=("no_such_module",))
    outcome = run([dataclasses.replace(toy, ways=(*toy.ways, peer))], say=lambda text: None)
    assert outcome.absent == {"other": "no_such_module"}
    assert {cell.way for cell in outcome.cells} == {"monopart"}


def test_a_peer_that_raises_is_reported() -> None:
    def refuse(extra: None, x: Tensor) -> Tensor:
        raise ValueError("not today")

    toy = _toy(lambda x: x * x)
    outcome = run(
        [dataclasses.replace(toy, ways=(*toy.ways, Way("other", refuse)))], say=lambda t: None
    )
    assert any("not today" in cell.raised for cell in outcome.cells)
