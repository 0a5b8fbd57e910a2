"""What was skipped, and why a picture is empty, in words and numbers."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from .avatar import Avatar, View
from .render import Picture
from .report_data import SkipRow

if TYPE_CHECKING:
    from rich.console import Console

PER_RAY = 64  # samples of a ray without skipping, as comparable methods take them
PLAIN_WIDTH = 120  # characters of the table in a file or a pipe
_KEPT = {
    "training": "approximate: cells learned to be empty or hidden",
    "rendering": "points that inverse skinning cannot bring back are outside the body",
}
VISIBLE = 0.5  # opacity from which on a pixel shows something


def skip_rows(stats: Mapping[str, int], what: str, num_parts: int) -> list[SkipRow]:
    """Rows of the table of skipped work; a count that is missing is None.

    Args:
        stats: counts from rendering or training; with "pixels" they are of whole images.
        what: what the counts are of, such as "rendering".
        num_parts: parts of the body.

    >>> [r.kept for r in skip_rows({"pixels": 100, "rays": 9}, "rendering", 5)][:2]
    [100, 9]
    """
    rows, shell = [], stats.get("samples_shell")
    if "pixels" in stats:
        boxed = stats.get("rays_box", stats["pixels"])
        rows += [
            SkipRow(
                f"{what}: rays in the box of the body",
                stats["pixels"],
                boxed,
                "exact: the shell lies inside the box",
            ),
            SkipRow(
                f"{what}: rays of the box",
                boxed,
                stats.get("rays"),
                "exact: a ray that misses the body shell is background",
            ),
            SkipRow(
                f"{what}: samples, {PER_RAY} per pixel of the image",
                PER_RAY * stats["pixels"],
                shell,
                "exact: density is 0 farther than the radius from every part",
            ),
            SkipRow(
                f"{what}: of the same samples, those that reach a network",
                PER_RAY * stats["pixels"],
                stats.get("samples_reached"),
                "the kinds above and those below together",
            ),
        ]
    evaluated = stats.get("samples_evaluated", shell)
    found, kept = stats.get("pairs_found"), stats.get("pairs_evaluated")
    return [
        *rows,
        SkipRow(
            f"{what}: samples in the boxes of the bodies",
            stats.get("samples_dense"),
            shell,
            "exact: voxels that no part reaches",
        ),
        SkipRow(
            f"{what}: samples of the shell",
            shell,
            evaluated,
            "within 5e-5 of full scale: the light of the ray is spent before",
        ),
        SkipRow(
            f"{what}: part evaluations",
            None if evaluated is None else evaluated * num_parts,
            found,
            "exact: a sample belongs only to the parts within the radius",
        ),
        SkipRow(f"{what}: part evaluations kept", found, kept, _KEPT.get(what, _KEPT["rendering"])),
        SkipRow(
            f"{what}: colour networks",
            kept,
            stats.get("colors_evaluated"),
            "exact: only the densest part of a sample gives a colour",
        ),
    ]


def module_rows(
    avatar: Avatar, training: Mapping[str, int], iterations: int, rendering: Mapping[str, int]
) -> list[SkipRow]:
    """Rows of the modules and terms that a run does without.

    Args:
        avatar: the person, for its configuration, model and capture.
        training: counts of the training; empty where it was not counted.
        iterations: steps of the training.
        rendering: counts of the renderings.
    """
    model, loss, record = avatar.model, avatar.config.loss, avatar.record
    rows = [
        SkipRow(f"training: {name} loss", iterations, 0, "exact: its weight is 0")
        for name, weight in (
            ("LPIPS", loss.lpips),
            ("consistency", loss.consistency),
            ("offset", loss.offset),
        )
        if not weight
    ]
    for what, stats in (("training", training), ("rendering", rendering)):
        if model.backward_residual is None and stats:
            why = "exact: the configuration has no residual"
            rows.append(SkipRow(f"{what}: residual network", stats.get("pairs_evaluated"), 0, why))
    if model.forward_residual is not None and rendering:
        why = "exact: only the consistency loss uses it"
        count = rendering.get("pairs_evaluated")
        rows.append(SkipRow("rendering: forward residual network", count, 0, why))
    pairs = [pair for split in record.splits.values() for pair in split.pairs()]
    bent = sum(record.raw_cameras[camera].is_distorted for camera, _ in pairs)
    if bent < len(pairs):
        why = "exact: the distortion of a camera is 0"
        rows.append(SkipRow("reading: undistortion of images", len(pairs), bent, why))
    return rows


def print_skipping(rows: Sequence[SkipRow]) -> None:
    """Print the table of skipped work on stderr.

    Args:
        rows: from `skip_rows` and `module_rows`.
    """
    from rich.table import Table

    table = Table(title="What was skipped", title_justify="left")
    table.add_column("work")
    for name in ("dense", "evaluated", "share"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("why the image stays the same")
    for row in rows:
        known = row.dense is not None and row.kept is not None and row.dense > 0
        share = f"{100 * (row.kept or 0) / (row.dense or 1):.1f} %" if known else "-"
        table.add_row(row.what, _count(row.dense), _count(row.kept), share, row.note)
    plain_console().print(table)


def plain_console() -> "Console":
    """A console on stderr, wide enough for a table where no terminal says how wide it is."""
    from rich.console import Console

    console = Console(stderr=True)
    return console if console.is_terminal else Console(stderr=True, width=PLAIN_WIDTH)


def _count(value: int | None) -> str:
    return "-" if value is None else f"{value:,}".replace(",", " ")


def why_empty(avatar: Avatar, view: View, picture: Picture) -> str | None:
    """Why a picture shows nothing, in one line; None where it shows something.

    Args:
        avatar: the person.
        view: what was rendered.
        picture: the rendering.
    """
    if float(picture.opacity.max()) >= VISIBLE:
        return None
    verts = avatar.record.body(view.pose).verts_world
    pixels, depth = view.camera.project(verts)
    height, width = view.camera.size
    if not bool((depth > 0).any()):
        return "the person is behind the camera; choose another camera or frame"
    if not bool(view.camera.visible(verts).any()):
        x, y = (int(v) for v in pixels[depth > 0].mean(0))
        return (
            f"the person is outside the image (about pixel {x}, {y} of {width} x {height}); "
            "choose another camera or frame"
        )
    rays, samples = picture.stats["rays"], picture.stats["samples_shell"]
    return (
        f"{rays} rays enter the body shell and hold {samples} samples, but the density there is "
        f"too low (largest opacity {float(picture.opacity.max()):.3f}); train longer"
    )
