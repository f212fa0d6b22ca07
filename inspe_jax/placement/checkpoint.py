"""Checkpoints: the state of a search on disk, from which it can go on.

A checkpoint is an ``.npz`` file of plain arrays and one JSON text. It is written whole or not at
all, and read without pickle. It has a digest of everything that the search depends on, so that it
is not used for another scene, layout or method.
"""

import json
import os
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import open_arrays, whole_file
from inspe_jax.placement.run import Progress, Run, State

FORMAT = "inspe_jax checkpoint 3"
SUFFIXES = (".npz",)
EVERY = 10.0
"""Time between two writes of a search's checkpoint [s]."""
_ARRAY, _VALUE = "array: ", "value: "  # before the names of a state's arrays, and of its values


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Checkpoint:
    """A search after a step.

    ``of`` has what the search depends on, by name, as digests or words; ``state`` is the method's.
    ``path`` (K, N) has the coordinates of every layout that was the best so far, ``held`` (0 or 1,
    N) those that the run holds. ``seconds`` and ``evaluations`` are spent, ``limits`` is the budget
    of both. ``status`` is "" while the search runs, then how it ended.
    """

    of: dict[str, str]
    state: State
    path: Float[np.ndarray, "K N"]
    held: Float[np.ndarray, "H N"]
    history: tuple[Progress, ...]
    seconds: float
    evaluations: float
    limits: tuple[float | None, float | None]
    status: str = ""


def save_checkpoint(kept: Checkpoint, path: str | os.PathLike[str]) -> None:
    """Write a checkpoint over the old one; if that fails, the old one stays."""
    record = {
        "format": FORMAT,
        "of": kept.of,
        "seconds": kept.seconds,
        "evaluations": kept.evaluations,
        "limits": kept.limits,
        "status": kept.status,
    }
    history = [[row.seconds, row.evaluations, row.score, row.best] for row in kept.history]
    arrays = {
        "record": np.array(json.dumps(record)),
        "path": kept.path,
        "held": kept.held,
        "history": np.array(history, float).reshape(-1, 4),
    }
    for name, value in kept.state.items():
        if isinstance(value, np.ndarray) and value.dtype.kind in "biufU":
            arrays[_ARRAY + name] = value
        elif isinstance(value, bool | int | float | str | np.generic):
            arrays[_VALUE + name] = np.array(value)
        else:
            # An error of the method, not of the user.
            raise TypeError(f"state '{name}': a {type(value).__name__} cannot be kept")
    with whole_file(path) as f:
        np.savez(f, **arrays)  # type: ignore[arg-type]  # names are ours


def load_checkpoint(path: str | os.PathLike[str]) -> Checkpoint:
    """Read a checkpoint. Raises InspeError if the file is missing or is not a checkpoint."""
    path = Path(path)
    other = "not a checkpoint of a search; name a new file, or one that --checkpoint wrote"
    with open_arrays(path, other) as arrays:
        return _unpack(arrays, path)


def _unpack(data: Mapping[str, np.ndarray], path: Path) -> Checkpoint:
    record = json.loads(str(data["record"]))
    if record["format"] != FORMAT:
        if str(record["format"]).startswith(FORMAT.rstrip("0123456789")):
            raise InspeError(
                f"{path}: written by another version of inspe_jax; delete it to start again"
            )
        raise ValueError(f"format '{record['format']}', expected '{FORMAT}'")
    state: State = {
        name.removeprefix(_ARRAY): data[name] for name in data if name.startswith(_ARRAY)
    }
    state |= {
        name.removeprefix(_VALUE): data[name].item() for name in data if name.startswith(_VALUE)
    }
    seconds, evaluations = record["limits"]
    return Checkpoint(
        of=dict(record["of"]),
        state=state,
        path=data["path"],
        held=data.get("held", data["path"][:0]),
        history=tuple(Progress(*row) for row in data["history"].tolist()),
        seconds=float(record["seconds"]),
        evaluations=float(record["evaluations"]),
        limits=(seconds, evaluations),
        status=str(record["status"]),
    )


def check_same(kept: Checkpoint, of: Mapping[str, str], path: str | os.PathLike[str]) -> None:
    """Raise InspeError if a checkpoint is of another search; the message names what differs."""
    other = []
    for name, value in of.items():
        was = kept.of.get(name)
        if was != value:
            plain = was is not None and len(value) < 30 and len(was) < 30  # words, not digests
            other.append(f"{name} ({was}, not {value})" if plain else name)
    if other:
        raise InspeError(
            f"{path}: a checkpoint of another search, with another {', another '.join(other)}; "
            "name another file, or delete it to start again"
        )


class CheckpointWriter:
    """Writes the state of a search to its checkpoint from time to time, and restores it.

    The state before a step is written. A step that was cut short is done again when the search is
    restored, so the search ends as it would have without the stop. ``ended`` is the status of a
    search that had already ended, otherwise "". Where the file cannot be written, the search goes
    on, and a note says so.
    """

    def __init__(self, path: str | os.PathLike[str], of: dict[str, str], run: Run) -> None:
        self.path, self.of, self.ended, self._notes = Path(path), of, "", run.notes
        self._last = time.monotonic()
        self._kept = self._now(run, {})

    def take_up(self, run: Run) -> State:
        """Restore a run from the file and return the method's state, which is empty at the start.

        Raises InspeError if the file is not a checkpoint of this search.
        """
        if not self.path.exists():
            return {}
        kept = load_checkpoint(self.path)
        check_same(kept, self.of, self.path)
        run.take_up(kept.seconds, kept.evaluations, kept.history, kept.path, *kept.held)
        self._kept = kept
        reached = run.best >= run.target
        over = kept.status == "converged" or (kept.status and kept.limits == run.limits)
        if kept.status == "target reached":
            over = False  # of another target than this
        if reached or over or run.left <= 0:
            self.ended = kept.status or ("target reached" if reached else "budget spent")
            run.notes.append(
                f"{self.path} has a search that has ended ({self.ended}); delete it to start "
                "again" + (", or give a larger budget" if self.ended == "budget spent" else "")
            )
        else:
            run.notes.append(f"went on from {self.path}, after {kept.seconds:.0f} s of search")
        return kept.state

    def mark(self, run: Run, state: State) -> None:
        """Keep the state of the search before a step, and write it if it is time."""
        self._kept = self._now(run, state)
        if time.monotonic() - self._last >= EVERY:
            self._write()

    def end(self, run: Run, state: State, status: str) -> None:
        """Write how the search ended; if interrupted, the state before its last step is kept."""
        if status != "interrupted":
            self._kept = self._now(run, state, status)
        self._write()

    def _now(self, run: Run, state: State, status: str = "") -> Checkpoint:
        return Checkpoint(
            of=self.of,
            state=state,
            path=np.array(run.path, float).reshape(-1, len(run.start)),
            held=np.array([] if run.held is None else run.held, float).reshape(-1, len(run.start)),
            history=tuple(run.history),
            seconds=run.seconds,
            evaluations=run.evaluations,
            limits=run.limits,
            status=status,
        )

    def _write(self) -> None:
        try:
            save_checkpoint(self._kept, self.path)
        except (InspeError, OSError) as e:
            if (words := f"no checkpoint is written: {e}") not in self._notes:
                self._notes.append(words)
        self._last = time.monotonic()
