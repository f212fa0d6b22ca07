"""PCD files 0.7, ``x y z rgb``, as OPV2V has them. pypcd4 (1.5) rejects files without COUNT."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.files import ARRAYS, check_input, whole_file

_HEADER = """\
# .PCD v0.7 - Point Cloud Data file format
{note}VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F F
COUNT 1 1 1 1
WIDTH {points}
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS {points}
DATA binary
"""
_KEYS = (
    *("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT"),
    *("WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA"),
)
_SIZES = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}


def write_pcd(path: str | os.PathLike[str], points: Any, note: str = "") -> None:
    """Write points (N, 4): x, y, z [m] and intensity 0…1, in 1/255; ``note`` is a comment."""
    points = np.asarray(points)
    rows = np.empty((len(points), 4), "<f4")
    rows[:, :3] = points[:, :3]
    rows.view("<u4")[:, 3] = np.rint(points[:, 3] * 255).astype("<u4") << 16
    header = _HEADER.format(points=len(rows), note=f"# {note}\n" if note else "")
    with whole_file(path) as f:
        f.write(header.encode("ascii"))
        f.write(rows.tobytes())


def read_pcd(path: str | os.PathLike[str]) -> Float[np.ndarray, "N 4"]:
    """Points of a PCD file, ASCII or binary: x, y, z and ``intensity``, or the red byte of ``rgb``,
    or 0. Empty places are left out. Raises InspeError for any other file."""
    path = Path(path)
    check_input(path, ARRAYS)
    with path.open("rb") as f:
        header = _read_header(f, path)
        columns = _read_columns(f.read(), header, path)
    for name in ("x", "y", "z"):
        if name not in columns:
            raise InspeError(f"{path}: no field {name}; the fields are {', '.join(header.names)}")
    points = np.zeros((header.points, 4), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for i, name in enumerate(("x", "y", "z")):
            points[:, i] = columns[name]
        points[:, 3] = _intensity(columns, path)
    return points[np.isfinite(points).all(1)]


def read_notes(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """The comments in the header of a PCD file. Raises InspeError if it is not a PCD file."""
    path = Path(path)
    check_input(path)
    with path.open("rb") as f:
        return _read_header(f, path).notes


@dataclass(frozen=True)
class _Header:
    """``row`` is the layout of a point, its fields named by index, because ``names`` may repeat."""

    names: tuple[str, ...]
    row: np.dtype
    points: int
    data: str
    notes: tuple[str, ...]


def _read_header(f: IO[bytes], path: Path) -> _Header:
    entries: dict[str, list[str]] = {}
    notes = []
    while "DATA" not in entries:
        line = f.readline(10_000).decode("ascii", "replace")
        key, *values = line.split() or [""]
        if key.startswith("#"):
            notes.append(line.lstrip("#").strip())
        elif key in _KEYS:
            entries[key] = values
        elif not line:
            raise InspeError(f"{path}: not a PCD file: it ends before DATA")
        elif key:
            raise InspeError(f"{path}: not a PCD file: its header holds {key[:40]!r}")
    for key in ("FIELDS", "SIZE", "TYPE", "DATA"):
        if not entries.get(key):
            raise InspeError(f"{path}: not a PCD file: {key} is missing")
    if entries.get("VERSION", ["0.7"]) not in (["0.7"], [".7"]):
        raise InspeError(f"{path}: VERSION {' '.join(entries['VERSION'])}: must be 0.7")
    data = entries["DATA"][0]
    if data not in ("ascii", "binary"):
        raise InspeError(f"{path}: DATA {data} cannot be read: save it as binary or ascii")
    names = tuple(entries["FIELDS"])
    return _Header(names, _row(entries, path), _point_count(entries, path), data, tuple(notes))


def _row(entries: dict[str, list[str]], path: Path) -> np.dtype:
    names, types = entries["FIELDS"], entries["TYPE"]
    sizes = _integers(entries, "SIZE", path)
    counts = _integers(entries, "COUNT", path) or [1] * len(names)
    if not len(names) == len(types) == len(sizes) == len(counts):
        raise InspeError(f"{path}: FIELDS, SIZE, TYPE and COUNT do not have the same length")
    fields = []
    for i, (kind, size, count) in enumerate(zip(types, sizes, counts, strict=True)):
        if size not in _SIZES.get(kind, ()) or not 1 <= count <= 10_000:
            raise InspeError(
                f"{path}: field {names[i]}: TYPE {kind} SIZE {size} COUNT {count} is not allowed"
            )
        fields.append((str(i), f"<{kind.lower()}{size}", (count,)))
    return np.dtype(fields)


def _point_count(entries: dict[str, list[str]], path: Path) -> int:
    size = _integers(entries, "WIDTH", path) + _integers(entries, "HEIGHT", path)
    points = _integers(entries, "POINTS", path) or ([size[0] * size[1]] if len(size) == 2 else [])
    if len(points) != 1 or points[0] < 0:
        raise InspeError(f"{path}: not a PCD file: POINTS is missing or not a number")
    if len(size) == 2 and size[0] * size[1] != points[0]:
        raise InspeError(f"{path}: {points[0]} POINTS are not WIDTH {size[0]} x HEIGHT {size[1]}")
    return points[0]


def _integers(entries: dict[str, list[str]], key: str, path: Path) -> list[int]:
    try:
        return [int(value) for value in entries.get(key, [])]
    except ValueError:
        raise InspeError(f"{path}: {key} {' '.join(entries[key])}: must be whole numbers") from None


def _read_columns(body: bytes, header: _Header, path: Path) -> dict[str, np.ndarray]:
    """The first value of each field, by name. Raises InspeError if the file has too few."""
    points, row = header.points, header.row
    counts = [row[i].shape[0] for i in range(len(header.names))]
    if header.data == "binary":
        needed = points * row.itemsize
        if len(body) < needed:
            raise InspeError(
                f"{path}: cut short: {points} POINTS need {needed} bytes, there are {len(body)}"
            )
        rows = np.frombuffer(body[:needed], row)
        columns = [rows[str(i)][:, 0] for i in range(len(counts))]
    else:
        first = np.cumsum([0, *counts])
        with error_at(f"{path}: its points are not numbers", ValueError):
            values = np.array(body.split(), "S").astype(np.float64)
        if len(values) != points * first[-1]:
            raise InspeError(
                f"{path}: {points} POINTS need {first[-1]} numbers each, there are {len(values)}"
            )
        table = values.reshape(points, first[-1])
        with np.errstate(over="ignore", invalid="ignore"):
            columns = [table[:, first[i]].astype(row[i].base) for i in range(len(counts))]
    return dict(reversed([*zip(header.names, columns, strict=True)]))


def _intensity(columns: dict[str, np.ndarray], path: Path) -> Any:
    if "intensity" in columns:
        return columns["intensity"]
    name = next((name for name in ("rgb", "rgba") if name in columns), None)
    if name is None:
        return 0.0
    colour = columns[name]
    if colour.dtype.itemsize != 4:
        raise InspeError(f"{path}: field {name}: SIZE {colour.dtype.itemsize}: must be 4")
    return (np.ascontiguousarray(colour).view("<u4") >> 16 & 255).astype(np.float32) / 255
