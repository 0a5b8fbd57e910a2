"""A capture with many cameras for choosing presets, so that no test split is looked at.

    python tests/toolkit/dressed_capture.py CAPTURE OUT --seed 1

Cameras, body and the motion of the first 100 frames are those of a capture in ZJU-MoCap layout;
cover, movement, texture and light are made up here: a wavy cover that moves, stripes and a fine
pattern, three lamps that throw shadows, and a sky. Trained on are frames 0 to 79 of camera 0; novel
views are every eighth of these from cameras 1 to 4, novel poses frames 80 to 99 of cameras 0 and 3.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import tyro
import warp as wp
from tyro.conf import Positional

from monopart.geometry.rigid import invert_affine, transform_points
from monopart.geometry.skinning import blend_transforms
from monopart.geometry.surface import vertex_normals
from monopart.toolkit.captures import read_capture
from monopart.toolkit.captures.records import CaptureRecord
from monopart.toolkit.scene import canonical_body

TRAIN, LATER, VIEWS = range(80), range(80, 100), range(0, 80, 8)
FINER = 2  # rays of a pixel along each axis
PLATE = 0.3  # linear grey behind the person
LINKED = ("annots.npy", "annots.json", "body.npz", "new_params", "new_vertices")


@wp.kernel
def trace(
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    face: wp.array(dtype=int),
    bary: wp.array(dtype=wp.vec2),
):
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, origins[i], directions[i], 100.0)
    face[i] = -1
    if hit.result:
        face[i] = hit.face
        bary[i] = wp.vec2(hit.u, hit.v)


def shoot(mesh: wp.Mesh, origins: np.ndarray, directions: np.ndarray) -> tuple:
    """Face that each ray meets first (-1: none), and barycentrics of its corners."""
    face = wp.zeros(len(origins), dtype=int, device="cpu")
    bary = wp.zeros(len(origins), dtype=wp.vec2, device="cpu")
    rays = [
        wp.array(x.astype(np.float32), dtype=wp.vec3, device="cpu") for x in (origins, directions)
    ]
    wp.launch(trace, len(origins), [mesh.id, *rays, face, bary], device="cpu")
    two = bary.numpy()
    return face.numpy(), np.c_[two, 1 - two.sum(1)]


def waves(points: np.ndarray, frequency: float, seed: int) -> np.ndarray:
    """A mean of five plane waves, about -1 to 1."""
    random = np.random.default_rng(seed)
    drawn = [(random.normal(0, frequency, 3), random.uniform(0, 6.28)) for _ in range(5)]
    return sum(np.sin(points @ k + phase) for k, phase in drawn) / 5


def srgb(linear: np.ndarray) -> np.ndarray:
    high = 1.055 * np.power(np.maximum(linear, 1e-6), 1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, high)


@dataclass
class Dressed:
    """A person with cover, texture and light."""

    record: CaptureRecord
    seed: int

    def __post_init__(self) -> None:
        random, body = np.random.default_rng(self.seed), self.record.body
        canonical = canonical_body(self.record)
        self.canonical_maps = self.maps(canonical)
        self.faces = body.faces.numpy()
        self.rest = canonical.verts.reshape(-1, 3).numpy()
        self.outward = vertex_normals(torch.from_numpy(self.rest), body.faces).numpy()
        weights, height = body.weights.numpy(), self.rest[:, 1] - self.rest[:, 1].min()
        trousers = weights[:, [1, 2, 4, 5]].sum(1) * np.clip((height - 0.35) / 0.1, 0, 1)
        torso, head = weights[:, [0, 3, 6, 9]].sum(1), weights[:, 15]
        self.kind = np.stack([torso, trousers, head], 1)
        self.thick = 0.008 + 0.022 * torso * random.uniform(0.5, 1) + 0.035 * trousers
        self.moves = 0.6 * (0.003 + 0.006 * torso + 0.014 * trousers)
        self.wave = random.normal(0, 9, (6, 3))
        self.phase, self.speed = random.uniform(0, 6.28, 6), 5 * random.normal(0, 1, 6)
        self.way = random.normal(0, 1, (6, 3))
        self.way /= np.linalg.norm(self.way, axis=1, keepdims=True)
        self.lamps = random.normal(0, 1, (3, 3))
        self.lamps[:, 2] = 0.6 * np.abs(self.lamps[:, 2]) + 0.3
        self.lamps /= np.linalg.norm(self.lamps, axis=1, keepdims=True)
        tint = np.array([[1, 0.95, 0.9], [0.9, 0.95, 1], [1, 1, 1]])
        self.power = random.uniform(0.25, 0.8, 3)[:, None] * tint
        self.sky = random.uniform(0.25, 0.4)

    def maps(self, posed) -> torch.Tensor:
        body = self.record.body
        flat = posed.transforms.detach().reshape(-1, body.num_joints, 4, 4)[0]
        return blend_transforms(flat, body.weights)

    def covered(self, seconds: float) -> np.ndarray:
        """Canonical vertices of the cover at a time, metres."""
        cover = self.outward * self.thick[:, None]
        for k, phase, speed, way in zip(self.wave, self.phase, self.speed, self.way, strict=True):
            sway = np.sin(self.rest @ k + phase + speed * seconds)
            cover = cover + (self.moves * sway)[:, None] * way
        return self.rest + cover

    def world(self, frame: int) -> torch.Tensor:
        """Vertices of the cover in a frame, world metres."""
        posed = self.record.body(self.record.poses[frame])
        cover = torch.from_numpy(self.covered(frame / 12.0)).float()
        unposed = transform_points(invert_affine(self.canonical_maps)[0], cover)
        local = transform_points(self.maps(posed), unposed)
        rotation, shift = posed.rotation.detach(), posed.translation.detach()
        return local @ rotation.reshape(3, 3).T + shift.reshape(3)

    def albedo(self, points: np.ndarray, kind: np.ndarray) -> np.ndarray:
        """Linear colours of canonical points by what covers them."""
        torso, trousers, head = kind.T
        stripe = np.sin(points[:, 1] * 2 * np.pi / 0.035 + 1.5 * waves(points, 12, 2)) > 0
        zigzag = 6 * np.abs((40 * points[:, 0]) % 2 - 1)
        weave = np.sin(points[:, 1] * 2 * np.pi / 0.012 + zigzag) > 0

        def mixed(first: tuple, second: tuple, choice: np.ndarray, spread: np.ndarray):
            return np.where(choice[:, None], first, second) * (1 + spread[:, None])

        skin = np.array([0.62, 0.42, 0.33]) * (1 + 0.12 * waves(points, 30, 1)[:, None])
        shirt = mixed((0.75, 0.72, 0.66), (0.12, 0.16, 0.3), stripe, 0.08 * waves(points, 60, 3))
        cloth = mixed((0.33, 0.22, 0.2), (0.2, 0.13, 0.14), weave, 0.15 * waves(points, 10, 4))
        hair = np.array([0.07, 0.05, 0.04]) * (1 + 0.5 * waves(points, 90, 5)[:, None])
        middle = self.rest[self.kind[:, 2] > 0.5][:, 2].mean()
        above = points[:, 1] > self.rest[:, 1].max() - 0.11
        top = (head > 0.5) & (above | (points[:, 2] < middle - 0.02))
        color = np.where((torso > 0.45)[:, None], shirt, skin)
        color = np.where((trousers > 0.4)[:, None], cloth, color)
        return np.clip(np.where(top[:, None], hair, color), 0, 1)

    def lit(self, mesh: wp.Mesh, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Light on surface points: the sky, and the lamps where nothing is in the way."""
        total = self.sky * (0.6 + 0.4 * normals[:, 2:3]) * np.ones(3)
        for lamp, power in zip(self.lamps, self.power, strict=True):
            facing = np.clip(normals @ lamp, 0, None)
            rows = np.nonzero(facing)[0]
            start = points[rows] + 4e-3 * normals[rows]
            blocked, _ = shoot(mesh, start, np.tile(lamp, (len(rows), 1)))
            facing[rows[blocked >= 0]] = 0
            total = total + facing[:, None] * power
        return total

    def picture(self, camera: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """sRGB picture (H, W, 3) and coverage (H, W), 0 to 1."""
        view, verts = self.record.cameras[camera], self.world(frame)
        (height, width), faces = view.size, self.faces
        flat = faces.reshape(-1).astype(np.int32)
        mesh = wp.Mesh(
            wp.array(verts.numpy(), dtype=wp.vec3, device="cpu"),
            wp.array(flat, dtype=int, device="cpu"),
        )
        ys, xs = np.meshgrid(
            *((np.arange(n * FINER) + 0.5) / FINER for n in (height, width)), indexing="ij"
        )
        pixels = torch.from_numpy(np.stack([xs, ys], -1).reshape(-1, 2)).float()
        corners, _ = view.project(verts)
        inside = ((pixels > corners.amin(0) - 2) & (pixels < corners.amax(0) + 2)).all(1)
        rays = view.rays(pixels[inside])
        face, bary = shoot(
            mesh, rays.origins.expand_as(rays.directions).numpy(), rays.directions.numpy()
        )
        hit = face >= 0
        corner, bary = faces[face[hit]], bary[hit][..., None]
        normals = vertex_normals(verts, self.record.body.faces).numpy()

        def there(values: np.ndarray) -> np.ndarray:
            return (bary * values[corner]).sum(1)

        normal = there(normals)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        light = self.lit(mesh, there(verts.numpy()), normal)
        colors = np.zeros((len(pixels), 4))
        shown = np.clip(self.albedo(there(self.rest), there(self.kind)) * light, 0, 1)
        colors[np.nonzero(inside.numpy())[0][hit]] = np.c_[shown, np.ones(len(shown))]
        colors = colors.reshape(height, FINER, width, FINER, 4).mean((1, 3))
        alpha = colors[..., 3]
        return srgb(colors[..., :3] + PLATE * (1 - alpha[..., None])), alpha


def main(capture: Positional[Path], out: Positional[Path], seed: int = 1) -> None:
    """Write the capture.

    Args:
        capture: the capture whose cameras, body and training motion are used.
        out: new folder.
        seed: decides cover, movement and light.
    """
    torch.set_num_threads(1)
    record = read_capture(capture)
    person = Dressed(record, seed)
    out.mkdir(parents=True)
    for name in LINKED:
        if (capture / name).exists():
            (out / name).symlink_to((capture / name).resolve())
    jobs = {(0, f) for f in (*TRAIN, *LATER)} | {(3, f) for f in LATER}
    jobs |= {(c, f) for c in (1, 2, 3, 4) for f in VIEWS}
    for camera, frame in sorted(jobs):
        image, alpha = person.picture(camera, frame)
        name = record.camera_names[camera]
        files = (
            (out / name / f"{frame:06d}.jpg", (255 * image[..., ::-1]).round()),
            (out / "mask" / name / f"{frame:06d}.png", 255 * (alpha > 0.5)),
        )
        for path, pixels in files:
            path.parent.mkdir(parents=True, exist_ok=True)
            good = [cv2.IMWRITE_JPEG_QUALITY, 95] if path.suffix == ".jpg" else []
            cv2.imwrite(str(path), pixels.clip(0, 255).astype(np.uint8), good)
    (out / "mask_cihp").symlink_to("mask")
    splits = json.loads((capture / "splits.json").read_text())
    splits["train"] = {"cameras": [0], "frames": [*TRAIN]}
    splits["novel_view"] = {"cameras": [1, 2, 3, 4], "frames": [*VIEWS]}
    splits["novel_pose"] = {"cameras": [0, 3], "frames": [*LATER]}
    (out / "splits.json").write_text(json.dumps(splits))


if __name__ == "__main__":
    tyro.cli(main)
