"""What each sensor has on road users that stand at each column, from one look at the geometry.

A road user of any heading is an upright face of its mean width, half its mean depth in front of its
middle, with a roof behind it; rays are counted slab by slab. Metrics are means of it, and maps
(:mod:`inspe_jax.scoring.targets`) its columns. Beside rays that are walked, numbers are within 5 %,
but for cameras nearer than two lengths of a vehicle: there up to 15 % too low.
"""

from collections.abc import Collection
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from inspe_jax.core.numerics import Width, step
from inspe_jax.scene.traffic.frames import CLASSES, ROAD_USERS
from inspe_jax.scoring.detection import DETECT, DetectionCurves, detection_curves
from inspe_jax.scoring.radar_evidence import radar_precision, share_told_apart, strength
from inspe_jax.sensing.rays import Kind, Rays, RayTable
from inspe_jax.sensing.sensor_array import SensorArray
from inspe_jax.sensing.signals import LidarNoise
from inspe_jax.visibility import bitmask
from inspe_jax.visibility.in_view import transform_of
from inspe_jax.visibility.target_rays import NEAR, rays_on_face, scale_at, share_between_sides
from inspe_jax.visibility.tiles import Tile, zeros_of

LEVEL_GROUND = 0.05
"""Standard deviation of the ground's height, by which a camera ranges [m]."""

SIZES = np.array([user.size for user in ROAD_USERS])
"""Length, width and height of each class (K, 3) [m]."""
WIDTH = 2 * (SIZES[:, 0] + SIZES[:, 1]) / np.pi
"""Mean width of each class over its headings [m]: Cauchy's formula for a convex outline."""
CHORD = np.pi * SIZES[:, 0] * SIZES[:, 1] / (2 * (SIZES[:, 0] + SIZES[:, 1]))
"""Mean depth of each class along lines of sight [m]: its area over its mean width."""
HIGHEST = 6.0
"""Higher than any road user [m]."""
WALKER = SIZES[CLASSES.index("pedestrian"), 2]


class TargetEvidence(NamedTuple):
    """What S sensors have on road users of the K classes that count, at C columns of a tile.

    Behind traffic, mean over frames; what belongs to the levels of the tile. ``chance`` is the
    chance that a sensor alone finds the road user. ``returns`` are expected LiDAR returns.
    ``sharp`` is the chance of at least :data:`DETECT` pixels per metre at half the height of a
    pedestrian, without traffic. ``precision`` is Fisher's information on its place [1/m²], the mean
    over classes: xx, xy and yy.
    """

    chance: Float[Array, "*S K C"]
    returns: Float[Array, "*S K C"]
    sharp: Float[Array, "*S C"]
    precision: Float[Array, "*S 3 C"]

    def only(self, fields: Collection[str]) -> "TargetEvidence":
        """These fields; the others are None."""
        others: Any = {name: None for name in self._fields if name not in fields}
        return self._replace(**others)


def target_evidence(
    sensors: SensorArray,
    poses: Float[Array, "S p"],
    tile: Tile,
    sight: Float[Array, "S Z C"],
    last: Bool[Array, ""],
    width: Width,
    detection: DetectionCurves | None = None,
    fields: tuple[str, ...] = TargetEvidence._fields,
) -> TargetEvidence:
    """What every sensor has on the road users at the columns of one tile.

    ``sight`` is the share of frames in which each voxel is in line of sight, ``last`` whether no
    slab of levels is above the tile, ``width`` [m] that with which the ends of reach and pictures
    are read. A sensor with nothing in sight is skipped. ``fields`` are wanted, others are None.
    """
    curves, beside = detection or detection_curves(), (tile, last, width)
    looks = [partial(_look, kind, curves, fields) for kind in sensors.kinds]
    branches: list[Any] = [*looks, partial(zeros_of, looks[0])]

    def of_row(row: tuple[Array, tuple[Array, Array, RayTable, Array]]) -> TargetEvidence:
        kind, (pose, seen, *own) = row
        some = (seen > 0).any()
        of = jnp.where(some, kind, len(sensors.kinds))
        return jax.lax.switch(of, branches, pose, seen, (*own, *beside))

    of_sensors = jax.tree.map(jnp.asarray, (sensors.table, sensors.pixels))
    kind = jnp.asarray(sensors.kind)
    return jax.lax.map(of_row, (kind, (poses, sight, *of_sensors)))


@partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2))
def _look(
    kind: Kind,
    curves: DetectionCurves,
    fields: tuple[str, ...],
    pose: Float[Array, " p"],
    sight: Float[Array, "Z C"],
    given: tuple,
) -> TargetEvidence:
    """:func:`target_evidence_of_sensor`, with gradients in ``pose`` and ``sight`` alone."""
    table, pixels, tile, last, width = given
    at = kind.rays(table), pixels, pose, tile, sight, last, width, curves
    return target_evidence_of_sensor(*at).only(fields)


