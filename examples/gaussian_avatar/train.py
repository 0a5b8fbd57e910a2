"""Trains a Gaussian avatar on a capture, scores it on held-out images and draws it."""

import time
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from monopart.fields import render_gaussians
from monopart.geometry import orbit_cameras
from monopart.toolkit.animate import world_up
from monopart.toolkit.atomic import write_json
from monopart.toolkit.captures import CaptureRecord, read_capture
from monopart.toolkit.device import pick_device
from monopart.toolkit.lpips import LPIPS, load_lpips
from monopart.toolkit.metrics import Scores, aggregate, mask_box, score_image
from monopart.toolkit.optimizer import Adam
from monopart.toolkit.progress import progress_bar
from monopart.toolkit.protocols import held_out_pairs
from monopart.toolkit.video import save_png

from .avatar import GaussianAvatar

RATES = {"color_logits": 0.1, "opacity_logits": 0.03, "log_sizes": 0.02, "quats": 0.01}
RATES["offsets"] = 1e-3  # metres; the networks learn at the same
MARGIN = 16  # pixels around the person in which a splat costs something


def main(
    capture: Path,
    out: Path = Path("runs/gaussian_avatar"),
    seconds: float = 60.0,
    gaussians: int = 16000,
    seed: int = 0,
    device: str = "auto",
) -> None:
    """Train a Gaussian avatar; OUT receives metrics.json and pictures, truth above result.

    Args:
        capture: folder in the layout of ZJU-MoCap.
        out: folder of the results.
        seconds: of training.
        gaussians: number of them.
        seed: of the order of the images.
        device: cpu, cuda, cuda:N, or auto: CUDA where there is a GPU.
    """
    record, lpips = read_capture(capture).to(pick_device(device)), load_lpips()
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(seed)
    avatar = train(record, gaussians, seconds)
    scores = {}
    for split in held_out_pairs(record):
        scores[split], pictures = evaluate(avatar, record, split, lpips)
        save_png(out / f"{split}.png", torch.cat(pictures[::3], 1))
        print(split, scores[split]["full"])
    write_json(out / "metrics.json", {name: {"strict": found} for name, found in scores.items()})
    save_png(out / "turntable.png", torch.cat(turntable(avatar, record), 1))


def train(
    record: CaptureRecord, gaussians: int, seconds: float, steps: int = 100_000
) -> GaussianAvatar:
    """An avatar of the training images of a capture, in a time or a number of steps.

    Args:
        record: the capture.
        gaussians: their number.
        seconds: at most.
        steps: at most.
    """
    record.preload("train")
    pairs = record.split("train").pairs()
    betas = record.poses[pairs[0][1]].betas
    avatar = GaussianAvatar(record.body, betas, gaussians)
    groups = [
        {"params": [p], "rate": RATES.get(name, 1e-3)} for name, p in avatar.named_parameters()
    ]
    optimizer = Adam(groups, lr=1e-3, eps=1e-15, fused=True)
    order: list[int] = []
    start, step, done = time.perf_counter(), 0, 0.0
    with progress_bar("training") as update:
        while done < 1.0:
            order = order or torch.randperm(len(pairs)).tolist()
            loss = loss_of(avatar, record, *pairs[order.pop()])
            optimizer.zero_grad()
            loss.backward()
            for group in optimizer.param_groups:
                group["lr"] = group["rate"] * 0.05**done
            optimizer.step()
            step += 1
            done = max(step / steps, (time.perf_counter() - start) / seconds)
            update(min(done, 1.0), f"step {step}, loss {loss.detach():.4f}")
    return avatar


def loss_of(avatar: GaussianAvatar, record: CaptureRecord, camera: int, frame: int) -> Tensor:
    """Loss at one image: colour and silhouette, and consistency of a share of the Gaussians."""
    mask, pose = record.mask(camera, frame), record.poses[frame]
    top, left, bottom, right = mask_box(mask)
    top, left = max(0, top - MARGIN), max(0, left - MARGIN)
    bottom, right = min(mask.shape[0], bottom + MARGIN), min(mask.shape[1], right + MARGIN)
    crop = (slice(top, bottom), slice(left, right))
    truth = torch.cat([record.masked_image(camera, frame), mask[..., None]], -1)[crop]
    posed = record.body(pose)
    view = record.cameras[camera].cropped((left, top, right, bottom))
    image = render_gaussians(avatar(posed, pose.pose), view)
    rows = torch.randint(len(avatar.anchors), (1024,)).to(image.device)
    truth = truth.to(image)
    loss = (image - truth).abs().mean() + avatar.inconsistency(posed, pose.pose, rows, 0.002)
    return loss + 0.2 * (1 - similarity(image[..., :3], truth[..., :3]))


def similarity(a: Tensor, b: Tensor) -> Tensor:
    """Mean SSIM of two pictures [H, W, 3] with a uniform window, quick to differentiate."""
    x, y = a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None]
    mean_x, mean_y, xx, yy, xy = avg_pool2d(torch.cat([x, y, x * x, y * y, x * y]), 7, 1)
    luminance = (2 * mean_x * mean_y + 1e-4) / (mean_x**2 + mean_y**2 + 1e-4)
    spread = xx - mean_x**2 + yy - mean_y**2
    return (luminance * (2 * (xy - mean_x * mean_y) + 9e-4) / (spread + 9e-4)).mean()


@torch.no_grad()
def evaluate(
    avatar: GaussianAvatar, record: CaptureRecord, split: str, lpips: LPIPS | None
) -> tuple[Scores, list[Tensor]]:
    """Mean scores of a held-out split, protocol strict; and pictures, truth above result."""
    scores, pictures = [], []
    for camera, frame in held_out_pairs(record)[split]:
        pose, mask = record.poses[frame], record.mask(camera, frame)
        image = render_gaussians(avatar(record.body(pose), pose.pose), record.cameras[camera])
        image = (
            255 * image[..., :3].cpu().clamp(0, 1)
        ).round() / 255  # what is scored is what is saved
        truth = record.masked_image(camera, frame)
        scores.append(score_image(image, truth, mask, "strict", lpips))
        pictures.append(torch.cat([truth, image]))
    return aggregate(scores), pictures


@torch.no_grad()
def turntable(avatar: GaussianAvatar, record: CaptureRecord, views: int = 6) -> list[Tensor]:
    """Pictures from all around, in the pose of the first training frame."""
    train = record.split("train")
    pose = record.poses[train.frames[0]]
    posed, up = record.body(pose), world_up(record.cameras)
    center = posed.to_world(posed.joints).mean(0)
    cameras = orbit_cameras(record.cameras[train.cameras[0]], center, up, views)
    gaussians = avatar(posed, pose.pose)
    return [render_gaussians(gaussians, camera)[..., :3].cpu().clamp(0, 1) for camera in cameras]
