"""The metrics of a scene, from the counts of its tiles."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from inspe_jax.core.numerics import Groups, Width
from inspe_jax.scoring.metric import Evidence, Metric
from inspe_jax.scoring.reading import Counts
from inspe_jax.scoring.tiled_scene import TiledScene
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.tiles import Tiles


class MetricValues(NamedTuple):
    """Every metric by name: of all sensors in row 0, without group g of the failures in row 1 + g.

    ``column_coverage`` and ``level_coverage`` are the shares of each column's and of each level's
    voxels that are in view. ``seen_share`` is the share of frames and levels in which each column
    is seen. ``entropy`` is H(Ω) in nats, the entropy that sensors can resolve. ``parts`` has every
    metric of all sensors in the core and outside; None where scores are read softly.
    """

    values: dict[str, Float[Array, " 1+G"]]
    column_coverage: Float[Array, " L"]
    level_coverage: Float[Array, " Z"]
    entropy: Float[Array, ""]
    seen_share: Float[Array, " L"]
    parts: dict[str, Float[Array, " 2"]] | None = None

    def of_scene(self, place: Any, failures: int) -> "MetricValues":
        """The values of padded arrays as those of a scene: its columns at ``place``, and the rows
        of so many failures."""
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
    failures: Groups | None,
    metrics: tuple[Metric, ...],
    width: Width = None,
    entropy_of_parts: Float[Array, "2 2"] | None = None,
) -> MetricValues:
    """The metrics of a scene, and the shares that pictures show.

    ``shares`` are the shares of each column's levels in view; ``by_level`` is how many columns are
    in view at each level; ``entropy`` is (H(Ω|P), H(Ω)); ``counts`` are those of all tiles;
    ``terms`` are the further terms that metrics ask for, one row for each tile. ``width`` [m] is
    that with which margins are read. ``entropy_of_parts`` is ``entropy`` of all sensors, a column
    each for the core and outside. Columns are in the tiles' order.
    """
    slabs, levels = tiled.tiles.slabs, tiled.tiles.level_count
    seen = counts.columns.reshape(slabs, -1).sum(0)
    own_levels = tiled.tiles.column_levels
    frames, whole = (jnp.asarray(x, float).T for x in (counts.seen, counts.original))
    evidence = Evidence(
        shares, tiled.weight, frames, whole, *entropy, terms, failures, own_levels, slabs, width
    )
    parts = None
    if entropy_of_parts is not None:
        parts = _of_parts(evidence, tiled.tiles, counts, entropy_of_parts, metrics)
    return MetricValues(
        {metric.name: metric.value(evidence) for metric in metrics},
        column_coverage=shares[0],
        level_coverage=by_level[:levels].astype(float) / _columns_of_levels(tiled.tiles),
        entropy=entropy[1],
        seen_share=seen.astype(float) / (tiled.frame_count * own_levels),
        parts=parts,
    )


def _of_parts(
    whole: Evidence,
    tiles: Tiles,
    counts: Counts,
    entropy: Float[Array, "2 2"],
    metrics: tuple[Metric, ...],
) -> dict[str, Float[Array, " 2"]]:
    """Every metric of all sensors in the core and outside: sums over their own columns alone."""
    core = tiles.tile.core.reshape(tiles.slabs, -1)[0]
    frames = jnp.stack([whole.seen[:, 0], whole.original[:, 0]])
    near = jnp.asarray(counts.core, float)
    found = []
    for part, (inside, within) in enumerate(((core, near), (~core, frames - near))):
        weight = jnp.where(inside, whole.weight, 0.0)
        counted = weight.any()  # else, as 0/0 is no number, it is the whole
        seen, original = jnp.where(counted, within, frames)[:, :, None]
        one = whole._replace(
            covered=whole.covered[:1],
            weight=jnp.where(counted, weight, whole.weight),
            seen=seen,
            original=original,
            remaining=entropy[0, part],
            entropy=entropy[1, part],
        )
        values = {metric.name: (metric, metric.value(one).reshape(-1)[0]) for metric in metrics}
        found.append(
            {k: jnp.where(counted | (not m.by_region), x, 0.0) for k, (m, x) in values.items()}
        )
    return {name: jnp.stack([of[name] for of in found]) for name in found[0]}


def _columns_of_levels(tiles: Tiles) -> Num[Array, "*Z"]:
    """How many columns each level has: one number, unless bodies stand in some."""
    there = tiles.tile.there.reshape(tiles.slabs, -1)
    if not tiles.gaps:
        return (there[0] != 0).astype(float).sum()
    height = tiles.tile.heights.shape[1]
    counts = bitmask.count_levels(there.T, height).reshape(-1)[: tiles.level_count]
    return jnp.maximum(counts.astype(float), 1.0)
