"""The manifest of a scenario: size and digest of every file, so that damage is found.

Each frame that is written gets a record of its files in :data:`RECORDS`. In the end these become
``manifest.json``: ``{"format": …, "files": {"data_protocol.yaml": [2041, "9f8…"]}, "frames": {"0":
{…}, …}}``.
"""

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import digest_of, read_json, read_yaml, write_text
from inspe_jax.dataset.folders import Dataset, Scenario, open_dataset
from inspe_jax.dataset.formats.protocol_file import PROTOCOL

MANIFEST, RECORDS = "manifest.json", ".frames"
FORMAT = "inspe_jax manifest 1"
GENERATION = "generation.yaml"
"""The record of a generated data set: among other things, which scenarios it has."""
Files = dict[str, tuple[int, str]]
"""Size [bytes] and SHA-256 of files, by their path relative to the scenario's folder."""


@dataclass(frozen=True)
class Manifest:
    """The files of a scenario, and the numbers of the frames that have some of them."""

    files: Files
    frames: frozenset[int]


@dataclass(frozen=True)
class Fault:
    """A file that is not as the manifest says, and what is wrong with it."""

    path: Path
    what: str

    def __str__(self) -> str:
        return f"{self.path}: {self.what}"


def record_frame(folder: Path, number: int, files: Iterable[Path]) -> None:
    """Record the files of a frame that has been written. Its record is its last file."""
    record = folder / RECORDS / f"{number:06d}.json"
    record.parent.mkdir(exist_ok=True)
    _write(record, _measured(folder, files))


def recorded_frames(folder: Path, deep: bool = False) -> dict[int, Files]:
    """Records of frames whose files have their size (``deep``: digest). Others are deleted."""
    found = dict[int, Files]()
    for path in sorted((folder / RECORDS).glob("[0-9]*.json")):
        try:
            files = _files(read_json(path), path)
        except InspeError:
            files = {}
        if files and not any(_fault_of(folder / name, *files[name], deep) for name in files):
            found[int(path.stem)] = files
        else:
            path.unlink(missing_ok=True)
    return found


def write_manifest(folder: Path, files: Iterable[Path]) -> None:
    """Put the frames' records together, with ``files`` that belong to no frame."""
    frames = {str(number): own for number, own in recorded_frames(folder).items()}
    content = {"format": FORMAT, "files": _measured(folder, files), "frames": frames}
    _write(folder / MANIFEST, content)


def _measured(folder: Path, files: Iterable[Path]) -> Files:
    return {
        path.relative_to(folder).as_posix(): (path.stat().st_size, digest_of(path))
        for path in sorted(files)
    }


def _write(path: Path, content: Mapping[str, Any]) -> None:
    write_text(path, json.dumps(content, indent=1) + "\n")


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
    """The manifest of a scenario, None where there is none, and what is not as it says. It must
    list the protocol and files of ``count`` frames, if given. ``deep`` compares digests; with
    ``others``, visible files that the manifest does not know are faults, too."""
    manifest, found = manifest_of(folder)
    if manifest is None:
        return None, found
    listed = manifest.frames == set(range(count or 0)) and PROTOCOL in manifest.files
    if count is not None and not listed:
        found.append(Fault(folder / MANIFEST, f"does not list all files of {count} frames"))
    paths = {folder / name: facts for name, facts in manifest.files.items()}
    # A digest is computed without Python's lock, so that threads use every core.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        each = pool.map(lambda path: _fault_of(path, *paths[path], deep), paths)
    found += [Fault(path, what) for path, what in zip(paths, each, strict=True) if what]
    known = {*paths, folder / MANIFEST}
    for path in sorted(folder.rglob("*")) if others else ():
        hidden = any(part.startswith(".") for part in path.relative_to(folder).parts)
        if not path.is_dir() and not hidden and path not in known:
            found.append(Fault(path, "not in the manifest"))
    return manifest, found


def _fault_of(path: Path, size: int, digest: str, deep: bool) -> str:
    try:
        now = path.stat().st_size
        if now != size:
            return f"is {now} bytes long, and was {size}"
        if deep and digest_of(path) != digest:
            return "its content has changed"
    except FileNotFoundError:
        return "is missing"
    except OSError as e:
        return f"cannot be read: {e.strerror}"
    return ""


def _files(content: Any, where: Path) -> Files:
    """Files of a manifest. Raises InspeError where they are none, or lie outside the folder."""
    entries: Iterable[tuple[Any, Any]] = content.items() if isinstance(content, dict) else [("", 0)]
    found = Files()
    for path, entry in entries:
        match entry:
            case [int(size), str(digest)] if (
                "\0" not in path and not Path(path).is_absolute() and ".." not in Path(path).parts
            ):
                found[path] = size, digest
            case _:
                raise InspeError(f"{where}: {path}: must be the size and the digest of a file")
    return found


@dataclass(frozen=True)
class Check:
    """The result of a check: ``scenarios``, ``files`` and ``size`` [bytes] with a manifest, their
    ``faults``, and ``unknown`` scenarios without one."""

    scenarios: int
    files: int
    size: int
    faults: tuple[Fault, ...]
    unknown: tuple[Path, ...]

    @property
    def record(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "scenarios": self.scenarios,
            "files": self.files,
            "bytes": self.size,
            "faults": [{"file": str(fault.path), "what": fault.what} for fault in self.faults],
            "without_manifest": [str(path) for path in self.unknown],
        }


def check(
    given: Dataset | str | os.PathLike[str],
    deep: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Check:
    """Compare every file of a data set with its manifest: by size, and if ``deep`` by digest.
    Missing scenarios are faults, too. ``progress`` is called with (scenarios done, all)."""
    data = given if isinstance(given, Dataset) else open_dataset(given)
    faults, known, unknown = _missing_scenarios(data), list[Manifest](), list[Path]()
    for number, scenario in enumerate(data.scenarios, 1):
        manifest, own = compare(scenario.path, _frame_count(scenario), deep, others=True)
        faults += own
        if manifest is not None:
            known.append(manifest)
        elif not own:
            unknown.append(scenario.path)
        if progress:
            progress(number, len(data.scenarios))
    sizes = [size for manifest in known for size, _ in manifest.files.values()]
    return Check(len(known), len(sizes), sum(sizes), tuple(faults), tuple(unknown))


def _frame_count(scenario: Scenario) -> int | None:
    """How many frames the protocol says there are; a damaged one is a fault of its own."""
    try:
        told = scenario.protocol
        return round(told["settings"]["seconds"] * told["recording"]["rate_hz"])
    except (InspeError, KeyError, TypeError):
        return None


def _missing_scenarios(data: Dataset) -> list[Fault]:
    path = data.path / GENERATION
    record = read_yaml(path) if path.is_file() else None
    scenarios = record.get("scenarios") if isinstance(record, dict) else None
    there = {scenario.path for scenario in data.scenarios}
    return [
        Fault(place, "is missing: the same `inspe generate` records it again")
        for split, names in (scenarios.items() if isinstance(scenarios, dict) else ())
        for name in names or ()
        if (place := data.path / str(split) / str(name)) not in there
    ]