def _look_forward(*given: Any) -> tuple[TargetEvidence, tuple]:
    """With slopes in the few numbers of the pose: reverse mode would keep every step of it."""
    *static, pose, sight, rest = given

    def along(tangent: Array) -> tuple[TargetEvidence, TargetEvidence]:
        return jax.jvp(lambda pose: _look.fun(*static, pose, sight, rest), (pose,), (tangent,))

    found, slopes = jax.vmap(along, out_axes=(None, 0))(jnp.eye(len(pose), dtype=pose.dtype))
    return found, (slopes, pose, sight, rest)


def _look_backward(*given: Any) -> tuple[Array, Array, None]:
    *static, (slopes, pose, sight, rest), wanted = given
    of_pose = jax.tree.map(
        lambda slope, wants: jnp.tensordot(slope, wants, wants.ndim), slopes, wanted
    )
    back = jax.vjp(lambda sight: _look.fun(*static, pose, sight, rest), sight)[1]
    return sum(jax.tree.leaves(of_pose)), *back(wanted), None


_look.defvjp(_look_forward, _look_backward)


def target_evidence_of_sensor(
    rays: Rays,
    pixels: Float[Array, ""],
    pose: Float[Array, " p"],
    tile: Tile,
    sight: Float[Array, "Z C"],
    last: Bool[Array, ""],
    width: Width,
    detection: DetectionCurves,
) -> TargetEvidence:
    """:func:`target_evidence` of one sensor; ``pixels`` is the number that a ray stands for."""
    kind, transform, signal = tile.heights.dtype, transform_of(pose), rays.signal
    noise = signal.noise
    rays, transform = transform.through(rays), transform._replace(lens=None)
    to = tile.columns[0] - pose[0], tile.columns[1] - pose[1]
    away = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2, CHORD.max() ** 2))
    foot, (low, high) = tile.ground - pose[2], _slabs(tile)
    # What is above the highest level is a slab of its own.
    low, high = jnp.concatenate([low, high[-1:]]), jnp.concatenate([high, high[-1:] + HIGHEST])
    users = detection.counted
    curves = [detection.of(signal.name)[k] for k in users]
    plan = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2, NEAR**2))
    bearing, middle = (to[0] / plan, to[1] / plan), (*to, foot + WALKER / 2)

    def counted(at: tuple[Array, Array], low: Array, high: Array) -> Float[Array, "Z C"]:
        """Returns or pixels on slabs of a face, a metre wide, between heights above the sensor; of
        a radar the strength of the echo, times the area of the face [m²]."""
        number, distance = rays_on_face(rays, transform, at, low, high)
        number *= step(jnp.asarray(rays.table.reach, kind) - distance, width)
        if signal.echo:
            return number * strength(rays, distance)
        share = jnp.asarray(pixels, kind) if noise is None else noise.share_returned(distance, jnp)
        return number * share

    def of_class(size: tuple[Array, Array]) -> tuple[Float[Array, "Z+1 C"], Float[Array, "1 C"]]:
        """Returns or pixels on a metre of a class: on slabs of its front, and above on its roof."""
        tall, chord = size
        front, back = away - chord / 2, away + chord / 2
        upright = (foot[None] + jnp.minimum(edge, tall) for edge in (low, high))
        face = counted((bearing[0] * front, bearing[1] * front), *upright) * (front / away)[None]
        top = jnp.minimum(foot + tall, 0.0) * away
        at = bearing[0] * away, bearing[1] * away
        return face, counted(at, (top / front)[None], (top / back)[None])

    tall, wide, chord = (jnp.asarray(x[users], kind) for x in (SIZES[:, 2], WIDTH, CHORD))
    # A loop, so that XLA does not count the rays on a roof again for each level.
    face, roof = (x.swapaxes(0, 1) for x in jax.lax.map(of_class, (tall, chord)))
    tall, wide = tall[:, None], wide[:, None]
    topmost = (low[:, None] < tall[None]) & (high[:, None] >= tall[None])
    inside = share_between_sides(rays, transform, middle, wide, tall)
    if signal.echo:  # all of its cross section is on its front
        on = face * (inside / tall)[None]
    else:
        on = (face + jnp.where(topmost, roof, 0.0)) * (wide * inside)[None]  # (Z + 1, K, C)
    sight *= bitmask.chances(tile.there, len(tile.heights))
    # A level that no frame shows counts for no other: below one that traffic hides all are hidden,
    # but below a crown they may be in sight.
    shown = jnp.where(sight > 0, 1.0, 0.0)[:, None]

    def chances(number: Float[Array, "K C"]) -> Float[Array, "K C"]:
        return jnp.stack([curve.chance(n) for curve, n in zip(curves, number, strict=True)])

    def add_level(state: tuple[Array, Array, Array, Array], level: tuple[Array, Array]) -> Any:
        """One level further down. Traffic hides a road user from below, so that the chance and the
        number rise by what a level adds, in the frames in which it is in sight."""
        number, before, chance, amount = state
        on, sight = level
        number += on
        now = chances(number)
        gained = (now - before) * sight[None]
        return (number, now, chance + gained, amount + on * sight[None]), None

    # Above the highest level: in a slab below others what they have, else as that level is seen.
    above = on[-1] * shown[-1]
    none = jnp.zeros_like(above)
    seen = jnp.where(last, above, none) * sight[-1][None]
    ground = counted(to, foot[None] + low[:1], foot[None] + high[:1])[0] / (high[0] - low[0])
    begin = above, jnp.where(last, none, chances(above)), none, seen
    (_, _, chance, amount), _ = jax.lax.scan(
        add_level, begin, (on[:-1] * shown, sight), reverse=True
    )
    if signal.echo:
        if tile.motion is not None:
            chance *= share_told_apart(rays, middle, tile.motion, users)
        sizes = wide, jnp.asarray(CHORD[users], kind)[:, None]
        information = radar_precision(rays, away, chance, *sizes)
    else:
        share = sight[0] * inside[-1]
        information = _information(away, foot, amount, WIDTH[users], ground, share, low[0], noise)
    return TargetEvidence(
        chance,
        none if noise is None else amount,
        _sharp(rays, transform, pixels, middle, tile, width),
        _precision(to, *information),
    )


