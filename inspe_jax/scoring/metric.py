"""What a metric is: a row of the registry, and the evidence that it is computed from."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Num

from inspe_jax.core.errors import InspeError
from inspe_jax.core.numerics import Groups, Width, leave_one_out
from inspe_jax.scoring.detection import DetectionCurves
from inspe_jax.scoring.numbers import Reading
from inspe_jax.scoring.target_evidence import TargetEvidence, target_evidence
from inspe_jax.sensing.sensor_array import SensorArray
from inspe_jax.visibility.tiles import Tile


@dataclass(frozen=True, eq=False)
class TileEvidence:
    """What there is to know of one tile, for the metrics that need more than counts.

    ``tile.heights`` (Z, C) are those of the middles of its voxels and ``tile.ground`` (C) of the
    ground, ``tile.columns`` (2, C) x and y, all from the scene's centre [m]. ``views`` are the sets
    that each of S sensors has in view, as ``reading`` stores them. ``sights`` (S, C, Z) is the
    number of ``frames`` in which each has each voxel in line of sight; None unless some metric
    needs it. ``poses`` (S, 6) are about the scene's centre. ``last``: no slab of levels is above
    the tile; ``whole``: there are no slabs, the tile has whole columns.
    ``detection`` has the curves of detection, None for the usual ones. ``precomputed`` are the
    ``targets``, where they were found before.
    """

    reading: Reading
    tile: Tile
    views: Any
    sights: Num[Array, "S C Z"] | None
    frames: Float[Array, ""] | int
    poses: Float[Array, "S 6"]
    sensors: SensorArray
    last: Bool[Array, ""]
    whole: bool
    detection: DetectionCurves | None = None
    precomputed: TargetEvidence | None = None
    fields: tuple[str, ...] = TargetEvidence._fields

    @property
    def failures(self) -> Groups | None:
        """The groups of sensors that are left out in turn."""
        return self.sensors.failures

    @cached_property
    def sight(self) -> Float[Array, "S Z C"]:
        """The share of frames in which each sensor has each voxel in line of sight. As asked of a
        score by ``visibility``: with "past_others", which the profile ``paper`` has, a vehicle does
        not hide the voxels that it stands in; with "line_of_sight" it does."""
        if self.sights is None:
            words = "terms of a metric read what is in line of sight: it must say sight=True"
            raise InspeError(words)
        return self.sights.swapaxes(1, 2).astype(self.tile.heights.dtype) / self.frames

    @cached_property
    def visible(self) -> Float[Array, "S Z C"]:
        """The same, and in view: the share of frames in which each sensor sees each voxel."""
        return self.reading.chances(self.views, len(self.tile.heights)) * self.sight

    def some(self, chances: Float[Array, "S ..."]) -> Float[Array, "1+G ..."]:
        """The chance of some sensor, 1 − ∏(1 − p): of all, and without each group of failures."""
        return leave_one_out(chances, self.failures)

    @cached_property
    def targets(self) -> TargetEvidence:
        """What each sensor has on road users that stand at each column."""
        if self.precomputed is not None:
            return self.precomputed
        given = self.sensors, self.poses, self.tile, self.sight, self.last
        return target_evidence(*given, self.reading.width, self.detection, self.fields)


class Evidence(NamedTuple):
    """What metrics are computed from: the counts of a scene with T frames and L columns.

    ``covered`` is f, as the share of each column's levels that some sensor has in view; ``weight``
    is that of the columns' regions. ``seen`` and ``original`` are how many voxels V_orig has
    besides V_occ, and in all, in each frame (:func:`~inspe_jax.scoring.metrics.occlusion_terms`).
    ``remaining`` and ``entropy`` are H(Ω|P) and H(Ω) in nats
    (:func:`~inspe_jax.scoring.metrics.entropy_terms`). ``terms`` holds the further terms of the
    registry's metrics by name, one row for each tile. ``levels`` is the number of a column's
    levels, of each where static bodies stand in some; ``slabs`` that of the tiles over a column;
    ``width`` [m] that with which margins are read.
    """

    covered: Float[Array, "1+G L"]
    weight: Float[Array, " L"]
    seen: Num[Array, "T 1+G"]
    original: Num[Array, "T 1+G"]
    remaining: Float[Array, " 1+G"]
    entropy: Float[Array, ""]
    terms: dict[str, Any]
    failures: Groups | None
    levels: int | Float[Array, " L"]
    slabs: int
    width: Width

    def columns(self, name: str) -> Float[Array, "... L"]:
        """A metric's terms of columns (N, …, C), summed over the slabs of levels, as (…, L)."""
        return column_sums(self.terms[name], self.slabs)

    def level_means(self, name: str) -> Float[Array, "... L"]:
        """The same as means over each column's levels."""
        found = self.columns(name)
        return found / jnp.broadcast_to(jnp.asarray(self.levels, found.dtype), found.shape)


def column_sums(found: Float[Array, "N ... C"], slabs: int) -> Float[Array, "... L"]:
    """Terms of columns, one row for each tile, summed over the slabs of levels."""
    each = found.reshape(slabs, -1, *found.shape[1:]).sum(0)
    each = each.transpose(*range(1, each.ndim - 1), 0, -1)
    return each.reshape(*each.shape[:-2], -1)


@dataclass(frozen=True)
class Metric:
    """A row of the registry: a metric between 0 and 1, higher is better.

    ``name`` is used in records and options, ``symbol`` in tables. ``weight`` is the usual one in
    P_sm. ``summary`` says in one line what the metric is. ``value`` gives the metric (1 + G,) from
    the :class:`Evidence` of a scene: of all sensors, and without each of G groups of failures.
    ``terms`` is for a metric that needs more than the evidence has: a function of
    :class:`TileEvidence` that gives arrays, which are then ``evidence.terms[name]``, one row for
    each tile. ``sight``: it reads ``sight`` or ``visible`` there. A metric that is not ``usual`` is
    computed only where it is asked for or has weight. One ``by_region`` weighs columns by
    ``evidence.weight``, so that regions may be chosen.

    Two more make searches faster. ``targets`` names the fields of ``targets`` that ``terms`` reads,
    if any; others may be None there. ``submodular`` promises that a sensor never takes anything
    away, and adds the less the more others there are; else candidates are left out wrongly.

    >>> {row.symbol: row.weight for row in inspe_jax.METRICS.values() if row.weight}
    {'C': 0.3, 'O': 0.5, 'IG': 0.2}
    """

    name: str
    symbol: str
    weight: float
    summary: str
    value: Callable[[Evidence], Float[Array, " 1+G"]]
    terms: Callable[[TileEvidence], Any] | None = None
    sight: bool = False
    usual: bool = True
    by_region: bool = False
    targets: tuple[str, ...] | None = None
    submodular: bool = False

    def of(self, found: Evidence) -> Float[Array, " 1+G"]:
        """The ``value``. Raises InspeError if it is of another shape."""
        value, rows = jnp.asarray(self.value(found)), found.seen.shape[1:]
        if value.shape != rows:
            raise InspeError(
                f"metric '{self.name}': its value has the shape {value.shape}, not (1 + G,) = "
                f"{rows}, a number of all sensors and one without each group of failures"
            )
        return value

    @property
    def words(self) -> str:
        """The name, for people."""
        return self.name.replace("_", " ")
