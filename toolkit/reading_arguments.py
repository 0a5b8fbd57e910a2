"""The arguments that say how a capture is read; shared by the commands that read one."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import arg

if TYPE_CHECKING:
    from .captures import Reading

_OF_SUBJECT = "(default: the subject's, else 1)"


@dataclass(frozen=True)
class ReadingFlags:
    """How the capture is read; capture.json in its folder may state the same entries."""

    params: Annotated[
        str | None, arg(metavar="NAME", help_behavior_hint="(default: new_params, else params)")
    ] = None
    """Folder of body poses inside the capture."""
    body: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(default: the capture's body.npz)")
    ] = None
    """Body file that the poses belong to (.npz, or .pkl of SMPL), where it is not the capture's."""
    subject: Annotated[
        str | None, arg(metavar="NAME", help_behavior_hint="(default: from the folder's name)")
    ] = None
    """Subject of ZJU-MoCap (377 386 387 392 393 394) or MonoCap (lan marc olek vlad), whose cameras
    and frames then hold."""
    scale: Annotated[float | None, arg(metavar="X", help_behavior_hint=_OF_SUBJECT)] = None
    """Size of the training images, of the stored size."""
    test_scale: Annotated[
        float | None, arg(metavar="X", help_behavior_hint="(default: --scale, the subject's, or 1)")
    ] = None
    """Size of the images that are compared, of the stored size."""
    legacy_pixels: bool = False
    """Scale images as the authors of the data sets do (K without the half pixel, nearest masks)."""

    def reading(self) -> "Reading":
        """What the reader of captures takes."""
        from .captures import Reading

        return Reading(
            self.params,
            None if self.body is None else str(self.body),
            self.subject,
            self.scale,
            self.test_scale,
            self.legacy_pixels or None,
        )


Flags = Annotated[ReadingFlags, arg(name="")]
"""Takes the flags up without a prefix."""
AS_IT_IS = ReadingFlags()
"""Nothing asked for."""
