"""What a search's checkpoints hold, as they go through a file, and runs that go on from them."""

import io
from typing import Any, NamedTuple, Self

import numpy as np

from inspe_jax.placement.run import Run


class Checkpoint(NamedTuple):
    """A state on the way of a run, None at its end, and how far the run's account was then."""

    state: dict[str, Any] | None
    spent: tuple[float, float]
    scores: int
    best: int
    held: Any

    @classmethod
    def of(cls, run: Run, state: dict[str, Any] | None) -> Self:
        """Now, before the run goes on."""
        spent = run.seconds, run.evaluations
        return cls(state and saved(state), spent, len(run.history), len(run.path), run.held)

    def take_up(self, later: Run, run: Run) -> None:
        """Let another run go on from here; it has nothing but the state, and the run's account."""
        later.take_up(*self.spent, run.history[: self.scores], run.path[: self.best], self.held)


def saved(state: dict[str, Any]) -> dict[str, Any]:
    """Through a file: flat, no pickle, and numbers and strings as they were."""
    assert all(isinstance(v, np.ndarray | int | float | str | bool) for v in state.values())
    file = io.BytesIO()
    np.savez(file, **state)
    file.seek(0)
    with np.load(file, allow_pickle=False) as held:
        found = {k: held[k] for k in held.files}
    return {k: v.item() if v.ndim == 0 else v for k, v in found.items()}
