"""The soft reading of what sensors see of a tile: a chance for each voxel, with gradients.

As :class:`~inspe_jax.scoring.reading.Bits`, but a set of F frames, C columns and Z levels is an
array (Z, F, C) of chances. The gradient is found sensor by sensor, of those that have some of the
tile in view, from how clear its sight lines are and which prisms that depends on.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float, Int, UInt

from inspe_jax.core.convex import outlines
from inspe_jax.core.geometry import Prism
from inspe_jax.core.numerics import Groups, Softness, Width, certain_beyond, leave_one_out
from inspe_jax.core.pytree import pytree
from inspe_jax.scoring.reading import Bits, Frames, SeeFrom, SensorRow, SightOptions, Union
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.centered_scene import Statics
from inspe_jax.visibility.in_view import soft_view
from inspe_jax.visibility.shadows import shadow_bounds
from inspe_jax.visibility.soft_sight import (
    Sights,
    SightsRead,
    cell_marks,
    clear_chance,
    packed,
    read_sights,
)
from inspe_jax.visibility.statics import past_statics_chance
from inspe_jax.visibility.tiles import Tile

SIGHTS_READ = "sights read"
"""Name of the arrays that a gradient needs of sight lines, of each sensor and in each frame."""


@pytree
@dataclass(frozen=True)
class Numbers:
    """Margins read with a softness, which has no gradient; a set is a chance for each voxel.

    ``keeps``: how clear sight lines are is kept for the gradient. Else it is found again, from the
    prisms that have a slope.
    """

    softness: Softness
    keeps: bool = field(default=True, metadata={"static": True})

    def in_little_room(self) -> "Numbers":
        """The same reading, which keeps less for the gradient."""
        return replace(self, keeps=False)

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

    def column_counts(self, found: Float[Array, "... Z C"]) -> Float[Array, "... C"]:
        """How many voxels of a set each column has."""
        return found.sum(-2)

    def column_sums(self, found: Float[Array, "Z F C"]) -> Float[Array, " C"]:
        """How many voxels of a set each column has, summed over the frames."""
        return found.sum(0).sum(0)

    def level_sums(self, found: Float[Array, "Z F C"], levels: int) -> Float[Array, "C Z"]:
        """In how many frames each voxel is in a set."""
        return found.sum(1).T

    def shadows(self, sensors: Float[Array, "S 3"], prisms: Prism) -> Any:
        """None: what sight lines are read as is found tile by tile."""

    def line_of_sight(
        self, row: SensorRow, tile: Tile, frames: Frames, options: SightOptions
    ) -> tuple[Float[Array, "Z F C"], Float[Array, "Z F C"], list[SightsRead]]:
        """The chance that each voxel is in line of sight: once as occlusion counts it, and once as
        information gain does. The third result is what was read for them; given in the place of
        shadows, it is not read again."""
        sensor, known, view = row
        width, fixed = self.softness.shadow, jax.lax.stop_gradient(sensor)
        prisms = outlines(frames.prisms)
        marked: Any = None
        if known is None:
            marked = self._marked(fixed, view, tile, frames, options)

        def look(spared: Any, known: SightsRead | None) -> tuple[Array, SightsRead]:
            marks = marked if known is None else known.sloped
            sights = Sights(prisms, marks, tile.columns, tile.heights, width, spared)
            read = read_sights(fixed, sights, known)
            return clear_chance(sensor, sights, read), read if self.keeps else packed(read)

        own = self.solid(frames, len(tile.heights)) > 0 if options.spares else None
        whole = [own, None] if options.spares and options.sight == "line_of_sight" else [own]
        found = [look(*each) for each in zip(whole, known or [None] * len(whole), strict=True)]
        return found[0][0], found[-1][0], [read for _, read in found]

    def _marked(
        self, sensor: Array, view: Any, tile: Tile, frames: Frames, options: SightOptions
    ) -> UInt[Array, "W F K"]:
        """The prisms that may hide something of each cell that counts."""
        reach = certain_beyond(self.softness.shadow)
        bounds = shadow_bounds(sensor, frames.prisms, reach)
        marked = cell_marks(sensor, outlines(frames.prisms), bounds, tile, reach)
        if options.anywhere:
            return marked
        cells = (view > 0).any(0).reshape(marked.shape[-1], -1).any(1)
        return jnp.where(cells, marked, jnp.uint32(0))

    def over_sensors(
        self, see_from: SeeFrom, rows: SensorRow, given: tuple, failures: Groups | None
    ) -> tuple[Union, Any]:
        """The union of what the sensors see, and how often each has each voxel in line of sight.

        A sensor that has nothing of the tile in view is skipped.
        """
        positions, _, views = rows
        union, sights = _union(see_from, positions, views, failures, given)
        return Union(union[0], lambda of: (union * of[None]).sum(1).sum(-1)), sights

    def views(self, tiles: Tile, *_: Any) -> None:
        """None: what is in view is found tile by tile, and again for the gradient."""

    def view_of_tile(
        self, views: None, tile: Tile, poses: Float[Array, "S 6"], sensors: Any, half: float | Array
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
        width = self.softness.shadow

        def look(row: tuple[Array, Array]) -> Array:
            sensor, view = row
            past = partial(past_statics_chance, statics=statics, tile=tile, width=width)
            return jax.lax.cond((view > 0).any(), past, lambda _: jnp.zeros_like(view), sensor)

        return jax.lax.map(look, (sensors, views))


def _read_union(
    see_from: SeeFrom,
    positions: Float[Array, "S 3"],
    views: Float[Array, "S Z C"],
    failures: Groups | None,
    given: tuple,
) -> tuple[Float[Array, "1+G Z F C"], Any, Any]:
    """The chance that some sensor sees each voxel; the sights; and what was read of each sensor."""
    listed, number = _in_view(views)
    of_sensor = lambda s: see_from((positions[s], None, views[s]), *given)  # noqa: E731
    visible, *others = jax.eval_shape(of_sensor, 0)

    def add(i: Array, state: tuple) -> tuple:
        s = listed[i]
        left, each, others = state
        visible, *other = of_sensor(s)
        if failures is None:
            left = left * (1.0 - visible)
        else:
            each = each.at[s].set(visible)
        return left, each, jax.tree.map(lambda all_, one: all_.at[s].set(one), others, other)

    rows = 0 if failures is None else len(views)
    each = jnp.zeros((rows, *visible.shape), visible.dtype)
    others = jax.tree.map(lambda one: jnp.zeros((len(views), *one.shape), one.dtype), others)
    state = jnp.ones(visible.shape, visible.dtype), each, others
    left, each, others = jax.lax.fori_loop(0, number, add, state)
    return (1.0 - left)[None] if failures is None else leave_one_out(each, failures), *others


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _union(see_from: SeeFrom, *given: Any) -> tuple[Float[Array, "1+G Z F C"], Any]:
    """The first two of :func:`_read_union`. Only ``positions`` and ``views`` have gradients."""
    return _read_union(see_from, *given)[:2]


def _in_view(views: Float[Array, "S Z C"]) -> tuple[Int[Array, " S"], Int[Array, ""]]:
    """The sensors, those that have some of the tile in view first, and the number of these."""
    has = (views > 0).any((1, 2))
    return jnp.argsort(~has, stable=True), has.sum()


def _union_forward(see_from: SeeFrom, *given: Any) -> tuple[Any, tuple]:
    union, sights, read = _read_union(see_from, *given)
    union, read = jax.tree.map(lambda x: checkpoint_name(x, SIGHTS_READ), (union, read))
    return (union, sights), (union, read, *given)


def _union_backward(see_from: SeeFrom, kept: tuple, wanted: tuple) -> tuple:
    """Sensor by sensor again. ∂(1 − ∏(1 − pₛ))/∂pₛ = ∏/(1 − pₛ), and 0 where pₛ = 1."""
    union, read, positions, views, failures, given = kept
    listed, number = _in_view(views)
    of_union, of_sights = wanted
    cells = read[0].sloped.shape[-1]

    def any_of_cells(wanted: Array) -> Array:
        return wanted.any(0).reshape(*wanted.shape[1:-1], cells, -1).any(-1)

    # Elsewhere some sensor sees all for certain, and its sight lines have no slope in the union.
    open_cells = any_of_cells((((1.0 - union) * of_union) != 0).any(0))

    def add(i: Array, slopes: tuple[Array, Array]) -> tuple[Array, Array]:
        s = listed[i]
        asked = open_cells
        if of_sights is not None:
            asked = asked | any_of_cells((of_sights[s] != 0).T)[None]
        known = [
            of._replace(sloped=jnp.where(asked, of.sloped, jnp.uint32(0)))
            for of in jax.tree.map(lambda all_: all_[s], read)
        ]
        of_sensor = lambda position, view: see_from((position, known, view), *given)[:2]  # noqa: E731
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
