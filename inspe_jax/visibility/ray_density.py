"""Rays as a density: the expected number of rays on a voxel, and the chance of at least one.

The phase of the grid, that is where between two rows and between two columns it begins, is taken as
random. What is left is how far apart rays are at the voxel, and how large it looks. That is smooth
in the pose, and its sum over voxels is the mean over phases of the exact count.

A voxel is seen as the shadow of a box, a zonogon. In a plane whose units are the spacings of
columns and of rows, the rays are the points of a unit lattice at a random place.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from inspe_jax.core.geometry import Point, dot3
from inspe_jax.core.numerics import REACH, Width, step
from inspe_jax.sensing.rays import Rays

_LEAST = 1e-6  # what numbers that are divided by are at least, in whatever unit they have

Edges = tuple[Point, Point, Point]
"""The three edge vectors of boxes [m]."""


class Footprint(NamedTuple):
    """A box as a sensor sees it.

    In spacings of columns and of rows, ``wide`` and ``tall`` are its extents, ``row`` and
    ``column`` the lengths of the row and of the column through its middle, and ``area`` is its
    area: the expected number of rays on it. ``width``, ``height`` and ``depth`` are its extents [m]
    along a row, along a column and along the line of sight.
    """

    wide: Float[Array, "*n"]
    tall: Float[Array, "*n"]
    row: Float[Array, "*n"]
    column: Float[Array, "*n"]
    area: Float[Array, "*n"]
    width: Float[Array, "*n"]
    height: Float[Array, "*n"]
    depth: Float[Array, "*n"]


def footprint(rays: Rays, q: Point, edges: Edges) -> Footprint:
    """The footprints of boxes centred at points ``q``, in the body frame.

    A box is taken as small beside its distance, and no nearer to the axis of a LiDAR or the picture
    plane of a camera than half its diagonal. The number of rows that it spans is counted, so that
    it may reach over several rows with uneven spacings.
    """
    near = jnp.sqrt(sum(dot3(edge, edge) for edge in edges)) / 2
    up, left = rays.slopes(q, near)
    rise, run = ([dot3(slope, edge) for edge in edges] for slope in (up, left))
    span, spread = (sum(jnp.abs(x) for x in parts) for parts in (rise, run))
    row, columns = rays.row(q), jnp.asarray(rays.table.columns_per_unit)
    tall = rays.rows_below(row + span / 2) - rays.rows_below(row - span / 2)
    rows = tall / jnp.maximum(span, _LEAST)  # a unit of the row's coordinate
    # The parallelograms of two edges each. The zonogon's sides are its edges; a line through the
    # middle ends at the side that it meets first.
    faces = [jnp.abs(run[k - 1] * rise[k - 2] - run[k - 2] * rise[k - 1]) for k in range(3)]
    beside = [faces[k - 1] + faces[k - 2] for k in range(3)]
    # An edge that is seen end-on is no side: its quotient, 0 / 0, becomes the largest possible.
    least = _LEAST * sum(beside)
    along = []
    for parts, whole in ((rise, span), (run, spread)):
        quotients = [
            (beside[k] + least) / (jnp.abs(parts[k]) + (_LEAST * whole + _LEAST**2))
            for k in range(3)
        ]
        along.append(functools.reduce(jnp.minimum, quotients))
    return Footprint(
        spread * columns,
        tall,
        along[0] * columns,
        along[1] * rows,
        sum(faces) * rows * columns,
        spread / _length(left),
        span / _length(up),
        sum(jnp.abs(dot3(q, edge)) for edge in edges) / _length(q),
    )


def hit_chance(of: Footprint) -> Float[Array, "*n"]:
    """The chance that a zonogon contains a point of a unit lattice at a random place.

    For a rectangle it is min(1, wide)·min(1, tall). In general, let L(y) be the zonogon's length at
    height y above its middle. It is longest in the middle and falls to 0 at the ends; how soon
    follows from the area. Of the lattice's rows, the one nearest to the middle is at a height y
    that is even between −½ and ½, and it has a point in the zonogon with the chance min(1, L(y)).
    The same holds for columns. Each way neglects the other rows or columns, so the larger is taken.
    """
    return jnp.maximum(
        _nearest_line(of.row, of.tall, of.area), _nearest_line(of.column, of.wide, of.area)
    )


def _nearest_line(
    length: Float[Array, "*n"], across: Float[Array, "*n"], area: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """∫ min(1, L(y)) dy, |y| ≤ ½. L is ``length`` near 0, falls to 0 at across/2; ∫ L dy = area."""
    length, across = (jnp.maximum(x, _LEAST) for x in (length, across))
    slant = jnp.clip(2.0 - 2.0 * area / (length * across), _LEAST, 1.0)
    most = jnp.minimum(length, 1.0)
    fall = 2.0 * length / (across * slant)
    end, flat = jnp.minimum(across, 1.0) / 2, across / 2 - most / fall
    beyond = jnp.maximum(end - flat, 0.0)
    return 2.0 * most * end - fall * beyond * beyond


def in_view_chance(rays: Rays, q: Point, edges: Edges, softness: Width) -> Float[Array, "*n"]:
    """The chance that some ray passes through each voxel, under a random phase of the grid.

    ``softness`` [m] is that of the edges of the field. They lie half a spacing beyond the outermost
    rays. The less of a voxel is inside, the less likely a ray meets it: an edge is also blurred by
    the part of the voxel over which the chance falls from its value inside to 0: its extent, or
    that of one spacing where the voxel has several. Along the line of sight, half of it.
    """
    of, outer = footprint(rays, q, edges), rays.table.outer

    def within(margin: Array, extent: Array, number: Array | float) -> Array:
        falls = extent / jnp.maximum(number, 1.0)
        width = falls / (2 * REACH) + (0.0 if softness is None else softness)
        return step(margin + (extent - falls) / 2, width)

    chance = hit_chance(of) * within(jnp.asarray(rays.table.reach) - _length(q), of.depth, 2.0)
    chance *= within(rays.square_row(q, outer, 0), of.height, of.tall)
    chance *= within(-rays.square_row(q, outer, 1), of.height, of.tall)
    if not rays.wraps:
        chance *= within(rays.column_margin(q, outer), of.width, of.wide)
    return chance


def _length(a: Point) -> Float[Array, "*n"]:
    """Length of a vector, at least a little, so that it has a gradient at 0."""
    return jnp.sqrt(jnp.maximum(dot3(a, a), _LEAST**2))
