"""The registry of data-set formats: to add one, add a row to :data:`FORMATS`."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from inspe_jax.core.errors import check_known
from inspe_jax.dataset.formats.opv2v import reader as opv2v_reader
from inspe_jax.dataset.formats.opv2v import writer as opv2v_writer
from inspe_jax.dataset.formats.other_readers import DEFAULT_OPTIONS, FileOptions
from inspe_jax.dataset.formats.protocol_file import PROTOCOL
from inspe_jax.simulation.frame import Frame


@dataclass(frozen=True)
class DatasetFormat:
    """How the frames of a scenario are stored in its folder.

    ``agents`` gives the agents' ids: infrastructure −1, −2, … first, then vehicles. ``frames``
    gives the numbers of complete frames. ``read`` raises InspeError where there is none or a file
    is broken. ``write`` replaces an earlier frame and gives its files; a frame that is half written
    must not count. ``example`` is the path of a file of frame 0, for error messages.
    """

    agents: Callable[[Path], tuple[int, ...]]
    frames: Callable[[Path, tuple[int, ...]], tuple[int, ...]]
    read: Callable[[Path, int, tuple[int, ...], Mapping[str, Any]], Frame]
    write: Callable[[Path, Frame, FileOptions], Sequence[Path]]
    example: str


DEFAULT_FORMAT = "opv2v"
FORMATS: dict[str, DatasetFormat] = {
    "opv2v": DatasetFormat(
        agents=opv2v_reader.agent_ids,
        frames=opv2v_reader.frame_numbers,
        read=opv2v_reader.frame_of,
        write=opv2v_writer.write_frame,
        example="AGENT/000000.yaml",
    ),
}
"""The formats by name. The first that fits a folder reads it."""


def format_of(folder: Path) -> DatasetFormat | None:
    """The first format of which an agent has a frame; None where the folder is no scenario."""
    for row in FORMATS.values():
        if any(row.frames(folder, (agent,)) for agent in row.agents(folder)):
            return row
    return FORMATS[DEFAULT_FORMAT] if (folder / PROTOCOL).is_file() else None


def write_frame(
    scenario: str | os.PathLike[str],
    frame: Frame,
    format: str = DEFAULT_FORMAT,
    options: FileOptions = DEFAULT_OPTIONS,
) -> tuple[Path, ...]:
    """Write a frame into the folder of a scenario, over one of this number; gives its files. Every
    frame of a scenario should have the same stations. ``format`` is one of :data:`FORMATS`. Raises
    InspeError, before anything is written, where it, an option or the frame is not valid.

    >>> empty = dataset.Frame(0, 0.0, (), (dataset.Station(1, "pole", np.zeros(6), (), ()),))
    >>> files = dataset.write_frame("mine/train/four_way", empty)
    >>> [file.name for file in files]
    ['000000.pcd', '000000.yaml']
    """
    check_known(format, FORMATS, "format:")
    options.check("options")
    return tuple(FORMATS[format].write(Path(scenario), frame, options))
