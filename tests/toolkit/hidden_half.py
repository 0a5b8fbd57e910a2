"""What an avatar makes of surfaces that look where no camera stood, asked on training pictures.

    python tests/toolkit/hidden_half.py CAPTURE --settings appearance.light_out=0

Trained on are frames 0 to 79 of the training camera, and of these the half of the person that looks
to one side; the way there takes the place of the way to the camera in `toolkit.light`. Asked is the
other half in frames 80 to 99, away from the outline. So a choice about light that nobody saw needs
no picture of a test split.
"""

import dataclasses
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import torch
import tyro
import warp as wp
from dressed_capture import shoot
from tyro.conf import Positional

from monopart.geometry.surface import vertex_normals
from monopart.toolkit.arguments import resolve
from monopart.toolkit.avatar import Avatar, view_of
from monopart.toolkit.captures import Split, patches, read_capture
from monopart.toolkit.captures.records import CaptureRecord
from monopart.toolkit.part_picture import nearest_part
from monopart.toolkit.render import render_view
from monopart.toolkit.train import Trainer

TRAIN, LATER = range(80), range(80, 100, 2)
OUTLINE = 9  # pixels: edge of the square that shrinks masks
SHADE = 4.0  # pixels: blur that leaves shade alone
FAR = 1e4  # metres
FACING = {"hidden": (-1.0, -0.1), "hidden, beyond 127 degrees": (-1.0, -0.6), "seen": (0.1, 1.0)}


def aside(record: CaptureRecord) -> torch.Tensor:
    """Unit vector to one side of the training camera as the person sees it, level, world."""
    camera = record.cameras[record.split("train").cameras[0]]
    middle = torch.stack([record.poses[f].translation for f in TRAIN]).mean(0)
    side = torch.linalg.cross(-camera.R[1], camera.center - middle)
    return torch.nn.functional.normalize(side, dim=0)


def facing(record: CaptureRecord, frame: int, way: torch.Tensor) -> np.ndarray:
    """Cosine [H, W] between a way and the naked body's normals; off the body, of the nearest."""
    camera = record.cameras[record.split("train").cameras[0]]
    with torch.no_grad():
        verts = record.body(record.poses[frame]).verts_world.reshape(-1, 3)
    faces = record.body.faces
    cosines = (vertex_normals(verts, faces) @ way).numpy()
    corners = faces.reshape(-1).numpy().astype(np.int32)
    points = wp.array(verts.numpy(), dtype=wp.vec3, device="cpu")
    mesh = wp.Mesh(points, wp.array(corners, dtype=int, device="cpu"))
    rays = camera.rays(camera.pixel_grid().reshape(-1, 2))
    origins = rays.origins.expand_as(rays.directions)
    face, bary = shoot(mesh, origins.numpy(), rays.directions.numpy())
    hit = face >= 0
    on = np.zeros(len(hit), np.float32)
    on[hit] = (bary[hit] * cosines[faces.numpy()[face[hit]]]).sum(1)
    pixel = np.where(hit, np.arange(len(hit)), -1).astype(np.int32)
    return on[nearest_part(pixel.reshape(camera.size))[0]]


def trained(record: CaptureRecord, settings: list[str], iterations: int, seed: int) -> Avatar:
    """An avatar that has seen one half of the person.

    Args:
        record: the capture; its training split decides the frames.
        settings: entries of the configuration that replace those of `best`.
        iterations: steps.
        seed: of the run.
    """
    config = resolve("best", [settings, ["train.ignore_band=1"]], None, iterations, seed)
    way = aside(record)
    hidden: Iterator[torch.Tensor] = (
        torch.from_numpy(facing(record, frame, way) < 0) for frame in record.split("train").frames
    )
    torch.manual_seed(seed)
    avatar = Avatar.create(record, config)
    if avatar.model.light is not None:
        avatar.model.light.eyes.copy_(FAR * way)
    usual = patches.edge_band
    patches.edge_band = lambda mask, width: next(hidden)  # what no loss sees
    try:
        trainer = Trainer(avatar)
    finally:
        patches.edge_band = usual
    trainer.loop()
    return trainer.avatar


def main(
    capture: Positional[Path],
    settings: tyro.conf.UseAppendAction[list[str]],
    iterations: int = 500,
    seed: int = 0,
) -> None:
    """Print PSNR over the halves of the person, of all errors and of shade alone.

    Args:
        capture: folder of the capture.
        settings: entries of the configuration to replace.
        iterations: steps.
        seed: of the run.
    """
    record = read_capture(capture)
    camera = record.split("train").cameras[0]
    splits = {"train": Split((camera,), tuple(TRAIN))}
    record = dataclasses.replace(record, splits=splits)
    avatar, way = trained(record, settings, iterations, seed), aside(record)
    sums = {name: np.zeros(3) for name in FACING}
    for frame in LATER:
        with torch.no_grad():
            made = render_view(avatar, view_of(record, camera, frame)).color.clamp(0, 1).numpy()
        taken, mask = record.image(camera, frame).numpy(), record.mask(camera, frame).numpy()
        error = np.where(mask[..., None], made - taken, 0).astype(np.float32)
        share = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), SHADE)[..., None]
        shade = cv2.GaussianBlur(error, (0, 0), SHADE) / np.maximum(share, 1e-3)
        inner = cv2.erode(mask.astype(np.uint8), np.ones((OUTLINE, OUTLINE))) > 0
        looks = facing(record, frame, way)
        for name, (low, high) in FACING.items():
            rows = inner & (looks > low) & (looks < high)
            sums[name] += [(error[rows] ** 2).sum(), (shade[rows] ** 2).sum(), 3 * rows.sum()]
    for name, (whole, smooth, count) in sums.items():
        psnr = [-10 * np.log10(x / count) for x in (whole, smooth)]
        sys.stdout.write(f"{name}: {psnr[0]:.2f} dB, shade {psnr[1]:.2f} dB\n")


if __name__ == "__main__":
    tyro.cli(main)
