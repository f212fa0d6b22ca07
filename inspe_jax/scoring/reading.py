"""The two readings of what sensors see: exact, as bits, or soft, as numbers.

Scores are counts of sets of voxels. :mod:`inspe_jax.scoring.accumulate` and
:mod:`inspe_jax.scoring.metrics` say which sets, once for both readings. Only this module knows how
a set is stored. With F frames, C columns and Z levels in a tile:

- :class:`Bits`: a mask for each column with a bit for each level, (C,), and (F, C) in F frames.
  Exact in any order, 32 voxels in one operation.
- :class:`Numbers`: the chance of each voxel, (Z, C), and (Z, F, C) in F frames. Differentiable.

Both have the methods that :mod:`inspe_jax.scoring.accumulate` and the metrics call.
:class:`Numbers` also makes its sets of what is in view; :mod:`inspe_jax.scoring.exact` makes those
of :class:`Bits`. ``rows`` are one set for each sensor, (S, …). A result for G groups of failures
has 1 + G rows: row 0 is of all sensors, row 1 + g of all but group g.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Num, UInt

from inspe_jax.core.convex import outlines
from inspe_jax.core.geometry import Prism
from inspe_jax.core.numerics import (
    Groups,
    Softness,
    Width,
    certain_beyond,
    exact,
    leave_one_out,
)
from inspe_jax.core.pytree import pytree
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import Statics
from inspe_jax.visibility.in_view import soft_view
from inspe_jax.visibility.shadows import (
    clear_masks,
    exact_sight,
    shadow_bounds,
)
from inspe_jax.visibility.soft_sight import Sights, cell_marks, clear_chance
from inspe_jax.visibility.statics import past_statics_chance
from inspe_jax.visibility.tiles import Tile

TOGETHER = 128
"""Frames that are read softly at once: what a tile needs of so many stays in a core's cache."""


class Frames(NamedTuple):
    """F frames of one tile.

    ``prisms`` (F, B) are the road users. ``solid`` (F, C) are masks of the voxels inside a vehicle.
    ``real`` (F,) is 1 for a frame and 0 for padding; None means that there is no padding.
    """

    prisms: Prism
    solid: UInt[Array, "F C"]
    real: Float[Array, " F"] | None = None


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


SensorRow = tuple[Float[Array, "3"], Any, Any]
"""One sensor: its position, what its shadows need, and the set that it has in view."""
SeeFrom = Callable[..., tuple[Any, Any]]
"""Gives, for one sensor and what else is given, the set that it sees in each frame, and the number
of frames in which each voxel is in line of sight, or None."""


# ── Exactly ─────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class BitUnion:
    """What some sensor sees in each frame.

    ``alone`` counts, for each group, the voxels of a set that no other sensor sees.
    """

    all: UInt[Array, "F C"]
    alone: Callable[[UInt[Array, "F C"]], Int[Array, "G F"]]

    def count(self, of: UInt[Array, "F C"]) -> Int[Array, "1+G F"]:
        """How many voxels of a set some sensor sees: of all sensors, and without each group."""
        seen = bitmask.count(self.all & of).sum(1)
        return jnp.concatenate([seen[None], seen[None] - self.alone(of)])


