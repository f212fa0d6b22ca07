"""The registry of data-set formats.

To add a format, write a module with the four functions of a :class:`DatasetFormat`, and add a row
to :data:`FORMATS`. ``inspe generate``, :func:`inspe_jax.dataset.open`, the statistics and the
figures then work with it.
"""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.dataset.formats.options import DEFAULT_OPTIONS, FileOptions
from inspe_jax.dataset.formats.opv2v import reader as opv2v_reader
from inspe_jax.dataset.formats.opv2v import writer as opv2v_writer
from inspe_jax.dataset.formats.protocol_file import (
    PROTOCOL,
    read_protocol_file,
    write_protocol_file,
)
from inspe_jax.simulation.frame import Frame, Station


@dataclass(frozen=True)
class DatasetFormat:
    """How a scenario is stored in its folder.

    ``agents(folder)`` gives the ids of the agents: infrastructure −1, −2, … first, then vehicles.
    ``frames(folder, agents)`` gives the numbers of the frames that are complete.
    ``read(folder, number, agents, protocol)`` gives a frame, and raises InspeError where there is
    none or a file is broken.
    ``write(folder, frame, options)`` writes a frame over an earlier one, and gives its files. The
    folder may be missing. A frame that is only half written must not count as complete.
    ``example`` is the path of a file of frame 0, for error messages.
    ``protocol_file`` is the name of the YAML file that says what made the scenario.
    """

    agents: Callable[[Path], tuple[int, ...]]
    frames: Callable[[Path, tuple[int, ...]], tuple[int, ...]]
    read: Callable[[Path, int, tuple[int, ...], Mapping[str, Any]], Frame]
    write: Callable[[Path, Frame, FileOptions], Sequence[Path]]
    example: str
    protocol_file: str = PROTOCOL

    def is_begun(self, folder: Path) -> bool:
        """Whether the protocol of a scenario is there: it is written before the first frame."""
        return (folder / self.protocol_file).is_file()

    def has_frames(self, folder: Path) -> bool:
        """Whether an agent of a folder has a frame, even if other agents do not."""
        return any(self.frames(folder, (agent,)) for agent in self.agents(folder))

    def read_protocol(self, folder: Path) -> dict[str, Any]:
        """What made a scenario; empty if nothing says so. Raises InspeError if it is not YAML."""
        return read_protocol_file(folder / self.protocol_file)

    def write_protocol(
        self, folder: Path, protocol: Mapping[str, Any], stations: Iterable[Station] = ()
    ) -> None:
        """Write the protocol, as :func:`~.protocol_file.write_protocol_file` does."""
        write_protocol_file(folder / self.protocol_file, protocol, stations)


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


def check_format(name: str, where: str) -> None:
    """Raise InspeError for a format that is not in :data:`FORMATS`."""
    check_known(name, FORMATS, f"{where}:")


def format_of(folder: Path) -> DatasetFormat | None:
    """The format of a scenario's folder; None where the folder is no scenario.

    The name of the protocol file decides. If it fits several formats, or none, the first format
    of which a frame is there is taken.
    """
    begun = [row for row in FORMATS.values() if row.is_begun(folder)]
    if len(begun) == 1:
        return begun[0]
    found = (row for row in begun or FORMATS.values() if row.has_frames(folder))
    return next(found, begun[0] if begun else None)


def read_frame(scenario: str | os.PathLike[str], number: int) -> Frame:
    """A frame of a scenario, in whichever format it is stored.

    Raises InspeError where there is no such folder or frame, or a file is broken. For OPV2V see
    :func:`~inspe_jax.dataset.formats.opv2v.reader.frame_of`.
    """
    folder = Path(scenario)
    if not folder.is_dir():
        raise InspeError(f"{folder}: no such folder")
    row = format_of(folder) or FORMATS[DEFAULT_FORMAT]  # its reader says what is missing
    return row.read(folder, number, row.agents(folder), row.read_protocol(folder))


def write_frame(
    scenario: str | os.PathLike[str],
    frame: Frame,
    format: str = DEFAULT_FORMAT,
    options: FileOptions = DEFAULT_OPTIONS,
) -> tuple[Path, ...]:
    """Write a frame into the folder of a scenario, in a format of :data:`FORMATS`; gives its files.

    A frame of this number that is there is replaced. Every frame of a scenario should have the
    same stations. Raises InspeError, before anything is written, where the format is unknown, an
    option is out of range, or the frame is not valid. For OPV2V see
    :func:`~inspe_jax.dataset.formats.opv2v.writer.write_frame`.
    """
    check_format(format, "format")
    options.check("options")
    return tuple(FORMATS[format].write(Path(scenario), frame, options))


def write_protocol(
    scenario: str | os.PathLike[str],
    protocol: Mapping[str, Any],
    stations: Iterable[Station] = (),
    format: str = DEFAULT_FORMAT,
) -> None:
    """Write what made a scenario into its folder, as ``data_protocol.yaml`` for OPV2V.

    See :func:`~inspe_jax.dataset.formats.protocol_file.write_protocol_file` for what ``protocol``
    must hold. Raises InspeError where a key is missing or the format is unknown.
    """
    check_format(format, "format")
    FORMATS[format].write_protocol(Path(scenario), protocol, stations)
