"""Vehicles that stand in the parking lanes and spaces of a map: at random, the same for a place."""

import zlib
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import shapely
from jaxtyping import Float
from shapely.geometry.base import BaseGeometry
from shapely.ops import unary_union

from inspe_jax.core.words import counted
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.lines import arc_of
from inspe_jax.scene.maps.lanes import LaneStrip
from inspe_jax.scene.regions import Region
from inspe_jax.scene.statics import StaticBody, upright_box
from inspe_jax.scene.street import PARKED, parked_size

OCCUPIED = 0.85
"""Share of places that are taken: what cities manage parking for, since at more than this drivers
circle for one (Shoup, The High Cost of Free Parking, 2005)."""
PARALLEL, ABREAST = 6.0, 2.5  # length of a place along the lane [m]: vehicles in a row, abreast
DEEP = 4.4  # where a lane is wider than this, vehicles stand across it [m]
OUT = 0.1  # a vehicle may stand out of its place by so much [m²], as in a bend
MARGIN = 0.1  # vehicles keep this far from the edges of a place [m]


def parked_vehicles(
    place: Intersection, lanes: Iterable[LaneStrip], spaces: Iterable[BaseGeometry], reach: float
) -> tuple[StaticBody, ...]:
    """The vehicles in parking lanes and on marked spaces within ``reach`` [m] of a place's centre,
    none on a crosswalk or out of its lane."""
    rng = np.random.default_rng(zlib.crc32(place.name.encode()))
    crossings = place.regions.get(Region.CROSSWALK, shapely.Polygon())
    disc = shapely.Point(place.center[:2]).buffer(reach)
    found: list[StaticBody] = []
    for at, yaw, size, allowed in (*_along(lanes), *_on(spaces)):
        taken, turned, first = rng.uniform(), rng.uniform() < 0.5, parked_size(rng)
        if taken > OCCUPIED:
            continue
        fits = [s for s in (first, *(s for _, s in PARKED)) if (np.array(s[:2]) <= size).all()]
        if not fits:
            continue
        one = upright_box("parked vehicle", at, fits[0], yaw + np.pi * turned)
        out = one.polygon.difference(allowed).area
        if disc.contains(one.polygon) and out < OUT and not crossings.intersects(one.polygon):
            found.append(one)
    return tuple(found)


def with_parked(
    place: Intersection,
    lanes: Iterable[LaneStrip],
    spaces: Iterable[BaseGeometry],
    reach: float,
    notes: list[str],
) -> Intersection:
    """A place with :func:`parked_vehicles` besides its other bodies; ``notes`` get how many."""
    found = parked_vehicles(place, lanes, spaces, reach)
    others = unary_union([one.polygon for one in place.bodies])
    found = tuple(one for one in found if not others.intersects(one.polygon))
    if found:
        notes.append(
            f"{counted(len(found), 'vehicle')} parked where the map has parking lanes or spaces: "
            f"{OCCUPIED:.0%} of the places are taken"
        )
    return replace(place, bodies=(*place.bodies, *found))


Spot = tuple[Float[np.ndarray, "2"], float, Float[np.ndarray, "2"], BaseGeometry]
"""The middle of a place [m], the direction of its vehicle [rad], the most that it may measure in
length and width [m], and the ground that it must stay on."""


def _along(lanes: Iterable[LaneStrip]) -> Iterator[Spot]:
    """The places of parking lanes."""
    for lane in lanes:
        line = lane.center[:, :2]
        arc = arc_of(line)
        wide = np.hypot(*(lane.left - lane.right).T)
        across = float(np.median(wide)) > DEEP
        pitch = ABREAST if across else PARALLEL
        for at in np.arange(pitch / 2, arc[-1] - pitch / 2 + 1e-9, pitch):
            before, middle, after = (
                np.array([np.interp(at + d, arc, x) for x in line.T]) for d in (-0.5, 0.0, 0.5)
            )
            yaw = float(np.arctan2(*(after - before)[::-1])) + np.pi / 2 * across
            width = float(np.interp(at, arc, wide))
            size = np.array((width, pitch) if across else (pitch, width))
            yield middle, yaw, size - 2 * MARGIN, lane.polygon


def _on(spaces: Iterable[BaseGeometry]) -> Iterator[Spot]:
    """The places of marked spaces: the vehicle stands along the longer side."""
    for space in spaces:
        around = shapely.minimum_rotated_rectangle(space)
        if around.geom_type != "Polygon":
            continue
        sides = np.diff(np.array(around.exterior.coords), axis=0)[:2]
        length = np.hypot(*sides.T)
        along = sides[int(np.argmax(length))]
        size = np.sort(length)[::-1] - 2 * MARGIN
        yield np.array(around.centroid.coords[0]), float(np.arctan2(*along[::-1])), size, space
