"""What a capture holds: cameras, body poses, splits, and images and masks read on demand."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from monopart.geometry.body import BodyModel, BodyPose
from monopart.geometry.cameras import Camera
from monopart.geometry.errors import InputError

from .frames import Frame, Split, check_sizes
from .images import read_image, read_mask, read_vertices
from .scaling import camera_at, scale_image, scale_mask, scaled_size

Progress = Callable[[int, int], None]
"""Called with (done, total) as files are read."""

KEPT_BYTES = 1 << 29
"""Undistorted and scaled pixels that a record holds in memory at most."""


@dataclass(frozen=True, eq=False)
class CaptureRecord:
    """A capture in house conventions: metres, pixel centres at +½, RGB, undistorted images.

    Images are read when asked for. Those of a distorted camera are undistorted, and then scaled
    where the record has another size than the files; what took such work stays in memory, up to
    `KEPT_BYTES`. Others are passed on as they are.
    """

    root: Path
    """Folder of the capture."""
    name: str
    """Name of the folder."""
    cameras: list[Camera]
    """Cameras of the undistorted images of `image_size`: float32, distortion zero."""
    camera_names: list[str]
    """Name of each camera, from the folder of its images."""
    poses: dict[int, BodyPose]
    """Body pose of each frame: float32, no batch axes; metres, radians."""
    body: BodyModel
    """The body that the poses belong to."""
    splits: dict[str, Split]
    """`train` and, where there are any, `novel_view` and `novel_pose`."""
    fps: float | None
    """Frames per second; None where the capture does not say."""
    image_size: tuple[int, int]
    """(height, width) of every image as it is given out, pixels."""
    frames: dict[tuple[int, int], Frame]
    """Files of each (camera, frame)."""
    raw_cameras: list[Camera]
    """Cameras of the stored images: float32, with their distortion."""
    params: str
    """Folder of the body track that was read."""
    vertex_paths: dict[int, Path] = field(default_factory=dict)
    """Stored body vertices of each frame, world metres; empty where the capture has none."""
    scale: float = 1.0
    """Size of the images of this record, of the stored size."""
    test_scale: float = 1.0
    """Size at which images are compared, of the stored size; see `for_test`."""
    legacy_pixels: bool = False
    """Images are scaled as the authors of the data sets do (`camera_at`)."""
    resize_masks: bool = False
    """Masks of another size are brought to that of their image; they are refused otherwise."""
    subject: str | None = None
    """Name of the subject of a public data set whose splits these are."""
    body_path: Path | None = None
    """Body file that was asked for; None for the capture's own or the package's."""
    _cache: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = field(
        default_factory=dict, repr=False
    )
    _maps: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict, repr=False)

    def to(self, device: torch.device) -> "CaptureRecord":
        """The same capture with body, poses and cameras on a device; images stay on the CPU.

        Args:
            device: where bodies are posed and rays made.

        Returns:
            The capture; it shares the images that are in memory.
        """
        like = torch.zeros((), device=device)
        return replace(
            self,
            body=self.body.to(like),
            poses={frame: pose.to(like) for frame, pose in self.poses.items()},
            cameras=[camera.to(like) for camera in self.cameras],
        )

    @property
    def stored_size(self) -> tuple[int, int]:
        """(height, width) of the image files, pixels."""
        return self.raw_cameras[0].size

    def scaled(self, scale: float) -> "CaptureRecord":
        """The same capture with images and cameras of another size.

        Args:
            scale: of the stored size, above 0 and at most 1.

        Returns:
            The capture; itself where nothing changes.

        Raises:
            InputError: a factor that is not above 0 and at most 1.
        """
        if scale == self.scale:
            return self
        cameras = [camera_at(c, scale, self.legacy_pixels) for c in self.raw_cameras]
        like = self.cameras[0].K
        return replace(
            self,
            cameras=[camera.to(like) for camera in cameras],
            image_size=scaled_size(self.stored_size, scale, self.legacy_pixels),
            scale=scale,
            _cache={},
        )

    def for_test(self) -> "CaptureRecord":
        """The same capture at the size at which its images are compared."""
        return self.scaled(self.test_scale)

    def split(self, name: str) -> Split:
        """A split by name.

        Args:
            name: `train`, `novel_view`, `novel_pose` or another name in the capture.

        Returns:
            The split.

        Raises:
            InputError: no split of that name.
        """
        if name not in self.splits:
            raise InputError(
                f"{self.root}: expected a split {name!r}, found {', '.join(self.splits)}; "
                f"add it to splits.json or name another"
            )
        return self.splits[name]

    def camera_index(self, name: str) -> int:
        """Position of a camera given its name or, where no camera is called so, its number.

        Args:
            name: as in `camera_names`, or a whole number in digits.

        Returns:
            Position in `cameras`.

        Raises:
            InputError: neither a name nor a number of a camera.
        """
        if name in self.camera_names:
            return self.camera_names.index(name)
        if name.isdecimal() and int(name) < len(self.cameras):
            return int(name)
        raise InputError(
            f"camera: expected one of {', '.join(self.camera_names)} or a number below "
            f"{len(self.cameras)}, found {name!r}; name one of them"
        )

    def frame(self, camera: int, frame: int) -> Frame:
        """Files of one picture.

        Args:
            camera: position of the camera.
            frame: frame number.

        Returns:
            The entry.

        Raises:
            InputError: the capture lists no such picture.
        """
        entry = self.frames.get((camera, frame))
        if entry is None:
            numbers = sorted(self.poses)
            raise InputError(
                f"{self.root}: expected camera 0 to {len(self.cameras) - 1} and a frame in "
                f"{numbers[0]} to {numbers[-1]}, found camera {camera}, frame {frame}; ask for one "
                f"that annots.npy lists"
            )
        return entry

    def image(self, camera: int, frame: int) -> Float[Tensor, "h w 3"]:
        """One image.

        Args:
            camera: position of the camera.
            frame: frame number.

        Returns:
            sRGB in [0, 1], float32, undistorted, height width 3.

        Raises:
            InputError: no such picture, a file missing, unreadable or of another size.
        """
        return torch.from_numpy(self._pixels(camera, frame)[0]).to(torch.float32) / 255

    def mask(self, camera: int, frame: int) -> Bool[Tensor, "h w"]:
        """One mask.

        Args:
            camera: position of the camera.
            frame: frame number.

        Returns:
            True on the person, undistorted, height width.

        Raises:
            InputError: as `image`.
        """
        return torch.from_numpy(self._pixels(camera, frame)[1])

    def masked_image(
        self, camera: int, frame: int, background: float = 0.0
    ) -> Float[Tensor, "h w 3"]:
        """One image, with a constant where the mask is off.

        Args:
            camera: position of the camera.
            frame: frame number.
            background: value of all three channels outside the mask, in [0, 1].

        Returns:
            sRGB in [0, 1], float32, height width 3.

        Raises:
            InputError: as `image`.
        """
        rgb, on = self._pixels(camera, frame)
        image = torch.from_numpy(rgb).to(torch.float32) / 255
        return torch.where(torch.from_numpy(on)[..., None], image, background)

    def vertices(self, frame: int) -> Float[Tensor, "v 3"]:
        """Stored body vertices of a frame, as the capture's maker computed them.

        Args:
            frame: frame number.

        Returns:
            World metres, float32, V 3.

        Raises:
            InputError: no vertices stored for the frame, or not an array of (vertices, 3).
        """
        if frame not in self.vertex_paths:
            raise InputError(
                f"{self.root}: expected stored vertices for frame {frame}, found none; "
                f"pose the body instead"
            )
        return torch.from_numpy(read_vertices(self.vertex_paths[frame]).astype(np.float32))

    def stack(
        self, split: str, progress: Progress | None = None
    ) -> tuple[UInt8[Tensor, "n h w 3"], Bool[Tensor, "n h w"]]:
        """All images and masks of a split, four bytes a pixel, read by two threads.

        Args:
            split: name of the split.
            progress: called with (done, total) after each image.

        Returns:
            Images (sRGB, 0..255), n height width 3, and masks, n height width, in the order of
            `Split.pairs`.

        Raises:
            InputError: as `image` and `split`; a mask of the training split without a person.
        """
        pairs = self.split(split).pairs()
        images = torch.zeros(len(pairs), *self.image_size, 3, dtype=torch.uint8)
        masks = torch.zeros(len(pairs), *self.image_size, dtype=torch.bool)
        rgb_out, on_out = images.numpy(), masks.numpy()

        def fill(i: int) -> None:
            rgb_out[i], on_out[i] = self._pixels(*pairs[i])
            if split == "train":
                check_not_empty(self, pairs[i], masks[i])

        run_all(fill, len(pairs), progress)
        return images, masks

    def preload(self, split: str, progress: Progress | None = None) -> None:
        """Reads all images and masks of a split into memory, where `image` and `mask` find them.

        Args:
            split: name of the split.
            progress: called with (done, total) after each image.

        Raises:
            InputError: as `image` and `split`.
        """
        pairs = self.split(split).pairs()

        def keep(i: int) -> None:
            self._cache[pairs[i]] = self._pixels(*pairs[i])

        run_all(keep, len(pairs), progress)

    def _pixels(self, camera: int, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """RGB uint8 (h, w, 3) and mask bool (h, w), undistorted and scaled."""
        kept = self._cache.get((camera, frame))
        if kept is not None:
            return kept
        entry = self.frame(camera, frame)
        rgb, on = read_image(entry.image_path), read_mask(entry.mask_path)
        if self.resize_masks and on.shape != rgb.shape[:2]:
            on = scale_mask(on, rgb.shape[:2], nearest=True)
        check_sizes(entry, rgb, on, self.stored_size)
        distorted = self.raw_cameras[camera].is_distorted
        if distorted:
            rgb, on = self._undistort(camera, rgb, on)
        if self.image_size != self.stored_size:
            rgb = scale_image(rgb, self.image_size)
            on = scale_mask(on, self.image_size, nearest=self.legacy_pixels)
        elif not distorted:
            return rgb, on
        self._keep((camera, frame), (rgb, on))
        return rgb, on

    def _keep(self, pair: tuple[int, int], pixels: tuple[np.ndarray, np.ndarray]) -> None:
        """Hold pixels in memory, and let go of those that came first."""
        size = pixels[0].nbytes + pixels[1].nbytes
        while self._cache and (len(self._cache) + 1) * size > KEPT_BYTES:
            try:
                self._cache.pop(next(iter(self._cache)), None)
            except (StopIteration, RuntimeError):  # another thread was faster
                break
        self._cache[pair] = pixels

    def _undistort(
        self, camera: int, rgb: np.ndarray, on: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Image and mask as a pinhole camera with the same K would have taken them."""
        if camera not in self._maps:
            # cv2 puts pixel centres at whole numbers
            where = self.raw_cameras[camera].undistorted()[1].numpy() - 0.5
            self._maps[camera] = where[..., 0].copy(), where[..., 1].copy()
        x, y = self._maps[camera]
        soft = cv2.remap(on.astype(np.uint8) * 255, x, y, cv2.INTER_LINEAR)
        return cv2.remap(rgb, x, y, cv2.INTER_LINEAR), np.asarray(soft > 127)


def check_not_empty(record: CaptureRecord, pair: tuple[int, int], on: Bool[Tensor, "h w"]) -> None:
    """Refuses a mask without a person on it: nothing could be learnt from that image.

    Args:
        record: the capture.
        pair: camera and frame.
        on: the mask.

    Raises:
        InputError: no pixel is on.
    """
    if not bool(on.any()):
        raise InputError(
            f"{record.frame(*pair).mask_path}: expected a person on the mask, found no pixel above "
            f"the threshold; redo the mask or take frame {pair[1]} out of the split in splits.json"
        )


def run_all(work: Callable[[int], None], count: int, progress: Progress | None = None) -> None:
    """Run work(0), work(1), … on two threads; the first error ends it.

    Args:
        work: called once with each index; decoding images releases the interpreter.
        count: number of calls.
        progress: called with (done, total) in this thread.
    """
    with ThreadPoolExecutor(2, thread_name_prefix="capture") as pool:
        futures = [pool.submit(work, i) for i in range(count)]
        try:
            for done, future in enumerate(futures, start=1):
                future.result()
                if progress is not None:
                    progress(done, count)
        finally:
            pool.shutdown(cancel_futures=True)
