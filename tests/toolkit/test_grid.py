"""The grid of the paper, factors, and grids from files."""

import pytest

from monopart.geometry.errors import InputError
from monopart.toolkit.ablate import Plan, cells_of
from monopart.toolkit.arguments import resolve
from monopart.toolkit.config import Config
from monopart.toolkit.grid import FULL, PAPER, chosen, explicit, read_grid


def test_the_papers_grid():
    figures = {n: v.published["novel_view"] for n, v in PAPER.items() if v.published}
    assert figures == {
        "full": 32.12,
        "no_uvt": 32.03,
        "no_f_k": 31.79,
        "no_consistency": 31.63,
        "no_rgb_latent": 31.93,
        "no_pose_feature": 31.88,
        "half_consistency": 31.74,
        "half_lpips": 31.86,
        "half_mse": 31.52,
        "instant_nvr": 31.01,
    }
    assert next(iter(PAPER)) == FULL and list(chosen(PAPER, ["best"])) == [FULL, "best"]
    with pytest.raises(InputError, match="--only: expected some of full, no_uvt"):
        chosen(PAPER, ["no_such"])


def test_a_factor_is_of_the_bases_own_number():
    base = resolve("fast", [["loss.lpips=0.3"]])
    assert explicit(("loss.lpips*=0.5", "train.rays=8"), base) == (
        "loss.lpips=0.15",
        "train.rays=8",
    )
    for wrong in ("loss.nothing*=2", "none.mse*=2", "deform.residual*=2", "loss.mse*=much"):
        with pytest.raises(InputError, match=r"\*=factor of a number"):
            explicit((wrong,), Config())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[", "expected JSON"),
        ("[]", "expected an object of cells, found list"),
        ('{"../x": {}}', "expected a name of letters"),
        ('{"a": {"sets": []}}', "expected an object of label, set and preset"),
        ('{"a": {"set": "loss.mse=1"}}', "set: expected a list of texts"),
        ('{"a": {"label": 3}}', "expected texts"),
    ],
)
def test_wrong_grids(tmp_path, text, message):
    path = tmp_path / "grid.json"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_grid(path)


@pytest.mark.parametrize("name", PAPER)
def test_every_cell_of_the_paper_resolves(name, tmp_path):
    made = Plan((tmp_path,), tmp_path / "out", chosen(PAPER, [name]), 1, "full", seconds=1.0)
    assert {c.name for c in cells_of(made)[0]} | set(cells_of(made)[1]) == {FULL, name}
