"""The same capture stated in another way gives the same avatar, within stated bounds.

No test here knows what the right picture is: each knows which pictures must agree.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import variants
from torch import Tensor
from variants import Change, restated

from monopart.geometry.errors import InputError
from monopart.toolkit.avatar import Avatar, view_of
from monopart.toolkit.captures import check_capture, read_capture
from monopart.toolkit.config import Config
from monopart.toolkit.presets import preset, with_overrides
from monopart.toolkit.render import Picture, render_view
from monopart.toolkit.train import Trainer

STEPS, BAND = 12, 2
# Largest and mean change of a colour in [0, 1]. Training turns roundings into steps of its
# optimiser, so a trained avatar differs by more than an untrained one: at single pixels of the
# outline most, so that the bound of the mean is the one that catches a fault.
UNTRAINED = (1e-4, 1e-6)
TRAINED = (0.1, 2e-4)
FAR = (0.1, 4e-4)  # 100 m away, where a metre is known to 7.6e-6
MIRRORED = (2e-2, 3e-4)  # untrained: hash tables start with other random numbers on other sides
MIRRORED_TRAINED = (0.3, 5e-3)

BASE = with_overrides(
    preset("fast"),
    loss={"lpips": 0.0, "consistency_threshold": 0.0, "consistency_samples": 2048},
    geometry={"parts": "three"},  # left and right arms and legs are one part: mirrors keep it
    train={"iterations": STEPS, "rays": 512, "band": BAND, "ema": 0.0},
    field={"log2_size": 10, "levels": 4, "hidden": 16},
    deform={"hidden": 16, "log2_size": 8},
    appearance={"light": False},
)
LIT = with_overrides(BASE, appearance={"light": True})
BARE = with_overrides(BASE, field={"prior_slope": 0.0})  # the prior's grid is stated in metres


@dataclass(frozen=True)
class Made:
    """An avatar before and after training, seen by the camera that it was not trained with."""

    untrained: Picture
    trained: Picture
    losses: dict[str, float]
    weights: dict[str, Tensor]


def make(folder: Path, config: Config, frame: int = 1) -> Made:
    torch.manual_seed(0)
    avatar = Avatar.create(read_capture(folder), config)
    view = view_of(avatar.record, 1, frame)
    before = render_view(avatar, view)
    trainer = Trainer(avatar)
    trainer.loop()
    weights = {k: v.clone() for k, v in avatar.model.state_dict().items()}
    return Made(before, render_view(avatar, view), trainer.last, weights)


@pytest.fixture(scope="module")
def plain(small_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The miniature, written as the variants are."""
    folder = tmp_path_factory.mktemp("variants") / "plain"
    return restated(small_capture, folder, variants.as_it_is)


@pytest.fixture(scope="module")
def base(plain: Path) -> Made:
    made = make(plain, BASE)
    assert float(made.trained.opacity.max()) > 0.9, "an empty picture proves nothing"
    assert float((made.trained.color - made.untrained.color).abs().max()) > 0.05, "nothing learnt"
    assert made.losses["consistency"] > 0
    return made


def change_of(found: Tensor, expected: Tensor) -> tuple[float, float]:
    apart = (found - expected).abs()
    return float(apart.max()), float(apart.mean())


def within(found: Tensor, expected: Tensor, bound: tuple[float, float]) -> None:
    largest, mean = change_of(found, expected)
    assert largest <= bound[0] and mean <= bound[1], (largest, mean, bound)


@pytest.mark.parametrize(
    ("axis_angle", "shift", "bounds"),
    [
        ((0.3, -1.1, 0.7), (0.0, 0.0, 0.0), (UNTRAINED, TRAINED)),
        ((0.0, 0.0, 0.0), (3.0, -2.0, 5.0), (UNTRAINED, TRAINED)),
        ((0.3, 2.1, 0.7), (-4.0, 1.0, 2.0), (UNTRAINED, TRAINED)),
        ((0.3, -1.1, 0.7), (100.0, 0.0, 0.0), (FAR, FAR)),
    ],
)
def test_a_world_that_is_turned_and_moved(
    base: Made,
    small_capture: Path,
    tmp_path: Path,
    axis_angle: tuple[float, ...],
    shift: tuple[float, ...],
    bounds: tuple[tuple[float, float], tuple[float, float]],
) -> None:
    folder = restated(small_capture, tmp_path / "moved", variants.moved(axis_angle, shift))
    checked = check_capture(read_capture(folder), deep=True)
    assert checked.vertex_error is not None and checked.vertex_error < 1e-3
    found = make(folder, BASE)
    for field in ("color", "opacity"):
        within(getattr(found.untrained, field), getattr(base.untrained, field), bounds[0])
        within(getattr(found.trained, field), getattr(base.trained, field), bounds[1])
    assert found.losses["mse"] == pytest.approx(base.losses["mse"], rel=1e-3)