@pytree
@dataclass(frozen=True)
class Bits:
    """Margins read exactly; a set is a mask of levels for each column."""

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
        return bitmask.without_one(rows, failures)

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

    def column_sums(self, found: UInt[Array, "F C"], frames: Frames) -> Int[Array, " C"]:
        """How many voxels of a set each column has, summed over the frames."""
        return bitmask.count(found).sum(0)

    def level_sums(
        self, found: UInt[Array, "F C"], frames: Frames, levels: int
    ) -> Int[Array, "C Z"]:
        """In how many frames each voxel is in a set."""
        return bitmask.count_levels(found, levels)

    def shadows(self, sensors: Float[Array, "S 3"], prisms: Prism) -> Any:
        """What each sensor's shadows need, the same for all tiles."""
        return jax.vmap(shadow_bounds, (0, None))(sensors, prisms)

    def line_of_sight(
        self,
        sensor: Float[Array, "3"],
        shadows: Any,
        view: Any,
        tile: Tile,
        frames: Frames,
        options: ScoreOptions,
    ) -> tuple[UInt[Array, "F C"], UInt[Array, "F C"]]:
        """The voxels in line of sight of a sensor: once as occlusion counts them, and once as
        information gain does."""
        spared = frames.solid if options.ignores_self_occlusion else None
        clear = clear_masks(sensor, shadows, tile, spared)
        return clear, clear if options.sight == "past_others" else clear & ~frames.solid

    def over_sensors(
        self, see_from: SeeFrom, rows: SensorRow, given: tuple, failures: Groups | None
    ) -> tuple[BitUnion, Any]:
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
            visible, sight = see_from(jax.tree.map(lambda leaf: leaf[listed[i]], rows), *given)
            before = jnp.where(opens(i), once, before)  # what the groups before this one see
            if groups:
                each = each.at[i].set(visible)
            sights = jax.tree.map(lambda all_, one: all_.at[listed[i]].set(one), sights, sight)
            return once | visible, twice | (before & visible), before, each, sights

        visible, sight = jax.eval_shape(see_from, jax.tree.map(lambda leaf: leaf[0], rows), *given)
        none = jnp.zeros(visible.shape, visible.dtype)
        each = jnp.zeros((len(views) if groups else 0, *none.shape), none.dtype)
        sights = jax.tree.map(lambda one: jnp.zeros((len(views), *one.shape), one.dtype), sight)
        start = none, none, none, each, sights
        once, twice, _, each, sights = jax.lax.fori_loop(0, number, add_sensor, start)

        def alone(of: UInt[Array, "F C"]) -> Int[Array, "G F"]:
            def add_lost(i: Array, state: tuple) -> tuple:
                lost, taken = state
                taken = jnp.where(opens(i), jnp.zeros_like(taken), taken)
                own = each[i] & ~twice & of & ~taken
                return lost.at[group[listed[i]]].add(self.count(own)), taken | own

            lost = jnp.zeros((groups, len(none)), int)
            return jax.lax.fori_loop(0, number, add_lost, (lost, none))[0] if groups else lost

        return BitUnion(once, alone), sights

    def in_parts(self, work: Callable[[Frames], Counts], frames: Frames) -> Counts:
        """``work`` on all frames at once."""
        return work(frames)


# ── Softly ──────────────────────────────────────────────────────────────────


@dataclass(frozen=True)
class NumberUnion:
    """The chance that some sensor sees a voxel in a frame.

    Row 0 is of all sensors, row 1 + g of all but group g.
    """

    rows: Float[Array, "1+G Z F C"]

    @property
    def all(self) -> Float[Array, "Z F C"]:
        """What some sensor sees, of all sensors."""
        return self.rows[0]

    def count(self, of: Float[Array, "Z F C"]) -> Float[Array, "1+G F"]:
        """How many voxels of a set some sensor sees: of all sensors, and without each group."""
        return (self.rows * of[None]).sum(1).sum(-1)


