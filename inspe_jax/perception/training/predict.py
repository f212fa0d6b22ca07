"""What a detector finds in frames, and how much of it is right."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np

from inspe_jax.dataset.loading import Batch, Cache, Loader
from inspe_jax.perception.detector import Detector, model_of
from inspe_jax.perception.evaluation import Detections, Evaluation, evaluate, truth_of, within
from inspe_jax.perception.head import Peaks, peaks
from inspe_jax.perception.inputs import Agents, BevGrid, Inputs, inputs_of

LEAST_SCORE = 0.01
"""Detections with a lower score are dropped: of a hundred such, one is right by the detector's own
word. nuScenes' AP counts nothing below a precision of 0.1."""


def loader_of(name: str, cache: Cache, split: str, grid: BevGrid, **how: Any) -> Loader:
    """A loader of what a model takes; ``how`` are further arguments of the loader."""
    return Loader(
        cache, split, sensors=model_of(name).sensors, points=grid.pillars(), half=grid.half, **how
    )


@eqx.filter_jit
def _peaks(detector: Detector, inputs: Inputs, grid: BevGrid) -> Peaks:
    """Compiled once for a model and frames of one shape, whatever the weights."""
    return peaks(detector(inputs).found, grid)


class Predictor:
    """A detector, for frames."""

    def __init__(self, detector: Detector, agents: Agents, grid: BevGrid) -> None:
        self.detector, self.agents, self.grid = detector, agents, grid

    def __call__(self, batch: Batch) -> list[Detections]:
        """The detections in each frame of a batch that is ``valid``."""
        found: Peaks = _peaks(self.detector, inputs_of(batch, self.agents), self.grid)
        boxes, kind, score = map(np.asarray, found)
        kind, enough = kind.astype(np.int32), score >= LEAST_SCORE
        return [
            Detections(*(part[b][enough[b]] for part in (boxes, kind, score)))
            for b in np.flatnonzero(batch.valid).tolist()
        ]

    def evaluate(
        self,
        loader: Loader,
        most: int | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Evaluation:
        """The measures over the batches of a loader, or over about ``most`` frames, evenly.

        Detections count where road users do: within the loader's ``half``.
        ``progress`` is called with (batches done, all batches). Raises
        :class:`~inspe_jax.perception.evaluation.NoTruth`.
        """
        found: list[Detections] = []
        truth: list[Detections] = []
        half = loader.half
        count = len(loader)
        some = count if most is None else min(count, -(-most // loader.batch))
        spread = np.linspace(0, count - 1, some).round().astype(int).tolist()
        batches = loader if some == count else (loader[k] for k in spread)
        for done, batch in enumerate(batches, 1):
            found += [frame if half is None else within(frame, half) for frame in self(batch)]
            truth += [truth_of(batch.targets, b) for b in np.flatnonzero(batch.valid).tolist()]
            if progress:
                progress(done, some)
        return evaluate(found, truth)
