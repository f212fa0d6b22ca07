"""Reads and writes pictures: colour as PNG or JPEG, depth, instance and semantic as PNG.

The compression is fixed, so that the same picture always gives the same bytes.
"""

import os
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from PIL import Image as Pillow

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import check_input, whole_file

COMPRESSION = {"compress_level": 1, "compress_type": zlib.Z_RLE}
"""Runs of one value are what repeats in these pictures; noise does not repeat. Searching for longer
repetitions takes half as long again, and saves nothing."""

QUALITY = {"quality": 95, "subsampling": 0}
"""Of JPEG files: colours at full resolution, and errors of about two steps of 255."""

SUFFIXES = {"png": ".png", "jpeg": ".jpg"}
"""By the names of :data:`~inspe_jax.dataset.formats.options.PICTURES`."""

DEPTH_UNIT = 0.01
"""The resolution of a depth picture [m]."""

DEPTH_CAP = 2**16 - 1
"""The largest value of a depth picture; it stands for this distance and all beyond."""


def write_rgb(path: Path, rgb: Any) -> None:
    """Write uint8 (H, W, 3) as the suffix says: .png or .jpg."""
    if path.suffix == SUFFIXES["jpeg"]:
        _write(path, np.asarray(rgb, np.uint8), "JPEG", QUALITY)
    else:
        _write(path, np.asarray(rgb, np.uint8))


def write_depth(path: Path, depth: Any) -> None:
    """Write depths (H, W) [m] in 16 bits, in centimetres; beyond 655.35 m they are capped."""
    steps = np.minimum(np.asarray(depth, float) / DEPTH_UNIT, DEPTH_CAP)
    _write(path, np.rint(steps).astype(np.uint16))


def write_instance(path: Path, instance: Any) -> None:
    """Write track + 1 (H, W), or 0, in 16 bits."""
    _write(path, np.asarray(instance).astype(np.uint16))


def write_semantic(path: Path, semantic: Any) -> None:
    """Write labels (H, W), or another map of small numbers, in 8 bits."""
    _write(path, np.asarray(semantic).astype(np.uint8))


def read_rgb(path: Path) -> UInt8[np.ndarray, "H W 3"]:
    """The colours of a picture; grey pictures and those with transparency are converted."""
    return _read(path, "RGB")


def read_depth(path: Path) -> Float[np.ndarray, "H W"]:
    """Depths [m], float32; infinite where the file has its largest value."""
    steps = _read(path, None)
    return np.where(steps >= DEPTH_CAP, np.inf, steps * DEPTH_UNIT).astype(np.float32)


def read_instance(path: Path) -> Int[np.ndarray, "H W"]:
    """Track + 1 of each pixel, or 0; int32."""
    return _read(path, None).astype(np.int32)


def read_semantic(path: Path) -> UInt8[np.ndarray, "H W"]:
    """The label of each pixel."""
    return _read(path, "L")


def _write(
    path: str | os.PathLike[str],
    pixels: np.ndarray,
    kind: str = "PNG",
    settings: Mapping[str, Any] = COMPRESSION,
) -> None:
    with whole_file(path) as f:
        Pillow.fromarray(np.ascontiguousarray(pixels)).save(f, kind, **settings)


def _read(path: Path, mode: str | None) -> np.ndarray:
    """Pixels in Pillow's ``mode``, or those of a 16-bit picture. Raises InspeError for other
    files."""
    check_input(path)
    try:
        with Pillow.open(path, formats=["PNG", "JPEG"]) as picture:
            given = picture.mode
            pixels = np.array(picture.convert(mode) if mode == "RGB" else picture)
    except (OSError, SyntaxError, ValueError, EOFError) as e:
        raise InspeError(f"{path}: not a readable picture: {e}") from e
    # Some versions of Pillow convert 16 bits to 32.
    allowed = {"RGB": (given,), "L": ("L", "P")}.get(str(mode), ("I;16", "I;16B", "I"))
    if given not in allowed:
        bits = 8 if mode else 16
        raise InspeError(f"{path}: its pixels are {given}: must be {bits}-bit greyscale")
    return pixels
