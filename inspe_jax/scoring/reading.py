"""What sensors see of a tile, read exactly, as sets of bits; and what both readings share.

Scores are counts of sets of voxels, and only the two readings know how a set is stored. With F
frames, C columns and Z levels in a tile:

- :class:`Bits`: a mask for each column with a bit for each level, (C,), and (F, C) in F frames.
  Exact in any order, 32 voxels in one operation.
- :class:`~inspe_jax.scoring.numbers.Numbers`: chances of voxels, (Z, C), and (Z, F, C) in frames.

``rows`` are one set for each sensor, (S, …). A result for G groups of failures has 1 + G rows: row
0 is of all sensors, row 1 + g of all but group g.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Num, UInt

from inspe_jax.core.geometry import Prism
from inspe_jax.core.numerics import Groups, without_each
from inspe_jax.core.pytree import pytree
from inspe_jax.sensing.rays import Kind, RayTable
from inspe_jax.sensing.sensor_array import SensorArray
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import Statics
from inspe_jax.visibility.shadows import clear_masks, shadow_bounds
from inspe_jax.visibility.statics import past_statics_masks
from inspe_jax.visibility.tiles import Tile
from inspe_jax.visibility.view_masks import view_masks


class Frames(NamedTuple):
    """F frames of one tile.

    ``prisms`` (F, B) are the road users. ``solid`` (F, C) are masks of the voxels inside a vehicle.
    """

    prisms: Prism
    solid: UInt[Array, "F C"]


class Counts(NamedTuple):
    """What is counted over the voxels of tiles: whole numbers, or softly sums of chances.

    ``seen`` and ``original``: |V_orig| − |V_occ| and |V_orig| of occlusion in each frame, of all
    sensors in row 0 and without group g in row 1 + g. ``columns``: for each column, the number of
    pairs of a voxel and a frame in which the voxel is outside vehicles and seen. ``sights``: in how
    many frames each sensor has each voxel in line of sight, in view or not; None where that is not
    needed. ``core``: ``seen`` and ``original`` of all sensors in the core, None read softly.
    """

    seen: Num[Array, "1+G F"]
    original: Num[Array, "1+G F"]
    columns: Num[Array, "*N C"]
    sights: Num[Array, "S *N C Z"] | None
    core: Num[Array, "2 F"] | None = None


class SightOptions(NamedTuple):
    """What line of sight is read for.

    ``sight`` is as of :class:`~inspe_jax.scoring.options.ScoreOptions`. ``spares``: a voxel inside
    a vehicle is hidden by other vehicles only. ``anywhere``: what is not in view counts, too.
    """

    sight: str | None
    spares: bool
    anywhere: bool


SensorRow = tuple[Float[Array, "3"], Any, Any]
"""One sensor: its position, what its shadows need or what was read of its sight lines before, and
the set that it has in view."""
SeeFrom = Callable[..., tuple[Any, Any, Any]]
"""Gives, for one sensor and what else is given, the set that it sees in each frame, the number of
frames in which each voxel is in line of sight, or None, and what a gradient needs, or None."""


@dataclass(frozen=True)
class Union:
    """What some sensor sees in each frame; ``count`` counts that of a set, also without groups."""

    all: Any
    count: Callable[[Any], Num[Array, "1+G F"]]


@pytree
@dataclass(frozen=True)
class Bits:
    """Margins read exactly; a set is a mask of levels for each column."""

    def in_little_room(self) -> "Bits":
        """The same reading: it keeps nothing for a gradient."""
        return self

    def voxels(self, tile: Tile) -> UInt[Array, " C"]:
        """The voxels that there are."""
        return tile.there

    def in_frames(self, found: UInt[Array, "... C"]) -> UInt[Array, "... 1 C"]:
        """A set that is the same in every frame."""
        return found[..., None, :]

    def solid(self, frames: Frames, levels: int) -> UInt[Array, "F C"]:
        """The voxels inside a vehicle."""
        return frames.solid

    def both(self, a: UInt[Array, "..."], b: UInt[Array, "..."]) -> UInt[Array, "..."]:
        """Intersection of two sets."""
        return a & b

    def outside(self, a: UInt[Array, "..."], b: UInt[Array, "..."]) -> UInt[Array, "..."]:
        """The voxels of set ``a`` that are not in ``b``, a subset of ``a``."""
        return a & ~b

    def any_of(self, rows: UInt[Array, "S ..."], failures: Groups | None) -> UInt[Array, "1+G ..."]:
        """Union of all rows, and of all but each group's."""
        if failures is None:
            return jax.lax.reduce(rows, rows.dtype.type(0), jax.lax.bitwise_or, (0,))[None]
        return without_each(rows, failures, jax.lax.bitwise_or, jnp.zeros_like(rows[0]))

    def count(self, found: UInt[Array, "... C"]) -> Int[Array, "..."]:
        """How many voxels a set has."""
        return bitmask.count(found).sum(-1)

    def count_both(
        self, rows: UInt[Array, "1+G C"], found: UInt[Array, "F C"]
    ) -> Int[Array, "1+G F"]:
        """How many voxels of each row are in a set, in each frame."""
        return jax.lax.map(lambda row: self.count(row[None] & found), rows)

    width = None
    """The edges of a field of view are read exactly."""

    def chances(self, found: UInt[Array, "... C"], levels: int) -> Float[Array, "... Z C"]:
        """1 for each voxel of a set, 0 for the others."""
        return jnp.moveaxis(bitmask.chances(found, levels), 0, -2)

    def column_counts(self, found: UInt[Array, "... C"]) -> Int[Array, "... C"]:
        """How many voxels of a set each column has."""
        return bitmask.count(found)

    def column_sums(self, found: UInt[Array, "F C"]) -> Int[Array, " C"]:
        """How many voxels of a set each column has, summed over the frames."""
        return bitmask.count(found).sum(0)

    def level_sums(self, found: UInt[Array, "F C"], levels: int) -> Int[Array, "C Z"]:
        """In how many frames each voxel is in a set."""
        return bitmask.count_levels(found, levels)

    def shadows(self, sensors: Float[Array, "S 3"], prisms: Prism) -> Any:
        """What each sensor's shadows need, the same for all tiles."""
        return jax.vmap(shadow_bounds, (0, None))(sensors, prisms)

    def line_of_sight(
        self, row: SensorRow, tile: Tile, frames: Frames, options: SightOptions
    ) -> tuple[UInt[Array, "F C"], UInt[Array, "F C"], None]:
        """The voxels in line of sight, as occlusion and as information gain count them."""
        sensor, shadows, _ = row
        spared = frames.solid if options.spares else None
        clear = clear_masks(sensor, shadows, tile, spared)
        return clear, clear if options.sight == "past_others" else clear & ~frames.solid, None

    def over_sensors(
        self, see_from: SeeFrom, rows: SensorRow, given: tuple, failures: Groups | None
    ) -> tuple[Union, Any]:
        """The union of what the sensors see, and how often each has each voxel in line of sight.

        The loop takes only the sensors that have some of the tile in view, one group after the
        other. ``once`` holds what some sensor sees, ``twice`` what two groups or more see. What a
        group sees outside ``twice``, it alone sees: without the group, that is lost.
        """
        views = rows[2]
        groups = 0 if failures is None else len(failures.first)
        order = jnp.arange(len(views)) if failures is None else jnp.asarray(failures.order)
        group = jnp.zeros(len(views), int) if failures is None else jnp.asarray(failures.of)
        has = (views != 0).any(1)[order]
        listed = order[jnp.argsort(~has, stable=True)]
        number = has.sum()

        def opens(i: Array) -> Array:
            """Whether the sensor is the first of its group."""
            return (i == 0) | (group[listed[i]] != group[listed[i - 1]])

        def add_sensor(i: Array, state: tuple) -> tuple:
            once, twice, before, each, sights = state
            visible, sight, _ = see_from(jax.tree.map(lambda leaf: leaf[listed[i]], rows), *given)
            before = jnp.where(opens(i), once, before)  # what the groups before this one see
            if groups:
                each = each.at[i].set(visible)
            sights = jax.tree.map(lambda all_, one: all_.at[listed[i]].set(one), sights, sight)
            return once | visible, twice | (before & visible), before, each, sights

        visible, sight, _ = jax.eval_shape(see_from, jax.tree.map(lambda x: x[0], rows), *given)
        none = jnp.zeros(visible.shape, visible.dtype)
        each = jnp.zeros((len(views) if groups else 0, *none.shape), none.dtype)
        sights = jax.tree.map(lambda one: jnp.zeros((len(views), *one.shape), one.dtype), sight)
        start = none, none, none, each, sights
        once, twice, _, each, sights = jax.lax.fori_loop(0, number, add_sensor, start)

        def count(of: UInt[Array, "F C"]) -> Int[Array, "1+G F"]:
            def add_lost(i: Array, state: tuple) -> tuple:
                lost, taken = state
                taken = jnp.where(opens(i), jnp.zeros_like(taken), taken)
                own = each[i] & ~twice & of & ~taken
                return lost.at[group[listed[i]]].add(self.count(own)), taken | own

            seen = bitmask.count(once & of).sum(1)
            alone = jnp.zeros((groups, len(none)), int)
            if groups:
                alone = jax.lax.fori_loop(0, number, add_lost, (alone, none))[0]
            return jnp.concatenate([seen[None], seen[None] - alone])

        return Union(once, count), sights

    def views(
        self, tiles: Tile, poses: Float[Array, "S 6"], sensors: SensorArray, half: float | Array
    ) -> UInt[Array, "N S C"]:
        """The voxels of N tiles that each sensor has in view; ``half`` an edge [m].

        Of all tiles at once: what the nearest ray leaves undecided is then few arrays.
        """

        def view(kind: Kind, table: RayTable, pose: Array) -> Array:
            return view_masks(kind.rays(table), pose, tiles, half)

        def no_sensor(table: RayTable, pose: Array) -> Array:
            return jnp.zeros_like(tiles.there)

        branches: list[Any] = [*(partial(view, kind) for kind in sensors.kinds), no_sensor]
        each = jnp.asarray(sensors.kind), jax.tree.map(jnp.asarray, sensors.table), poses
        found = jax.lax.map(lambda of: jax.lax.switch(of[0], branches, *of[1:]), each)
        return found.swapaxes(0, 1)

    def view_of_tile(self, views: UInt[Array, "S C"], *_: Any) -> UInt[Array, "S C"]:
        """The voxels of a tile that each sensor has in view: its own of :meth:`views`."""
        return views

    def past_statics(
        self,
        tile: Tile,
        sensors: Float[Array, "S 3"],
        statics: Statics | None,
        views: UInt[Array, "S C"],
    ) -> UInt[Array, "S C"] | None:
        """The voxels that bodies and the ground leave in sight of each sensor; None without any.

        Of a sensor that has nothing of the tile in view there are none.
        """
        if statics is None:
            return None
        tiles = jax.tree.map(lambda leaf: leaf[None], tile)
        past = lambda of: past_statics_masks(of[0], statics, tiles, of[1][None])[0]  # noqa: E731
        return jax.lax.map(past, (sensors, views))


BITS = Bits()
"""The exact reading."""


@pytree
@dataclass(frozen=True)
class Precomputed(Bits):
    """As :class:`Bits`, of what each sensor was found to see before: it takes no geometry.

    In place of shadows, rows have the set (F, C) that a sensor sees in each frame, and the numbers
    of frames (C, Z) in which it has each voxel in line of sight, or None.
    """

    def over_sensors(
        self, see_from: SeeFrom, rows: SensorRow, given: tuple, failures: Groups | None
    ) -> tuple[Union, Any]:
        """As that of :class:`Bits`."""
        seen, sights = rows[1]
        unions = self.any_of(seen, failures)
        return Union(unions[0], lambda of: self.count(unions & of[None])), sights


PRECOMPUTED = Precomputed()
"""The exact reading of what was found before."""
