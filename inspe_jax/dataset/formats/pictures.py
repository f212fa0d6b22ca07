"""Reads and writes pictures: colour as PNG or JPEG, layers as PNG, always to the same bytes."""

import zlib
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as Pillow

from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.files import check_input, whole_file

COMPRESSION = {"compress_level": 1, "compress_type": zlib.Z_RLE}
"""Runs of one value are what repeats here; searching for longer repetitions saves nothing."""
QUALITY = {"quality": 95, "subsampling": 0}
"""Of JPEG files: colours at full resolution, and errors of about two steps of 255."""
SUFFIXES = {"png": ".png", "jpeg": ".jpg"}
DEPTH_UNIT = 0.01  # the resolution of a depth picture [m]
DEPTH_CAP = 2**16 - 1
"""The largest value of a depth picture; it stands for this distance and all beyond."""


def write_picture(path: Path, layer: str, pixels: Any) -> None:
    """Write ``rgb`` (H, W, 3), as the suffix says, or a layer (H, W): depths [m] in 16 bits, in
    centimetres, capped beyond 655.35 m; instances, track + 1 or 0, in 16 bits; labels in 8."""
    pixels = np.asarray(pixels)
    if layer == "depth":
        pixels = np.rint(np.minimum(pixels.astype(float) / DEPTH_UNIT, DEPTH_CAP))
    kind = np.uint16 if layer in ("depth", "instance") else np.uint8
    jpeg = path.suffix == SUFFIXES["jpeg"]
    with whole_file(path) as f:
        picture = Pillow.fromarray(np.ascontiguousarray(pixels.astype(kind)))
        picture.save(f, "JPEG" if jpeg else "PNG", **(QUALITY if jpeg else COMPRESSION))


def read_picture(path: Path, layer: str) -> np.ndarray:
    """The pixels of ``rgb`` (H, W, 3), uint8, or of a layer (H, W): depths in metres, float32,
    infinite at the cap; instances int32. Raises InspeError for a file that is no picture, or of
    other bits."""
    check_input(path)
    wrong = f"{path}: not a readable picture"
    with (
        error_at(wrong, OSError, SyntaxError, ValueError, EOFError),
        Pillow.open(path, formats=["PNG", "JPEG"]) as picture,
    ):
        mode = picture.mode
        pixels = np.array(picture.convert("RGB") if layer == "rgb" else picture)
    bits = 8 if layer == "semantic" else 16
    # Some versions of Pillow convert 16 bits to 32.
    if layer != "rgb" and mode not in (("L", "P") if bits == 8 else ("I;16", "I;16B", "I")):
        raise InspeError(f"{path}: its pixels are {mode}: must be {bits}-bit greyscale")
    if layer == "depth":
        return np.where(pixels >= DEPTH_CAP, np.inf, pixels * DEPTH_UNIT).astype(np.float32)
    return pixels.astype(np.int32) if layer == "instance" else pixels
