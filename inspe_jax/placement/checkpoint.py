"""Checkpoints: the state of a search on disk, from which it can go on. An ``.npz`` file of arrays
and one JSON text, written whole or not at all, read without pickle."""

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import open_arrays, whole_file
from inspe_jax.placement.run import Progress, Run

FORMAT = "inspe_jax checkpoint 7"
SUFFIXES = (".npz",)
EVERY = 10.0
"""Time between two writes of a search's checkpoint [s]."""
_STATE = "state: "  # before the names of a state's fields


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Checkpoint:
    """A search after a step. ``of`` are digests or words of all that it depends on; ``state`` has
    the fields of the method's state and the name of its class; ``path`` (K, N) and ``held`` (0 or
    1, N) are the run's; ``status`` is "" while it runs, then how it ended."""

    of: dict[str, str]
    state: dict[str, Any]
    path: Float[np.ndarray, "K N"]
    held: Float[np.ndarray, "H N"]
    history: tuple[Progress, ...]
    seconds: float
    evaluations: float
    limits: tuple[float | None, float | None]
    status: str = ""

    @classmethod
    def now(cls, run: Run, state: Any, of: dict[str, str], status: str = "") -> "Checkpoint":
        """A copy of what a run has, and of the method's state."""
        return cls(
            of=of,
            state={} if state is None else {"class": type(state).__name__, **vars(state)},
            path=np.array(run.path, float).reshape(-1, len(run.start)),
            held=np.array([] if run.held is None else run.held, float).reshape(-1, len(run.start)),
            history=tuple(run.history),
            seconds=run.seconds,
            evaluations=run.evaluations,
            limits=run.limits,
            status=status,
        )


def state_of(states: Sequence[type[Any]], named: Mapping[str, Any]) -> Any:
    """The state of one of the classes ``states`` with the fields ``named``; None for no fields."""
    if not named:
        return None
    kind = {kind.__name__: kind for kind in states}[named["class"]]
    return kind(**{field.name: named[field.name] for field in fields(kind)})


def save_checkpoint(kept: Checkpoint, path: str | os.PathLike[str]) -> None:
    """Write a checkpoint over the old one; if that fails, the old one stays."""
    plain = ("of", "seconds", "evaluations", "limits", "status")
    record = {"format": FORMAT, **{name: getattr(kept, name) for name in plain}}
    arrays = {
        "record": np.array(json.dumps(record)),
        "path": kept.path,
        "held": kept.held,
        "history": np.array([astuple(row) for row in kept.history], float).reshape(-1, 4),
        **{_STATE + name: np.asarray(value) for name, value in kept.state.items()},
    }
    with whole_file(path) as f:
        np.savez(f, **arrays)  # type: ignore[arg-type]  # names are ours


def load_checkpoint(path: str | os.PathLike[str]) -> Checkpoint:
    """Read a checkpoint. Raises InspeError if the file is missing or is not a checkpoint."""
    other = "not a checkpoint of a search; name a new file, or one that --checkpoint wrote"
    with open_arrays(Path(path), other) as data:
        record = json.loads(str(data["record"]))
        written = str(record.pop("format"))
        if written != FORMAT:
            if written.startswith(FORMAT.rstrip("0123456789")):
                raise InspeError(
                    f"{path}: written by another version of inspe_jax; delete it to start again"
                )
            raise ValueError(f"format '{written}', expected '{FORMAT}'")
        state = {name.removeprefix(_STATE): data[name] for name in data if name.startswith(_STATE)}
        return Checkpoint(
            state={name: x if x.ndim else x.item() for name, x in state.items()},
            path=data["path"],
            held=data["held"],
            history=tuple(Progress(*row) for row in data["history"].tolist()),
            **record | {"limits": tuple(record["limits"])},
        )


class CheckpointWriter:
    """Writes a search to its checkpoint from time to time, and restores it.

    The state before a step is written, so a step that was cut short is done again. ``ended`` is the
    status of a search that had ended, or "". If the file cannot be written, a note says so.
    """

    def __init__(self, path: str | os.PathLike[str], of: dict[str, str], run: Run) -> None:
        self.path, self.of, self.ended, self._run = Path(path), of, "", run
        self._last = time.monotonic()
        self._kept = Checkpoint.now(run, None, of)

    def take_up(self, states: Sequence[type[Any]]) -> Any:
        """Restore the run from the file; the method's state, None at the start."""
        if not self.path.exists():
            return None
        run, kept = self._run, load_checkpoint(self.path)
        other = []
        for name, value in self.of.items():
            was = kept.of.get(name)
            if was != value:
                plain = was is not None and len(value) < 30 and len(was) < 30  # words, not digests
                other.append(f"{name} ({was}, not {value})" if plain else name)
        if other:
            raise InspeError(
                f"{self.path}: a checkpoint of another search, with another "
                f"{', another '.join(other)}; name another file, or delete it to start again"
            )
        run.take_up(kept.seconds, kept.evaluations, kept.history, kept.path, *kept.held)
        self._kept = kept
        reached, same = run.best >= run.target, kept.limits == run.limits
        over = kept.status == "converged" or (kept.status == "budget spent" and same)
        if reached or over or run.done >= 1:
            self.ended = kept.status or ("target reached" if reached else "budget spent")
            run.notes.append(
                f"{self.path} has a search that has ended ({self.ended}); delete it to start "
                "again" + (", or give a larger budget" if self.ended == "budget spent" else "")
            )
        else:
            run.notes.append(f"went on from {self.path}, after {kept.seconds:.0f} s of search")
        return state_of(states, kept.state)

    def mark(self, state: Any) -> None:
        """Keep the state of the search before a step, and write it if it is time."""
        self._kept = Checkpoint.now(self._run, state, self.of)
        if time.monotonic() - self._last >= EVERY:
            self._write()

    def end(self, state: Any, status: str) -> None:
        """Write how the search ended; if interrupted, the state before its last step is kept."""
        if status != "interrupted":
            self._kept = Checkpoint.now(self._run, state, self.of, status)
        self._write()

    def _write(self) -> None:
        try:
            save_checkpoint(self._kept, self.path)
        except (InspeError, OSError) as e:
            if (words := f"no checkpoint is written: {e}") not in self._run.notes:
                self._run.notes.append(words)
        self._last = time.monotonic()
