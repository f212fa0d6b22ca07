"""Metrics of what a detector gets: beyond the paper's, each from 0 to 1, higher is better.

A road user of each class stands at each column, with traffic around it. All functions but that of
redundancy give the value of each column; a metric is the mean, weighted by region as coverage is:
Σ w_l x_l / Σ w_l. What is seen is a share of frames; of several sensors it is taken as independent,
as information gain does.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from inspe_jax.core.numerics import Groups, Width, leave_one_out, step, weighted_mean, without_each
from inspe_jax.scoring.detection import DETECT, FEW
from inspe_jax.scoring.metric import Evidence, Metric, TileEvidence

SCALE = 20.0
"""A typical distance [m]: how much further off a target could be is measured from there."""
UNKNOWN = 2.0
"""Standard deviation, along x and y, of the place of an unseen road user [m]: half a lane."""


def detectability(chance: Float[Array, "R K L"], width: Width = None) -> Float[Array, "R L"]:
    """D: the chance that a road user is found, mean over classes of p_lk.

    ``chance`` is p = 1 − ∏_s (1 − p_s), with p_s that of sensor s alone. In a frame in which the
    road user is in sight from height z up, p_s = g(n(z)), with n(z) the returns or pixels on what
    is above z and g of :mod:`inspe_jax.scoring.detection`; p_s is its mean over frames.
    """
    return chance.mean(1)


def points_on_target(returns: Float[Array, "R K L"], width: Width = None) -> Float[Array, "R L"]:
    """P: the share of classes with at least :data:`FEW` LiDAR returns.

    ``returns`` n are expected numbers of all sensors together, mean over frames. The margin is how
    much further off it could stand, from :data:`SCALE` metres: n falls as the distance squared.
    """
    further = SCALE * (jnp.sqrt(jnp.maximum(returns, 1e-6) / FEW) - 1.0)
    return step(further, width).mean(1)


def pixel_density(sharp: Float[Array, "R L"], width: Width = None) -> Float[Array, "R L"]:
    """X: whether some camera has 25 pixels per metre or more.

    The task "detect" of EN 62676-4:2015, between "overview" and "outline" of 2025; here at half a
    pedestrian's height and without traffic.
    """
    return sharp


def localisation(precision: Float[Array, "R 3 L"], width: Width = None) -> Float[Array, "R L"]:
    """L = 1 − error / error before: how much of the uncertainty of a place is removed.

    The error is the root of the trace of (J₀ + J)⁻¹ (van Trees' bound), J₀ of :data:`UNKNOWN`.
    ``precision`` J, xx, xy and yy [1/m²], is the sum of the sensors' information, mean over frames.
    """
    return 1.0 - position_error(precision) / (2.0**0.5 * UNKNOWN)


def position_error(precision: Float[Array, "R 3 L"]) -> Float[Array, "R L"]:
    """The least expected error of a place in plan [m], from information xx, xy, yy [1/m²]."""
    prior = UNKNOWN**-2
    xx, xy, yy = precision[:, 0] + prior, precision[:, 1], precision[:, 2] + prior
    # The determinant of a sum of information is at least the prior's: rounding must not undo that.
    determinant = jnp.maximum(xx * yy - xy * xy, prior * (xx + yy - prior))
    return jnp.sqrt((xx + yy) / determinant)


def redundancy(twice: Float[Array, "R L"], weight: Float[Array, " L"]) -> Float[Array, " R"]:
    """R = Σ w_i P(two units or more see V_i) / Σ w_i.

    ``twice`` is that chance, as the mean over a column's levels. A unit sees a voxel in as many
    frames as that of its sensors which sees it most often: they stand at one place.
    """
    return weighted_mean(twice, weight)


def seen_twice(at: TileEvidence) -> Float[Array, "1+G C"]:
    """The chance that two units or more see each voxel, summed over the levels of a tile."""
    unit, visible = jnp.asarray(at.sensors.unit), at.visible
    number = jnp.arange(len(unit), dtype=unit.dtype)

    def unit_sees(u: Array, there: Bool[Array, " S"] | bool = True) -> Float[Array, "Z C"]:
        return jnp.where(((unit == u) & there)[:, None, None], visible, 0.0).max(0)

    def add(state: NoneOne, v: Array) -> tuple[NoneOne, NoneOne]:
        """One unit more; returns what was before it, too."""
        none, one = state
        return (none * (1.0 - v), one * (1.0 - v) + none * v), state

    each = jax.lax.map(unit_sees, number)
    nobody = jnp.ones_like(each[0]), jnp.zeros_like(each[0])
    (none, one), before = jax.lax.scan(add, nobody, each)
    twice = (1.0 - none - one).sum(0)
    if (groups := at.failures) is None:
        return twice[None]
    after = jax.lax.scan(add, nobody, each, reverse=True)[1]
    sees = (visible > 0).any((1, 2))

    def without(lost: Bool[Array, " S"]) -> Float[Array, " C"]:
        """A group that is lost belongs to one unit. One that sees nothing changes nothing."""
        u = unit[lost.argmax()]

        def with_less(lost: Array) -> Float[Array, " C"]:
            (a, b), (c, d) = ((x[0][u], x[1][u]) for x in (before, after))
            none, one = add((a * c, a * d + b * c), unit_sees(u, ~lost))[0]
            return (1.0 - none - one).sum(0)

        return jax.lax.cond((lost & sees).any(), with_less, lambda _: twice, lost)

    place = jnp.argsort(jnp.asarray(groups.order))[None]
    first, end = (jnp.asarray(x)[:, None] for x in (groups.first, groups.end))
    return jnp.concatenate([twice[None], jax.lax.map(without, (place >= first) & (place < end))])


NoneOne = tuple[Array, Array]
"""The chances that none, and that exactly one, of some units sees each voxel."""


def _totals(each: Float[Array, "S ..."], failures: Groups | None) -> Float[Array, "1+G ..."]:
    if failures is None:
        return each.sum(0)[None]
    return without_each(each, failures, jnp.add, jnp.zeros_like(each[0]))


def _row(name: str, symbol: str, summary: str, **how: Any) -> Metric:
    """A row of a metric that is computed where it is asked for, and weighs regions."""
    return Metric(name, symbol, 0.0, summary, sight=True, usual=False, by_region=True, **how)


def _of_targets(
    of_columns: Callable[[Array, Width], Float[Array, "1+G L"]],
    symbol: str,
    summary: str,
    field: str,
    fuse: Callable[[Float[Array, "S ..."], Groups | None], Float[Array, "1+G ..."]],
    submodular: bool = False,
) -> Metric:
    """The row of a metric that ``of_columns`` gives of what sensors have on road users.

    ``field`` is that of :class:`~inspe_jax.scoring.target_evidence.TargetEvidence`. Where tiles
    have whole columns, they are fused tile by tile, which is the work of all cores.
    """
    name = of_columns.__name__

    def terms(at: TileEvidence) -> Array:
        each = getattr(at.targets, field)
        return of_columns(fuse(each, at.failures), at.reading.width) if at.whole else each

    def value(found: Evidence) -> Float[Array, " 1+G"]:
        columns = found.columns(name)
        if found.slabs > 1:
            columns = of_columns(fuse(columns, found.failures), found.width)
        return weighted_mean(columns, found.weight)

    how = dict(value=value, terms=terms, targets=(field,), submodular=submodular)
    return _row(name, symbol, summary, **how)


ROWS = (
    _of_targets(
        detectability,
        "D",
        "chance that a detector finds a road user, mean over places, classes and frames",
        "chance",
        leave_one_out,
        submodular=True,
    ),
    _of_targets(
        points_on_target,
        "P",
        f"share of places where a road user gets {FEW:g} LiDAR returns or more",
        "returns",
        _totals,
    ),
    _of_targets(
        pixel_density,
        "X",
        f"share of places with {DETECT:g} pixels per metre or more, without traffic",
        "sharp",
        leave_one_out,
        submodular=True,
    ),
    _of_targets(
        localisation,
        "L",
        f"share of the error of a road user's place, {2**0.5 * UNKNOWN:.1f} m, that is removed",
        "precision",
        _totals,
    ),
    _row(
        "redundancy",
        "R",
        "share of voxels that two units or more see, behind traffic",
        value=lambda found: redundancy(found.level_means("redundancy"), found.weight),
        terms=seen_twice,
        targets=(),
    ),
)
"""The rows of the registry for these metrics."""