@pytree
@dataclass(frozen=True)
class Numbers:
    """Margins read with a softness; a set is a chance for each voxel.

    The sight lines of all frames would not fit in memory, so for the gradient what is cheap is
    computed again. ``softness`` itself has no gradient.
    """

    softness: Softness

    def voxels(self, tile: Tile) -> Float[Array, "Z C"]:
        """The voxels that there are."""
        return bitmask.chances(tile.there, len(tile.heights))

    def in_frames(self, found: Float[Array, "... Z C"]) -> Float[Array, "... Z 1 C"]:
        """A set that is the same in every frame."""
        return found[..., None, :]

    def solid(self, frames: Frames, levels: int) -> Float[Array, "Z F C"]:
        """The voxels inside a vehicle. They do not depend on sensors and are read exactly."""
        return bitmask.chances(frames.solid, levels)

    def both(self, a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
        """Intersection of two sets: their chances multiplied."""
        return a * b

    def outside(self, a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
        """The voxels of set ``a`` that are not in ``b``, a subset of ``a``."""
        return a - b

    def any_of(
        self, rows: Float[Array, "S ..."], failures: Groups | None
    ) -> Float[Array, "1+G ..."]:
        """Union of all rows, and of all but each group's: 1 − ∏(1 − p)."""
        return leave_one_out(rows, failures)

    def count(self, found: Float[Array, "Z ... C"]) -> Float[Array, "..."]:
        """How many voxels a set has."""
        return found.sum(0).sum(-1)

    def count_both(
        self, rows: Float[Array, "1+G Z C"], found: Float[Array, "Z F C"]
    ) -> Float[Array, "1+G F"]:
        """How many voxels of each row are in a set, in each frame."""
        return (rows[:, :, None] * found[None]).sum(1).sum(-1)

    @property
    def width(self) -> Width:
        """The width [m] with which the edges of a field of view are read."""
        return self.softness.field

    def chances(self, found: Float[Array, "... Z C"], levels: int) -> Float[Array, "... Z C"]:
        """The chance of each voxel to be in a set."""
        return found

    def column_sums(self, found: Float[Array, "Z F C"], frames: Frames) -> Float[Array, " C"]:
        """How many voxels of a set each column has, summed over the frames."""
        return (found.sum(0) * self._real(frames)[:, None]).sum(0)

    def level_sums(
        self, found: Float[Array, "Z F C"], frames: Frames, levels: int
    ) -> Float[Array, "C Z"]:
        """In how many frames each voxel is in a set."""
        return (found * self._real(frames)[None, :, None]).sum(1).T

    def shadows(self, sensors: Float[Array, "S 3"], prisms: Prism) -> Any:
        """None: what shadows need is found tile by tile, and again for the gradient."""

    def line_of_sight(
        self,
        sensor: Float[Array, "3"],
        shadows: Any,
        view: Any,
        tile: Tile,
        frames: Frames,
        options: ScoreOptions,
    ) -> tuple[Float[Array, "Z F C"], Float[Array, "Z F C"]]:
        """The chance that each voxel is in line of sight: once as occlusion counts it, and once as
        information gain does."""
        width = self.softness.shadow
        reach = certain_beyond(width)
        spared = self.solid(frames, len(tile.heights)) > 0

        own = spared if options.ignores_self_occlusion else False
        if exact(width):
            look = partial(exact_sight, sensor, frames.prisms, tile.columns, tile.heights)
        else:
            fixed = jax.lax.stop_gradient(sensor)
            prisms = outlines(frames.prisms)
            bounds = shadow_bounds(fixed, frames.prisms, reach)
            marked = cell_marks(fixed, prisms, bounds, tile, reach)
            if not any(metric.sight for metric in options.metrics):  # else, in view or not
                cells = (view > 0).any(0).reshape(marked.shape[-1], -1).any(1)
                marked = jnp.where(cells, marked, jnp.uint32(0))
            at = prisms, marked, tile.columns, tile.heights, width

            def look(ignore_self_occlusion: Any) -> Array:
                spared = None if ignore_self_occlusion is False else ignore_self_occlusion
                return clear_chance(sensor, Sights(*at, spared))

        clear = look(ignore_self_occlusion=own)
        return clear, look(ignore_self_occlusion=False) if options.sight_apart else clear

    def over_sensors(
        self, see_from: SeeFrom, rows: SensorRow, given: tuple, failures: Groups | None
    ) -> tuple[NumberUnion, Any]:
        """The union of what the sensors see, and how often each has each voxel in line of sight.

        A sensor that has nothing of the tile in view is skipped.
        """
        positions, _, views = rows
        union, sights = _union(see_from, positions, views, failures, given)
        return NumberUnion(union), sights

    def in_parts(self, work: Callable[[Frames], Counts], frames: Frames) -> Counts:
        """``work`` on :data:`TOGETHER` frames at a time."""
        total = len(frames.prisms.top)
        parts = -(-total // TOGETHER)
        each = -(-total // parts)

        def split(x: Array) -> Array:
            """(F, …) as (parts, each, …), padded with zeros: frames without prisms."""
            x = jnp.pad(x, [(0, parts * each - total)] + [(0, 0)] * (x.ndim - 1))
            return x.reshape(parts, each, *x.shape[1:])

        def joined(x: Array) -> Array:
            """(parts, 1 + G, each) as (1 + G, F), without the padding."""
            return x.swapaxes(0, 1).reshape(x.shape[1], -1)[:, :total]

        found = jax.lax.map(work, jax.tree.map(split, frames._replace(real=jnp.ones(total))))
        return Counts(
            joined(found.seen),
            joined(found.original),
            found.columns.sum(0),
            None if found.sights is None else found.sights.sum(0),
        )

    def views(
        self, tile: Tile, poses: Float[Array, "S 6"], sensors: Any, half: float | Array
    ) -> Float[Array, "S Z C"]:
        """The chance that each sensor has each voxel of a tile in view; ``half`` an edge [m]."""

        def view(sensor: tuple[Array, Any, Array]) -> Array:
            kind, table, pose = sensor
            return soft_view(sensors.kinds, kind, table, half, self.softness, pose, tile)

        each = jnp.asarray(sensors.kind), jax.tree.map(jnp.asarray, sensors.table), poses
        return jax.lax.map(view, each)

    def past_statics(
        self,
        tile: Tile,
        sensors: Float[Array, "S 3"],
        statics: Statics | None,
        views: Float[Array, "S Z C"],
    ) -> Float[Array, "S Z C"] | None:
        """The chance that bodies and the ground leave each voxel in sight; None without any.

        Of a sensor that has nothing of the tile in view it is 0.
        """
        if statics is None:
            return None

        def look(row: tuple[Array, Array]) -> Array:
            sensor, view = row
            past = partial(past_statics_chance, statics=statics, tile=tile)
            return jax.lax.cond(
                (view > 0).any(),
                lambda sensor: past(sensor, width=self.softness.shadow),
                lambda _: jnp.zeros_like(view),
                sensor,
            )

        return jax.lax.map(look, (sensors, views))

    @staticmethod
    def _real(frames: Frames) -> Float[Array, " F"]:
        """1 for every frame, 0 for padding."""
        return jnp.ones(len(frames.prisms.top)) if frames.real is None else frames.real


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _union(
    see_from: SeeFrom,
    positions: Float[Array, "S 3"],
    views: Float[Array, "S Z C"],
    failures: Groups | None,
    given: tuple,
) -> tuple[Float[Array, "1+G Z F C"], Any]:
    """The chance that some sensor sees each voxel, of all and without each group, and the sights.

    Only the sensors' ``positions`` and ``views`` have gradients.
    """
    of_sensor, listed, number = _in_view(see_from, positions, views, given)
    visible, sights = jax.eval_shape(of_sensor, positions[0], views[0])

    def add(i: Array, state: tuple) -> tuple:
        s = listed[i]
        left, each, sights = state
        visible, sight = of_sensor(positions[s], views[s])
        if failures is None:
            left = left * (1.0 - visible)
        else:
            each = each.at[s].set(visible)
        return left, each, jax.tree.map(lambda all_, one: all_.at[s].set(one), sights, sight)

    rows = 0 if failures is None else len(views)
    each = jnp.zeros((rows, *visible.shape), visible.dtype)
    sights = jax.tree.map(lambda one: jnp.zeros((len(views), *one.shape), one.dtype), sights)
    state = jnp.ones(visible.shape, visible.dtype), each, sights
    left, each, sights = jax.lax.fori_loop(0, number, add, state)
    return (1.0 - left)[None] if failures is None else leave_one_out(each, failures), sights


def _in_view(
    see_from: SeeFrom, positions: Array, views: Array, given: tuple
) -> tuple[Callable, Array, Array]:
    """What one sensor sees as a function of its position and view, the sensors that have some of
    the tile in view, before the others, and their number."""
    has = (views > 0).any((1, 2))

    def of_sensor(position: Array, view: Array) -> tuple[Array, Any]:
        return see_from((position, None, view), *given)

    return of_sensor, jnp.argsort(~has, stable=True), has.sum()


def _union_forward(see_from: SeeFrom, *given: Any) -> tuple[Any, tuple]:
    found = _union(see_from, *given)
    return found, (found[0], *given)


def _union_backward(see_from: SeeFrom, kept: tuple, wanted: tuple) -> tuple:
    """Sensor by sensor again. ∂(1 − ∏(1 − pₛ))/∂pₛ = ∏/(1 − pₛ); where pₛ = 1 it is certain and has
    no slope of its own."""
    union, positions, views, failures, given = kept
    of_sensor, listed, number = _in_view(see_from, positions, views, given)
    of_union, of_sights = wanted

    def add(i: Array, slopes: tuple[Array, Array]) -> tuple[Array, Array]:
        s = listed[i]
        (visible, _), back = jax.vjp(of_sensor, positions[s], views[s])
        each = (1.0 - union) * of_union
        if failures is not None:
            place = jnp.argsort(jnp.asarray(failures.order))[s]
            lost = (jnp.asarray(failures.first) <= place) & (place < jnp.asarray(failures.end))
            each = jnp.where(jnp.pad(lost, (1, 0))[:, None, None, None], 0.0, each)
        left = 1.0 - visible
        slope = jnp.where(left > 0, each.sum(0) / jnp.where(left > 0, left, 1.0), 0.0)
        new = back((slope, jax.tree.map(lambda leaf: leaf[s], of_sights)))
        return jax.tree.map(lambda all_, one: all_.at[s].set(one), slopes, new)

    none = jnp.zeros_like(positions), jnp.zeros_like(views)
    return *jax.lax.fori_loop(0, number, add, none), None, None


_union.defvjp(_union_forward, _union_backward)


Reading = Bits | Numbers
