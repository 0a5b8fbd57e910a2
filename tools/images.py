"""Pictures in and out, through Pillow, in memory."""

import io

import numpy as np
from jaxtyping import Float

from monopart.geometry.errors import InputError


def decoded(data: bytes, source: str) -> Float[np.ndarray, "H W 3"]:
    """Decode a PNG or JPEG.

    Args:
        data: the file's bytes.
        source: what to call it in errors.

    Returns:
        sRGB in [0, 1], (H, W, 3); transparency is left out.

    Raises:
        InputError: not a whole picture.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(data)) as image:
            pixels = np.asarray(image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        # Pillow's own words name an object in memory where it knows no such kind
        text = "of no kind that is known" if isinstance(error, UnidentifiedImageError) else error
        raise InputError(
            f"{source}: expected a PNG or JPEG picture, found {len(data)} other bytes ({text}); "
            "export it again"
        ) from error
    return pixels.astype(np.float64) / 255


def encoded(image: Float[np.ndarray, "H W 3"]) -> bytes:
    """Encode a picture as PNG with 8 bits per channel.

    Args:
        image: sRGB in [0, 1], (H, W, 3); values outside are clipped, NaN becomes black.

    Returns:
        The file's bytes.

    >>> decoded(encoded(np.ones((2, 3, 3))), "white").shape
    (2, 3, 3)
    """
    from PIL import Image

    pixels = np.rint(np.clip(np.nan_to_num(image), 0, 1) * 255).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()
