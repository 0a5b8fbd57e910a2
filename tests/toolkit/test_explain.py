"""The table of skipped work, and why a picture is empty."""

import dataclasses
import re

import pytest
import torch

from monopart.geometry.cameras import Camera
from monopart.toolkit.avatar import View, view_of
from monopart.toolkit.explain import module_rows, print_skipping, skip_rows, why_empty
from monopart.toolkit.render import STATS, render_view
from monopart.toolkit.report_data import SkipRow
from monopart.toolkit.runs import open_run

COUNTS = {
    "rays": 10,
    "samples_dense": 400,
    "samples_shell": 100,
    "samples_evaluated": 80,
    "pairs_found": 120,
    "pairs_evaluated": 90,
    "samples_reached": 70,
    "colors_evaluated": 70,
}


@pytest.fixture(scope="module")
def avatar(trained_run):
    return open_run(trained_run)


def test_rows_of_training_and_rendering():
    training = skip_rows(COUNTS, "training", 5)
    assert [(r.dense, r.kept) for r in training] == [
        (400, 100),
        (100, 80),
        (400, 120),
        (120, 90),
        (90, 70),
    ]
    assert all(r.what.startswith("training: ") and r.note for r in training)
    rendering = skip_rows({**COUNTS, "pixels": 50}, "rendering", 5)
    counts = [(r.dense, r.kept) for r in rendering[:4]]
    assert counts == [(50, 50), (50, 10), (3200, 100), (3200, 70)]
    assert "approximate" in training[3].note and "approximate" not in rendering[7].note


def test_counts_that_are_missing_are_said(capsys):
    rows = skip_rows({}, "training", 5)
    assert all(r.dense is None for r in rows)
    print_skipping([*rows, SkipRow("none", 0, 0), SkipRow("half", 2000, 1000, "why")])
    seen = capsys.readouterr()
    assert not seen.out
    lines = [[c.strip() for c in line.split("│")[1:-1]] for line in seen.err.splitlines()]
    assert ["half", "2 000", "1 000", "50.0 %", "why"] in lines
    assert ["none", "0", "0", "-", ""] in lines


def test_modules_that_a_run_does_without(avatar):
    config = avatar.config
    loss = dataclasses.replace(config.loss, lpips=0.0, offset=0.0)
    changed = dataclasses.replace(avatar, config=dataclasses.replace(config, loss=loss))
    rows = {r.what: r for r in module_rows(changed, COUNTS, 7, COUNTS)}
    assert rows["training: LPIPS loss"].dense == 7
    assert "training: consistency loss" not in rows
    assert rows["rendering: forward residual network"].dense == 90
    assert rows["reading: undistortion of images"] == SkipRow(
        "reading: undistortion of images", 7, 0, "exact: the distortion of a camera is 0"
    )
    assert all(r.kept == 0 for r in rows.values())
    assert not any("residual network" in r.what for r in module_rows(changed, {}, 7, {}))


def _away(camera: Camera, angle: float) -> Camera:
    """The camera, turned about its own vertical axis by an angle in radians."""
    c, s = torch.tensor(angle).cos(), torch.tensor(angle).sin()
    zero, one = torch.zeros(()), torch.ones(())
    turn = torch.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)
    return dataclasses.replace(camera, R=turn @ camera.R, t=turn @ camera.t)


@pytest.mark.parametrize(
    ("angle", "words"),
    [(3.14, "the person is behind the camera"), (1.0, "outside the image .*of 48 x 48")],
)
def test_a_camera_that_looks_away(avatar, angle, words):
    seen = view_of(avatar.record, 0, 0)
    view = View(_away(seen.camera, angle), seen.pose, 0)
    picture = render_view(avatar, view)
    assert picture.stats.keys() == {"pixels", *STATS}, "every count, though no ray hits the shell"
    assert picture.stats["pixels"] == 48 * 48
    assert not any(picture.stats[n] for n in STATS if n != "rays_box"), "no ray is worth it"
    assert not picture.color.any()
    why = why_empty(avatar, view, picture)
    assert why is not None
    assert torch.equal(
        render_view(avatar, view, background=0.5).color.unique(), torch.tensor([0.5])
    )
    assert re.search(words, why), why
    assert all(row.what for row in skip_rows(picture.stats, "rendering", 5))


def test_a_field_without_density(avatar):
    view = view_of(avatar.record, 0, 0)
    picture = render_view(avatar, view)
    assert picture.stats.keys() == {"pixels", *STATS} and all(picture.stats.values())
    empty = dataclasses.replace(picture, opacity=0.01 * torch.ones_like(picture.opacity))
    why = why_empty(avatar, view, empty)
    assert why is not None and "largest opacity 0.010" in why and "train longer" in why
    full = dataclasses.replace(picture, opacity=torch.ones_like(picture.opacity))
    assert why_empty(avatar, view, full) is None
