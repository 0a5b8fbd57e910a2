"""What was skipped, in words and numbers."""

from collections.abc import Mapping

from .report_data import SkipRow


def skip_rows(stats: Mapping[str, int], splits: str) -> list[SkipRow]:
    """Rows of the table of skipped work.

    Args:
        stats: counts from rendering or training.
        splits: what the counts are of, such as "rendering".
    """
    rows = []
    if "pixels" in stats:
        rows.append(
            SkipRow(
                f"{splits}: rays",
                stats["pixels"],
                stats["rays"],
                "exact: a ray that misses the body shell is background",
            )
        )
        rows.append(
            SkipRow(
                f"{splits}: samples, 64 per pixel of the image",
                64 * stats["pixels"],
                stats["samples_shell"],
                "exact: density is 0 farther than the radius from every part",
            )
        )
    rows += [
        SkipRow(
            f"{splits}: samples in the boxes of the bodies",
            stats["samples_dense"],
            stats["samples_shell"],
            "exact: voxels that no part reaches",
        ),
        SkipRow(
            f"{splits}: part evaluations",
            stats["samples_shell"] * stats["parts"],
            stats["pairs_found"],
            "exact: a sample is evaluated only by the parts within the radius",
        ),
        SkipRow(
            f"{splits}: part evaluations after learned occupancy",
            stats["pairs_found"],
            stats["pairs_evaluated"],
            "approximate where rows differ; off in evaluation unless asked for",
        ),
        SkipRow(
            f"{splits}: colour networks",
            stats["pairs_evaluated"],
            stats["colors_evaluated"],
            "exact: only the densest part of a sample gives a colour",
        ),
    ]
    return rows
