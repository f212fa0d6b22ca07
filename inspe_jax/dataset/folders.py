"""Data sets on disk: splits, scenarios, and frames that read their files when they are used."""

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.dataset.formats.protocol_file import read_protocol
from inspe_jax.dataset.formats.registry import DEFAULT_FORMAT, FORMATS, DatasetFormat, format_of
from inspe_jax.simulation.frame import Frame

SPLITS = ("train", "validate", "test")
"""The usual splits, in their order; a data set may have others, such as ``test_culvercity``."""
MOST_LISTED = 20  # largest number of scenarios that an error lists


@dataclass(frozen=True)
class Scenario:
    """A scenario on disk. What has been read once is kept: later changes do not show."""

    path: Path
    format: DatasetFormat = FORMATS[DEFAULT_FORMAT]

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.name

    @cached_property
    def protocol(self) -> Mapping[str, Any]:
        """What made the scenario; empty if nothing says so."""
        return read_protocol(self.path)

    @cached_property
    def agents(self) -> tuple[int, ...]:
        """Ids of the agents: infrastructure −1, −2, … first, then vehicles."""
        return self.format.agents(self.path)

    @cached_property
    def frames(self) -> tuple[int, ...]:
        """Numbers of the complete frames, which every agent has."""
        return self.format.frames(self.path, self.agents)

    def frame(self, number: int) -> Frame:
        """A frame. Raises InspeError where there is none of this number, or a file is broken."""
        return self.format.read(self.path, number, self.agents, self.protocol)


@dataclass(frozen=True)
class Dataset:
    """The scenarios of a data set. ``splits`` has train, validate and test first, if they exist."""

    path: Path
    splits: Mapping[str, tuple[Scenario, ...]]

    @property
    def scenarios(self) -> tuple[Scenario, ...]:
        """All scenarios, split by split."""
        return tuple(scenario for split in self.splits.values() for scenario in split)

    def scenario(self, name: str | None = None) -> Scenario:
        """A scenario by its name or ``SPLIT/NAME``, or the only one; an error lists them."""
        named = {
            f"{split}/{scenario.name}": scenario
            for split, scenarios in self.splits.items()
            for scenario in scenarios
        }
        found = [key for key, scenario in named.items() if name in (None, key, scenario.name)]
        if len(found) == 1:
            return named[found[0]]
        names = found or [*named]
        listed = ", ".join(names[:MOST_LISTED])
        if len(names) > MOST_LISTED:
            listed += f" and {len(names) - MOST_LISTED} more"
        what = f"{len(named)} scenarios: name one of {listed}"
        if name is not None and found:
            what = f"scenario '{name}' is in {len(found)} splits: {listed}"
        elif name is not None:
            known = (*named, *(scenario.name for scenario in self.scenarios))
            what = f"no scenario '{name}': one of {listed}{nearest(name, known)}"
        raise InspeError(f"{self.path}: {what}")


def open_dataset(path: str | os.PathLike[str]) -> Dataset:
    """Open a data set on disk: a folder of splits, one split, or one scenario, in any format of
    :data:`~inspe_jax.dataset.formats.registry.FORMATS`. A split has the name of its folder. Raises
    InspeError if there is no such folder, or it is none of the three.

    >>> empty = dataset.Frame(0, 0.0, (), (dataset.Station(1, "pole", np.zeros(6), (), ()),))
    >>> _ = dataset.write_frame("mine/train/four_way", empty)
    >>> found = dataset.open("mine")
    >>> [(scenario.name, scenario.frames) for scenario in found.splits["train"]]
    [('four_way', (0,))]
    """
    given = Path(path)
    if not given.is_dir():
        raise InspeError(f"{given}: no such folder")
    folder = given.resolve()
    row = format_of(folder)
    if row is not None:
        return Dataset(folder, {folder.parent.name: (Scenario(folder, row),)})
    scenarios = _scenarios(folder)
    if scenarios:
        return Dataset(folder, {folder.name: scenarios})
    splits = split_folders(folder)
    found = {split.name: scenarios for split in splits if (scenarios := _scenarios(split))}
    if not found:
        expected = ", ".join(
            f"{above}{row.example}"
            for row in FORMATS.values()
            for above in ("SPLIT/SCENARIO/", "SCENARIO/", "")
        )
        raise InspeError(f"{given}: not a data set: expected one of {expected} in it")
    return Dataset(folder, found)


def split_folders(path: Path) -> list[Path]:
    """The folders of splits: the usual ones first, then by name."""
    return sorted(subfolders(path), key=lambda split: (*SPLITS, split.name).index(split.name))


def disk_size(folder: Path) -> int:
    """Size of all files in a folder and below it [bytes]."""
    size = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with suppress(FileNotFoundError):  # a worker's, which it renamed just now
                size += os.lstat(os.path.join(place, name)).st_size
    return size


def _scenarios(split: Path) -> tuple[Scenario, ...]:
    found = ((child, format_of(child)) for child in subfolders(split))
    return tuple(Scenario(child, row) for child, row in found if row is not None)


def subfolders(path: Path) -> list[Path]:
    """The folders in a folder, by name."""
    return sorted(child for child in path.iterdir() if child.is_dir())