def test_a_lit_world_that_is_turned_and_moved(small_capture: Path, tmp_path: Path) -> None:
    """Light has the axes of the person and of the first training camera, which turn with it."""
    base = make(small_capture, LIT)
    folder = restated(
        small_capture, tmp_path / "moved", variants.moved((0.4, 1.9, -0.8), (3, 1, 2))
    )
    found = make(folder, LIT)
    within(found.untrained.color, base.untrained.color, UNTRAINED)
    within(found.trained.color, base.trained.color, FAR)
    # more roundings than in the unlit one: twelve steps make 0.2 % of them
    assert found.losses["mse"] == pytest.approx(base.losses["mse"], rel=5e-3)


@pytest.mark.parametrize("factor", [2.0, 0.25])
def test_another_unit_of_length_changes_no_bit(
    plain: Path, small_capture: Path, tmp_path: Path, factor: float
) -> None:
    """Powers of two scale floats exactly: a length in the code that no setting names would show."""
    here = make(plain, BARE)
    folder = restated(small_capture, tmp_path / "scaled", variants.scaled(factor))
    there = make(folder, variants.in_units(BARE, factor))
    assert torch.equal(there.trained.color, here.trained.color)
    assert torch.equal(there.trained.depth, factor * here.trained.depth)
    assert here.losses["consistency"] > 0
    assert there.losses == here.losses
    scaled = {n for n in here.weights if n.startswith("occupancy.")}
    for name in here.weights.keys() - scaled:
        assert torch.equal(there.weights[name], here.weights[name]), name
    for name in scaled:
        assert torch.equal(there.weights[name] * factor, here.weights[name]), name


def test_a_capture_in_millimetres(plain: Path, small_capture: Path, tmp_path: Path) -> None:
    """Settings in millimetres give the same avatar; settings in metres are refused."""
    config = with_overrides(BARE, loss={"consistency": 0.0})  # its search has a reach in metres
    here = make(plain, config)
    folder = restated(small_capture, tmp_path / "mm", variants.scaled(1000.0))
    there = make(folder, variants.in_units(config, 1000.0))
    within(there.untrained.opacity, here.untrained.opacity, UNTRAINED)
    within(there.trained.color, here.trained.color, TRAINED)
    with pytest.raises(InputError, match="metres"):
        make(folder, config)


def test_cameras_alone_in_metres_are_refused(plain: Path, tmp_path: Path) -> None:
    def change(stated: variants.Stated) -> None:
        stated.cams["T"] = [t / 1000 for t in stated.cams["T"]]

    folder = restated_again(plain, tmp_path / "metres", change)
    with pytest.raises(InputError, match="millimetres"):
        check_capture(read_capture(folder), deep=True)


def restated_again(plain: Path, folder: Path, change: Change) -> Path:
    """A change of what `plain` was made from."""
    return restated(plain, folder, change, ending="png")


@pytest.mark.parametrize("numbers", [(5, 17, 40, 41), (41, 7, 40, 3)])
def test_frames_with_other_numbers_change_no_bit(
    base: Made, small_capture: Path, tmp_path: Path, numbers: tuple[int, ...]
) -> None:
    """What counts is the order in which the split lists them: batches stay the same."""
    folder = restated(small_capture, tmp_path / "frames", variants.renumbered(numbers))
    found = make(folder, BASE, frame=numbers[1])
    assert found.losses == base.losses
    assert torch.equal(found.trained.color, base.trained.color)


