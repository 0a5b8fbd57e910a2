"""The paper's own tables: figures as published, never measured here."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PublishedScore:
    """One cell of the paper's comparison, mean over the subjects of a data set."""

    method: str
    """Name of the method."""
    dataset: str
    """`zju_mocap` or `monocap`."""
    split: str
    """`novel_view` or `novel_pose`."""
    psnr: float
    """Decibels, full image on black."""
    ssim: float
    """Data range 2."""
    lpips: float
    """LPIPS-VGG on inputs in [0, 1], times 1000."""


_GROUPS = (
    ("zju_mocap", "novel_view"),
    ("zju_mocap", "novel_pose"),
    ("monocap", "novel_view"),
    ("monocap", "novel_pose"),
)
_ROWS = {
    "NeuralBody": "29.03 .964 42.47  29.17 .966 42.21  32.36 .986 16.70  32.62 .986 16.44",
    "SHERF": "29.96 .968 40.63  29.75 .968 39.12  32.41 .986 16.41  32.86 .987 15.98",
    "HumanNeRF": "30.66 .969 33.38  30.88 .974 31.21  32.68 .987 15.52  33.19 .988 13.29",
    "Instant-NVR": "31.01 .971 38.45  31.53 .976 31.60  32.61 .988 16.68  33.58 .989 13.14",
    "GauHuman": "31.34 .965 30.51  31.66 .969 28.94  33.45 .985 13.15  33.84 .987 12.17",
    "MonoPartNeRF": "32.12 .972 35.50  32.42 .977 29.05  33.67 .988 14.87  33.91 .989 12.03",
}
TRAINING_TIMES = {
    "NeuralBody": "10 h",
    "SHERF": "10 h",
    "HumanNeRF": "10 h",
    "Instant-NVR": "5 min",
    "GauHuman": "2 min",
    "MonoPartNeRF": "6 min",
}
"""Training times as published, on an RTX 3090."""


def published_scores() -> list[PublishedScore]:
    """Every figure of the comparison with other methods.

    Returns:
        One entry per method, data set and split, in the order of the paper.

    >>> len(published_scores()), published_scores()[-1].lpips
    (24, 12.03)
    """
    found = []
    for method, text in _ROWS.items():
        values = [float(v) for v in text.split()]
        for i, (dataset, split) in enumerate(_GROUPS):
            found.append(PublishedScore(method, dataset, split, *values[3 * i : 3 * i + 3]))
    return found
