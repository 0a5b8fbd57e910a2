"""Metrics against scikit-image, against plain loops, and against known figures of a capture."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from monopart.geometry.errors import InputError
from monopart.toolkit.lpips import LPIPS
from monopart.toolkit.lpips_weights import expected_shapes
from monopart.toolkit.metrics import (
    METRICS,
    REGIONS,
    aggregate,
    mask_box,
    psnr,
    score_image,
    ssim,
    ssim_map,
)

BLACK_IMAGES = [
    (1, 0),
    (2, 10),
    (3, 20),
    (4, 30),
    (1, 40),
    (2, 50),
    (3, 60),
    (4, 70),
    (1, 80),
    (2, 90),
]
WINDOWS = {
    "gaussian": {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False},
    "uniform": {},
}


def pair(height=40, width=31):
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(height, width, 3, generator=generator)
    return a, (a + 0.2 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1)


def figure(height=56, width=64):
    mask = torch.zeros(height, width, dtype=torch.bool)
    mask[10:45, 20:50] = True
    mask[10:15, 20:25] = False
    pred, target = pair(height, width)
    return pred * mask[..., None], target, mask


@pytest.fixture(scope="module")
def lpips():
    generator = torch.Generator().manual_seed(1)
    shapes = expected_shapes().items()
    return LPIPS({name: 0.05 * torch.rand(s, generator=generator) - 0.02 for name, s in shapes})


def test_psnr():
    a, b = pair()
    expected = peak_signal_noise_ratio(a.double().numpy(), b.double().numpy(), data_range=1)
    assert psnr(a, b) == pytest.approx(expected, abs=1e-9)
    assert psnr(a, a) == math.inf
    mask = torch.rand(40, 31) > 0.5
    assert psnr(a, b, mask) == pytest.approx(psnr(a[mask], b[mask]), abs=1e-12)
    b[~mask] = 7.0
    assert psnr(a, b, mask) == pytest.approx(psnr(a[mask], b[mask]), abs=1e-12)
    with pytest.raises(InputError, match="mask"):
        psnr(a, b, torch.zeros(40, 31, dtype=torch.bool))


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize("data_range", [1.0, 2.0])
@pytest.mark.parametrize("size", [(40, 31), (11, 12)])
def test_ssim_equals_scikit_image(window, data_range, size):
    a, b = pair(*size)
    expected, full = structural_similarity(
        a.double().numpy(),
        b.double().numpy(),
        data_range=data_range,
        channel_axis=2,
        full=True,
        **WINDOWS[window],
    )
    assert ssim(a, b, data_range=data_range, window=window) == pytest.approx(expected, abs=1e-9)
    ours = ssim_map(a, b, data_range=data_range, window=window)
    np.testing.assert_allclose(ours.numpy(), full.mean(2), atol=1e-9)


def test_ssim_bounds():
    a, _ = pair()
    assert ssim(a, a) == pytest.approx(1, abs=1e-12)
    with pytest.raises(InputError, match="11×11"):
        ssim(a[:10], a[:10])


def test_mask_box():
    mask = torch.zeros(9, 7, dtype=torch.bool)
    mask[2, 3] = mask[5, 6] = True
    assert mask_box(mask) == (2, 3, 6, 7)
    with pytest.raises(InputError, match="mask"):
        mask_box(torch.zeros(3, 3, dtype=torch.bool))


def test_strict_regions(lpips):
    pred, target, mask = figure()
    scores = score_image(pred, target, mask, "strict", lpips)
    assert tuple(scores) == REGIONS
    assert all(tuple(metrics) == METRICS for metrics in scores.values())
    black = target * mask[..., None]
    box = (slice(10, 45), slice(20, 50))
    assert scores["full"]["psnr"] == psnr(pred, black)
    assert scores["box"]["psnr"] == psnr(pred[box], black[box])
    assert scores["silhouette"]["psnr"] == psnr(pred, target, mask)
    assert scores["full"]["ssim"] == ssim(pred, black)
    assert scores["box"]["ssim"] == ssim(pred[box], black[box])
    assert scores["silhouette"]["ssim"] == ssim_map(pred, black)[mask].mean().item()
    assert scores["full"]["lpips"] == lpips(pred, black).item()
    assert scores["box"]["lpips"] == lpips(pred[box], black[box]).item()
    spatial = lpips(pred, black, spatial=True)[mask].mean().item()
    assert scores["silhouette"]["lpips"] == pytest.approx(spatial, rel=1e-5)


def test_legacy_is_the_published_protocol(lpips):
    pred, target, mask = figure()
    scores = score_image(pred, target, mask, "legacy", lpips)
    black = target * mask[..., None]
    expected = structural_similarity(
        pred.double().numpy(), black.double().numpy(), data_range=2, channel_axis=2
    )
    assert tuple(scores) == ("full",)
    assert scores["full"]["psnr"] == psnr(pred, black)
    assert scores["full"]["ssim"] == pytest.approx(expected, abs=1e-9)
    assert scores["full"]["lpips"] == lpips(pred, black, value_range="[0,1]").item()


def test_scores_do_not_depend_on_the_target_background():
    pred, target, mask = figure()
    other = torch.where(mask[..., None], target, 0.3)
    assert score_image(pred, target, mask) == score_image(pred, other, mask)
    assert score_image(pred, target, mask) == score_image(pred, target, mask)


def test_undefined_metrics_are_none(lpips):
    pred, target, _ = figure()
    small = torch.zeros(56, 64, dtype=torch.bool)
    small[5:17, 5:14] = True
    scores = score_image(pred, target, small, "strict", lpips)
    assert scores["box"]["ssim"] is None and scores["box"]["lpips"] is None
    assert scores["full"]["lpips"] is not None
    assert score_image(pred, target, small)["full"]["lpips"] is None


def test_score_errors():
    pred, target, mask = figure()
    with pytest.raises(InputError, match="mask"):
        score_image(pred, target, torch.zeros_like(mask))
    with pytest.raises(InputError, match="finite"):
        score_image(pred * math.nan, target, mask)
    with pytest.raises((InputError, TypeError)):
        score_image(pred, target, mask, "loose")


def test_aggregate():
    scores = [
        {"full": {"psnr": 30.0, "lpips": None}, "box": {"psnr": 20.0, "lpips": None}},
        {"full": {"psnr": 33.0, "lpips": 0.5}, "box": {"psnr": 21.0, "lpips": None}},
    ]
    expected = {"full": {"psnr": 31.5, "lpips": 0.5}, "box": {"psnr": 20.5, "lpips": None}}
    assert aggregate(scores) == expected
    with pytest.raises(InputError, match="at least one"):
        aggregate([])
    with pytest.raises(InputError, match="same regions"):
        aggregate([scores[0], {"full": {"psnr": 1.0}}])


def test_black_image_on_a_capture(captures_dir):
    """The known figures of a black image: mean over the images of each image's PSNR and SSIM."""
    cv2 = pytest.importorskip("cv2")
    folder = captures_dir / "actor_a"
    if not folder.is_dir():
        pytest.skip(f"no capture at {folder}")
    scores, errors = [], []
    for camera, frame in BLACK_IMAGES:
        name = f"Camera_B{camera + 1}/{frame:06d}"
        image = cv2.imread(str(folder / f"{name}.jpg"))[..., ::-1].astype(np.float32) / 255
        mask = cv2.imread(str(folder / "mask" / f"{name}.png"), cv2.IMREAD_GRAYSCALE) > 127
        image, mask = torch.from_numpy(image), torch.from_numpy(mask)
        scores.append(score_image(torch.zeros_like(image), image, mask))
        errors.append((image * mask[..., None]).double().square().mean().item())
    mean = aggregate(scores)
    assert mean["full"]["psnr"] == pytest.approx(17.40, abs=0.005)
    assert mean["box"]["psnr"] == pytest.approx(10.18, abs=0.005)
    assert mean["full"]["ssim"] == pytest.approx(0.895, abs=0.0005)
    assert mean["box"]["ssim"] == pytest.approx(0.437, abs=0.0005)
    # The other reading of "mean PSNR" gives another figure: the two are not to be confused.
    assert -10 * math.log10(np.mean(errors)) == pytest.approx(17.32, abs=0.005)