def margins(capture: Path) -> tuple[int, int, int, int]:
    """Pixels left, above, right and below that no band around a training mask touches."""
    record = read_capture(capture)
    on = torch.stack([record.mask(c, f) for c, f in record.split("train").pairs()]).any(0)
    rows, columns = (torch.nonzero(on.any(axis)).squeeze(1) for axis in (1, 0))
    height, width = on.shape
    free = (columns[0], rows[0], width - 1 - columns[-1], height - 1 - rows[-1])
    left, top, right, bottom = (max(int(n) - BAND, 0) for n in free)
    return left, top, right, bottom


def test_pictures_with_less_or_more_border(
    base: Made, plain: Path, small_capture: Path, tmp_path: Path
) -> None:
    free = margins(plain)
    assert free[0] + free[2] >= 4, "nothing to cut"
    for name, box in (("less", free), ("more", (-4, -3, -2, -5))):
        folder = restated(small_capture, tmp_path / name, variants.cropped(*box))
        found = make(folder, BASE)
        height, width = found.trained.opacity.shape
        assert (height, width) == (48 - box[1] - box[3], 48 - box[0] - box[2])
        top, left = max(box[1], 0), max(box[0], 0)
        inner = found.trained.color[max(-box[1], 0) :, max(-box[0], 0) :]
        rows, columns = min(48 - top, len(inner)), min(48 - left, inner.shape[1])
        expected = base.trained.color[top : top + rows, left : left + columns]
        assert found.losses["mse"] == pytest.approx(base.losses["mse"], rel=1e-4)
        within(inner[:rows, :columns], expected, TRAINED)


def test_the_middle_of_nine_pixels_is_the_pixel(
    base: Made, small_capture: Path, tmp_path: Path
) -> None:
    """Three times the resolution: the middle ray of three by three is the ray of the one."""
    folder = restated(small_capture, tmp_path / "large", variants.enlarged(3))
    torch.manual_seed(0)
    avatar = Avatar.create(read_capture(folder), BASE)
    found = render_view(avatar, view_of(avatar.record, 1, 1))
    assert found.opacity.shape == (144, 144)
    within(found.color[1::3, 1::3], base.untrained.color, UNTRAINED)
    within(found.opacity[1::3, 1::3], base.untrained.opacity, UNTRAINED)
    # and the mean of nine pixels is near it, where a shift by half a pixel would not be
    mean = found.opacity.reshape(48, 3, 48, 3).mean((1, 3))
    assert change_of(mean, base.untrained.opacity)[1] < 0.02


def test_the_mirror_image(base: Made, small_capture: Path, tmp_path: Path) -> None:
    folder = restated(small_capture, tmp_path / "mirror", variants.mirrored)
    checked = check_capture(read_capture(folder), deep=True)
    assert checked.vertex_error is not None and checked.vertex_error < 1e-3
    found = make(folder, BASE)
    for field in ("color", "opacity"):
        flipped = getattr(found.untrained, field).flip(1), getattr(found.trained, field).flip(1)
        within(flipped[0], getattr(base.untrained, field), MIRRORED)
        within(flipped[1], getattr(base.trained, field), MIRRORED_TRAINED)
        # the picture itself is another one
        assert change_of(flipped[0].flip(1), getattr(base.untrained, field))[1] > 5e-3
    assert found.losses["mse"] == pytest.approx(base.losses["mse"], rel=0.1)


def test_the_variants_say_what_they_should(plain: Path, tmp_path: Path) -> None:
    """A change that changed nothing would pass every test above."""
    before = np.load(plain / "new_vertices" / "1.npy")
    move = variants.moved((0.0, 0.0, math.pi / 2), (1.0, 0.0, 0.0))
    folder = restated_again(plain, tmp_path / "a", move)
    after = np.load(folder / "new_vertices" / "1.npy")
    expected = np.stack([1 - before[:, 1], before[:, 0], before[:, 2]], -1)
    np.testing.assert_allclose(after, expected, atol=1e-6)
    folder = restated_again(plain, tmp_path / "b", variants.mirrored)
    mirrored = np.load(folder / "new_vertices" / "1.npy")
    np.testing.assert_allclose(mirrored, before * [-1, 1, 1], atol=1e-6)
