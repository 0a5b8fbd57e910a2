"""``monopart-bench render RUN``: seconds per picture of a trained run, and what was evaluated."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from monopart.geometry.errors import InputError

from .registry import Method, Operation, Problem, Settings

PRUNE = 2e-3
COARSE = (2, 3, 4)
VIEWS = 3


@dataclass(eq=False)
class ViewData:
    """One view of a trained avatar."""

    avatar: Any
    view: Any

    @cached_property
    def dense(self) -> Any:
        """The picture with no ray left out."""
        from monopart.toolkit.render import render_view

        return render_view(self.avatar, self.view, skip=False)


def _picture(**options: Any) -> Callable[[Any], Callable[[], Any]]:
    def prepare(data: ViewData) -> Callable[[], Any]:
        from monopart.toolkit.render import render_view

        return lambda: render_view(data.avatar, data.view, **options)

    return prepare


def trained(settings: Settings) -> Any:
    """The avatar of the run that the command line named.

    Raises:
        InputError: no run was named, or it cannot be read.
    """
    from monopart.toolkit.runs import open_run

    if settings.run is None:
        raise InputError("expected a run folder, found none; name one made by monopart train")
    return open_run(settings.run, settings.capture)


def view_problems(settings: Settings, opened: Callable[[Settings], Any]) -> Iterator[Problem]:
    """Some held-out views of an avatar.

    Args:
        settings: what the command line asked for.
        opened: finds the avatar.
    """
    import dataclasses

    from monopart.toolkit.avatar import view_of
    from monopart.toolkit.captures.frames import spread

    avatar = opened(settings)
    record = avatar.record
    name = "novel_view" if "novel_view" in record.splits else "train"
    for camera, frame in spread(record.split(name).pairs(), 1 if settings.quick else VIEWS):
        view = view_of(record, camera, frame)
        if settings.quick:
            view = dataclasses.replace(view, camera=view.camera.resized((24, 24)))
        height, width = view.camera.size
        label = f"camera {record.camera_names[camera]} frame {frame}"
        yield Problem(height * width, label, ViewData(avatar, view))


def _judge(data: ViewData, picture: Any) -> dict[str, float]:
    stats = picture.stats
    dense = 64.0 * stats["pixels"]
    return {
        "error": float((picture.color - data.dense.color).abs().max()),
        "mean error": float((picture.color - data.dense.color).abs().mean()),
        "rays %": 100.0 * stats["rays"] / stats["pixels"],
        "samples % of 64 a pixel": 100.0 * stats["samples_shell"] / dense,
        "pairs evaluated %": 100.0 * stats["pairs_evaluated"] / dense,
        "colours %": 100.0 * stats["colors_evaluated"] / dense,
    }


def operations() -> tuple[Operation, ...]:
    """The one operation of the suite."""
    methods = (
        Method("exact skipping", _picture(), ours=True),
        Method(f"learned occupancy, {PRUNE}", _picture(prune=PRUNE), ours=True),
        *(Method(f"coarse to fine, {n}", _picture(coarse=n), ours=True) for n in COARSE),
        Method(
            f"learned occupancy, {PRUNE}, and coarse to fine, {COARSE[0]}",
            _picture(prune=PRUNE, coarse=COARSE[0]),
            ours=True,
        ),
        Method("networks in float16", _picture(half=True), ours=True),
        Method("every ray of the image", _picture(skip=False), ours=True),
    )
    return (
        Operation(
            *("picture", "Rendering one picture, posing the body included"),
            "largest difference in colour from the picture with every ray",
            *(methods, lambda settings: view_problems(settings, trained), _judge),
            ("Shares refer to 64 samples for every pixel of the image.",),
        ),
    )