def _slabs(tile: Tile) -> tuple[Float[Array, "Z C"], Float[Array, "Z C"]]:
    """The lower and upper edges of a tile's levels above the ground [m]."""
    middle = tile.heights - tile.ground[None]
    each = middle[1] - middle[0] if len(middle) > 1 else 2 * middle[0]
    return middle - each[None] / 2, middle + each[None] / 2


def _sharp(
    rays: Rays,
    transform: Any,
    pixels: Float[Array, ""],
    to: tuple[Array, Array, Array],
    tile: Tile,
    width: Width,
) -> Float[Array, " C"]:
    """The chance that a camera has :data:`DETECT` pixels per metre at points ``to`` from it.

    The margin [m] is how much further off that would still be so. Only the lowest slab counts it.
    """
    if not rays.signal.pictures:
        return jnp.zeros_like(to[0])
    scale, inside = scale_at(rays, transform, to)
    focal = jnp.sqrt(jnp.asarray(pixels, scale.dtype)) * rays.table.columns_per_unit
    distance = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2 + to[2] ** 2, 1e-6))
    further = distance * (scale * focal / DETECT - 1.0)
    lowest = _slabs(tile)[0][0] < (tile.heights[0] - tile.ground) / 2
    return jnp.where(lowest, step(further, width) * step(inside, width), 0.0)


def _information(
    away: Float[Array, " C"],
    foot: Float[Array, " C"],
    amount: Float[Array, "K C"],
    wide: Float[np.ndarray, " K"],
    dense: Float[Array, " C"],
    foot_seen: Float[Array, " C"],
    low: Float[Array, " C"],
    noise: LidarNoise | None,
) -> tuple[Float[Array, " C"], Float[Array, " C"]]:
    """Fisher's information of a camera or a LiDAR on a road user's place, along and across the line
    of sight in plan [1/m²], mean over classes.

    Across the line of sight, n returns or pixels lie evenly over a width w, so that their mean has
    the variance w²/(12 n). Along it, each return has the noise of range. A camera ranges by
    the pixel in which a pedestrian's foot stands on the ground: with s pixels per metre of an
    upright face, it is 1/s · d/h long there, for a camera h above and d away; and the ground is
    level to :data:`LEVEL_GROUND`. ``foot_seen``: how often the foot is in sight and in the picture.
    """
    across = (12.0 * amount / jnp.asarray(wide**2, amount.dtype)[:, None]).mean(0)
    if noise is None:
        slant = away / jnp.maximum(-foot, 0.5)
        some = jnp.maximum(dense, 1e-6)
        ranged = 1.0 / (slant * slant * (1.0 / (12.0 * some) + LEVEL_GROUND**2))
        ranged *= foot_seen * jnp.minimum(dense, 1.0)
        along = jnp.where(low < 1e-3, ranged, 0.0)
    else:
        along = amount.mean(0) / noise.range**2
    return along, across


def _precision(
    to: tuple[Float[Array, " C"], Float[Array, " C"]],
    along: Float[Array, " C"],
    across: Float[Array, " C"],
) -> Float[Array, "3 C"]:
    """Information along and across the line of sight in plan, as xx, xy and yy [1/m²]."""
    length = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2, 1e-6))
    cos, sin = to[0] / length, to[1] / length
    return jnp.stack(
        [
            along * cos * cos + across * sin * sin,
            (along - across) * cos * sin,
            along * sin * sin + across * cos * cos,
        ]
    )
