"""From what is counted tile by tile to the metrics of a scene."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from inspe_jax.scoring.metrics import Evidence, Metric
from inspe_jax.scoring.reading import Counts
from inspe_jax.scoring.tiled_scene import TiledScene


class MetricValues(NamedTuple):
    """Every metric by name: of all sensors in row 0, of all but failure g in row 1 + g.

    ``column_coverage`` and ``level_coverage`` are the shares in view of each column's and of each
    level's voxels; ``seen_share`` is the share of frames and levels in which each column is seen;
    ``entropy`` is H(Ω), what there is to gain.
    """

    values: dict[str, Float[Array, " 1+G"]]
    column_coverage: Float[Array, " L"]
    level_coverage: Float[Array, " Z"]
    entropy: Float[Array, ""]
    seen_share: Float[Array, " L"]

    def of_scene(self, place: Any, failures: int) -> "MetricValues":
        """These of arrays that are filled up, as they are of a scene: its columns, so many rows."""
        if not isinstance(self.column_coverage, jax.core.Tracer):
            place, self = jax.tree.map(np.asarray, (place, self))
        rows = slice(1 + failures)
        return self._replace(
            values={name: value[rows] for name, value in self.values.items()},
            column_coverage=self.column_coverage[place],
            seen_share=self.seen_share[place],
        )


def summarise(
    tiled: TiledScene,
    shares: Float[Array, "1+G MC"],
    by_level: Num[Array, " Z"],
    entropy: tuple[Float[Array, " 1+G"], Float[Array, ""]],
    counts: Counts,
    terms: dict[str, Any],
    metrics: tuple[Metric, ...],
) -> MetricValues:
    """The metrics of a scene, and what pictures show beside them.

    ``shares`` in view of each tile column's levels; ``by_level``, columns in view at each level;
    ``entropy`` that remains and all of it; ``counts`` over all tiles; ``terms`` that metrics ask
    for themselves. Columns stay those of the tiles.
    """
    slabs, levels = tiled.tiles.slabs, tiled.tiles.level_count
    seen = counts.columns.reshape(slabs, -1).sum(0)
    there = tiled.tiles.tile.there.reshape(slabs, -1)[0] != 0
    frames, whole = (jnp.asarray(x, float).T for x in (counts.seen, counts.original))
    evidence = Evidence(shares, tiled.weight, frames, whole, *entropy, terms)
    return MetricValues(
        {metric.name: metric.value(evidence) for metric in metrics},
        column_coverage=shares[0],
        level_coverage=by_level[:levels].astype(float) / there.astype(float).sum(),
        entropy=entropy[1],
        seen_share=seen.astype(float) / (tiled.frame_count * levels),
    )
