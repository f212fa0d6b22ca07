"""What a radar finds of a road user: by the strength of its echo, its speed and its neighbours.

1. By the radar equation, power falls as range to the fourth. n = share · (R₀/R)⁴ is the power from
   a road user over that from a car at R₀, the range of the data sheet; ``share`` is how much of the
   road user is in the beam and in sight. The curves ``radar`` of ``detection.toml`` give the chance
   that so strong an echo is found, by class.
2. What stands, and what moves across the line of sight, has no Doppler and is lost among what
   stands. A share m of a class moves, with radial speeds that are normal with the variance
   s² = uᵀ⟨v vᵀ⟩u along the unit vector u; ⟨v vᵀ⟩ is of traffic about the column
   (:mod:`inspe_jax.visibility.motion`). One is faster than v₀ with m · erfc(v₀ / (√2 s)).
3. Others in the same cell of range, azimuth and radial speed make one echo with it. Their number N
   has Poisson's distribution about λ, density · Δr · r Δα · m · erf(Δv / (2 s)); the one echo
   belongs to each of them alike: E[1 / (1 + N)] = (1 − e^−λ) / λ.

2 and 3 are means over traffic, not frame by frame. Beside the frames of ``four_way``, looked at one
by one from a corner, 2 is low: 0.49 of all road users in place of 0.54 for v₀ = 0.12 m/s, since
where all drive alike their speeds are not normal about 0; of pedestrians for v₀ = 1 m/s 0.27 in
place of 0.57. 3 takes road users as points that may be at one place: 0.994 in place of 0.997 in
cells of 4 m by 6° by 0.5 m/s; without Doppler, where bodies keep apart, 0.86 in place of 0.99.
"""

import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf, erfc
from jaxtyping import Array, Float

from inspe_jax.core.geometry import Point
from inspe_jax.sensing.rays import Rays
from inspe_jax.visibility.motion import Motion

SLOWEST = 1e-3
"""Radial speeds vary by at least this [m/s], so that a slope is finite straight across."""
_ALONE = 1e-3  # fewer neighbours than this are counted to first order


def strength(rays: Rays, distance: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """What a ray that meets a road user at a distance [m] adds to n, times the road user's area
    [m²]: each ray stands for one solid angle."""
    table = rays.table
    low, high = table.outer.row_turn[1]
    steradians = table.column_step * (high - low) / jnp.asarray(table.row_count, distance.dtype)
    return steradians * jnp.asarray(table.reach, distance.dtype) ** 4 / distance**2


def share_told_apart(
    rays: Rays, to: Point, motion: Motion, users: list[int]
) -> Float[Array, "K C"]:
    """The chance that a road user moves fast enough along the line of sight, and that its echo is
    its own.

    Args:
        rays: The radar's.
        to: Places from the sensor [m].
        motion: Of all classes at these places.
        users: The classes that are wanted.
    """
    rest = jnp.asarray(rays.table.own, to[0].dtype)
    deep, wide, step, least = rest[0], rest[1], rest[2], rest[3]
    distance = jnp.sqrt(jnp.maximum(to[0] ** 2 + to[1] ** 2 + to[2] ** 2, 1e-6))
    x, y = (to[0] / distance)[None], (to[1] / distance)[None]
    moving, spread = (jnp.asarray(of[np.array(users)]) for of in (motion.moving, motion.spread))
    variance = spread[:, 0] * x * x + 2 * spread[:, 1] * x * y + spread[:, 2] * y * y
    speed = jnp.sqrt(jnp.maximum(variance, SLOWEST**2))
    doppler = least > 0
    found = jnp.where(doppler, moving * erfc(least / (2.0**0.5 * speed)), 1.0)
    alike = jnp.where(doppler, moving, 1.0) * erf(step / (2.0 * speed))
    others = (motion.density * deep * wide * distance)[None] * alike
    many = jnp.maximum(others, _ALONE)
    return found * jnp.where(others > _ALONE, -jnp.expm1(-many) / many, 1.0 - others / 2)


def radar_precision(
    rays: Rays,
    distance: Float[Array, " C"],
    chance: Float[Array, "K C"],
    wide: Float[Array, "K 1"],
    chord: Float[Array, "K 1"],
) -> tuple[Float[Array, " C"], Float[Array, " C"]]:
    """Fisher's information along and across the line of sight [1/m²], mean over classes.

    One echo comes from anywhere in its cell and from anywhere on the road user, evenly: along, its
    variance is (Δr² + depth²) / 12, and across (r² Δα² + width²) / 12. It is there with ``chance``.
    """
    deep, angle = rays.table.own[0], rays.table.own[1]
    along = 12.0 * chance / (deep**2 + chord**2)
    across = 12.0 * chance / ((distance * angle)[None] ** 2 + wide**2)
    return along.mean(0), across.mean(0)
