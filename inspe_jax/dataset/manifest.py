"""The manifest of a scenario: size and digest of every file, so that damage is found.

While a scenario is generated, each frame that is written gets a record of its files, in the folder
:data:`RECORDS`. When the scenario is complete, these become its ``manifest.json``::

    {"format": "inspe_jax manifest 1",
     "files": {"data_protocol.yaml": [2041, "9f86d0…"]},
     "frames": {"0": {"-1/000000.pcd": [812345, "60303a…"], …}, …}}

Paths are relative to the scenario's folder; digests are SHA-256. A file is compared by its size, or
read and compared by its digest as well, which takes as long as reading the disk does.
"""

import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import digest_of, read_json, write_text
from inspe_jax.dataset.formats.protocol_file import PROTOCOL

MANIFEST, RECORDS = "manifest.json", ".frames"
FORMAT = "inspe_jax manifest 1"
Files = Mapping[str, tuple[int, str]]
"""Size [bytes] and SHA-256 of files, by their path relative to the scenario's folder."""


@dataclass(frozen=True)
class Manifest:
    """The files of a scenario, and the numbers of the frames that have some of them."""

    files: Files
    frames: frozenset[int]

    @property
    def size(self) -> int:
        """Size of all files [bytes]."""
        return sum(size for size, _ in self.files.values())


@dataclass(frozen=True)
class Fault:
    """A file that is not as the manifest says, and what is wrong with it."""

    path: Path
    what: str

    def __str__(self) -> str:
        return f"{self.path}: {self.what}"


# ── Writing ─────────────────────────────────────────────────────────────────


def record_frame(folder: Path, number: int, files: Iterable[Path]) -> None:
    """Record the files of a frame that has been written. Its record is its last file."""
    record = folder / RECORDS / f"{number:06d}.json"
    record.parent.mkdir(exist_ok=True)
    write_text(record, _text(_measured(folder, files)))


def recorded_frames(folder: Path, deep: bool = False) -> dict[int, Files]:
    """The records of the frames of an unfinished scenario, of which all files have their size.

    ``deep`` compares digests, too. Other records are deleted, so that their frames are missing.
    """
    found = dict[int, Files]()
    for path in sorted((folder / RECORDS).glob("[0-9]*.json")):
        try:
            files = _files(read_json(path), path)
        except InspeError:
            files = {}
        faulty = (
            _fault_of(folder / file, size, digest if deep else None)
            for file, (size, digest) in files.items()
        )
        if files and not any(faulty):
            found[int(path.stem)] = files
        else:
            path.unlink(missing_ok=True)
    return found


def write_manifest(folder: Path, files: Iterable[Path]) -> None:
    """Put the frames' records together, with ``files`` that belong to no frame."""
    content = {
        "format": FORMAT,
        "files": _measured(folder, files),
        "frames": {str(number): own for number, own in recorded_frames(folder).items()},
    }
    write_text(folder / MANIFEST, _text(content))


def _measured(folder: Path, files: Iterable[Path]) -> dict[str, tuple[int, str]]:
    return {
        path.relative_to(folder).as_posix(): (path.stat().st_size, digest_of(path))
        for path in sorted(files)
    }


def _text(content: Mapping[str, Any]) -> str:
    return json.dumps(content, indent=1) + "\n"


# ── Reading and comparing ───────────────────────────────────────────────────


def manifest_of(folder: Path) -> tuple[Manifest | None, list[Fault]]:
    """The manifest of a scenario, None where there is none; or the fault of a broken one."""
    path = folder / MANIFEST
    if not path.is_file():
        return None, []
    try:
        content = read_json(path)
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise InspeError(f"{path}: not a manifest of this version of the package")
        frames = content.get("frames")
        if not isinstance(frames, dict) or not all(re.fullmatch("[0-9]+", key) for key in frames):
            raise InspeError(f"{path}: frames: must hold files by the number of their frame")
        each = {int(number): _files(files, path) for number, files in frames.items()}
        files = _files(content.get("files"), path)
    except InspeError as e:
        return None, [Fault(path, str(e).removeprefix(f"{path}: "))]
    for own in each.values():
        files |= own
    return Manifest(files, frozenset(number for number, own in each.items() if own)), []


def compare(
    folder: Path, count: int | None = None, deep: bool = False, others: bool = False
) -> tuple[Manifest | None, list[Fault]]:
    """The manifest of a scenario, None where there is none, and what is not as it says.

    With ``count``, a manifest has a fault that lacks the protocol, or files of a frame 0 … count −
    1. ``deep`` also reads files and compares them; with ``others``, files that the manifest does
    not know are faults too, but for hidden ones.
    """
    manifest, found = manifest_of(folder)
    if manifest is None:
        return None, found
    listed = manifest.frames == set(range(count or 0)) and PROTOCOL in manifest.files
    if count is not None and not listed:
        found.append(Fault(folder / MANIFEST, f"does not list all files of {count} frames"))
    rows = [
        (folder / path, size, digest if deep else None)
        for path, (size, digest) in manifest.files.items()
    ]
    # A digest is computed without Python's lock, so that threads use every core.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        each = pool.map(lambda row: _fault_of(*row), rows)
    found += [Fault(row[0], what) for row, what in zip(rows, each, strict=True) if what]
    known = {row[0] for row in rows} | {folder / MANIFEST}
    strange = sorted(set(_visible_files(folder)) - known) if others else ()
    return manifest, found + [Fault(path, "not in the manifest") for path in strange]


def _fault_of(path: Path, size: int, digest: str | None) -> str:
    """What is wrong with a file; empty if nothing is."""
    try:
        now = path.stat().st_size
        if now != size:
            return f"is {now} bytes long, and was {size}"
        if digest is not None and digest_of(path) != digest:
            return "its content has changed"
    except FileNotFoundError:
        return "is missing"
    except OSError as e:
        return f"cannot be read: {e.strerror}"
    return ""


def _visible_files(folder: Path) -> Iterator[Path]:
    for top, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (Path(top) / name for name in names if not name.startswith("."))


def _files(content: Any, where: Path) -> dict[str, tuple[int, str]]:
    """Files of a manifest. Raises InspeError where they are none, or lie outside the folder."""
    entries: Iterable[tuple[Any, Any]] = content.items() if isinstance(content, dict) else [("", 0)]
    found = dict[str, tuple[int, str]]()
    for path, entry in entries:
        match entry:
            case [int(size), str(digest)] if (
                "\0" not in path and not Path(path).is_absolute() and ".." not in Path(path).parts
            ):
                found[path] = size, digest
            case _:
                raise InspeError(f"{where}: {path}: must be the size and the digest of a file")
    return found
