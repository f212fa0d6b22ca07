"""Reading signed margins, hard or soft; and numerics that need care. Geometry returns margins in
metres, positive where the statement holds; chances are combined after reading."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from inspe_jax.core.errors import InspeError
from inspe_jax.core.pytree import pytree

REACH = 3.0  # widths from the threshold at which a soft reading is certain

Width = float | Float[Array, ""] | None
"""Width of a soft reading [m]; None or a Python 0 means the exact reading."""


def exact(width: Width) -> bool:
    """Whether margins are read exactly. A traced width, whatever its value, is soft."""
    return width is None or (isinstance(width, (int, float)) and width == 0)


def step(margin: Float[Array, "*n"], width: Width = None) -> Float[Array, "*n"]:
    """1 where ``margin`` [m] is positive and 0 elsewhere; read softly, a cubic rises in between.

    With u = 1/2 + margin / (2·REACH·w), clipped to 0 … 1, and w = ``width``, it is u²(3 − 2u): of
    slope 1/(4w) at 0, as the logistic function, and certain beyond :data:`REACH` widths. Read
    exactly, a margin of 0 gives 0.
    """
    if exact(width):
        return (margin > 0).astype(margin.dtype)
    u = _risen(margin, width)
    return u * u * (3.0 - 2.0 * u)


def _risen(margin: Float[Array, "*n"], width: Width) -> Float[Array, "*n"]:
    """u of :func:`step`."""
    return jnp.clip(0.5 + margin / (2.0 * REACH * jnp.asarray(width, margin.dtype)), 0.0, 1.0)


def slope_of_step(margin: Float[Array, "*n"], width: Width) -> Float[Array, "*n"]:
    """The derivative of :func:`step` in the margin [1/m]; 0 where it is read exactly."""
    if exact(width):
        return jnp.zeros_like(margin)
    u = _risen(margin, width)
    return 3.0 * u * (1.0 - u) / (REACH * jnp.asarray(width, margin.dtype))


def certain_beyond(width: Width) -> float | Float[Array, ""]:
    """How far from the threshold [m] a reading is certain: 0 if it is exact."""
    return 0.0 if exact(width) else REACH * width  # type: ignore[operator]  # it is no None


RAYS = ("exact", "density")  # the two readings of rays; see :class:`Softness`


@pytree
@dataclass(frozen=True)
class Softness:
    """How margins are read. ``field`` and ``shadow`` are widths [m]; None, the default, is exact.

    ``field``: from the edges of a field of view and the end of its reach. ``shadow``: how far the
    sensor has to move until a sight line touches the side or the top of what hides: a vehicle, a
    body or the ground. ``rays``: ``exact``, where a voxel is in view if a ray passes through it,
    which has no slope; or ``density``, the chance of that under a random phase of the grid
    (:mod:`inspe_jax.visibility.ray_density`), which is smooth. None, the default, is ``density``
    where a width is given.

    So there are three readings, each with its limit as the widths go to 0: exact; soft with exact
    rays, which becomes the exact score; and soft with a density, which becomes its mean over phases
    of the ray grid. The last is what one width means, as ``softness=0.5``; how far P_sm is from its
    limit at 0.5 m is in ``experiments/phases.csv``, of most devices less than 0.005.
    """

    field: Width = None
    shadow: Width = None
    rays: str | None = dataclasses.field(default=None, metadata={"static": True})

    @classmethod
    def of(cls, value: Any) -> "Softness":
        """A Softness from one width [m], traced or not, or from a Softness. 0 reads exactly.

        One width is used for ``field`` and ``shadow``. Rays are a density if nothing else is said:
        as a sensor moves, its rays leave some voxels and enter others. Which ray meets which voxel
        has no useful slope; how dense rays are has one.

        Raises InspeError if a width is negative or not a finite number, or ``rays`` is unknown.

        >>> inspe_jax.Softness.of(0.5).rays
        'density'
        """
        whole = isinstance(value, Softness)
        if whole and value.rays not in (None, *RAYS):
            raise InspeError(f"rays '{value.rays}': one of {', '.join(RAYS)}")
        widths: list[Width] = []
        for width in (value.field, value.shadow) if whole else (value,):
            if width is not None and not isinstance(width, jax.core.Tracer):
                number = np.asarray(width)  # an operation of JAX would be traced under jit
                if number.dtype.kind not in "iuf" or number.ndim:
                    raise InspeError(f"softness {width!r}: a number of metres, 0 or more")
                width = float(number)
                if not 0 <= width < float("inf"):
                    raise InspeError(f"softness {width:g}: 0 (exact) or more, in metres")
            widths.append(None if exact(width) else jnp.asarray(width, float))
        soft = any(width is not None for width in widths)
        rays = (value.rays if whole else None) or ("density" if soft else "exact")
        return cls(widths[0], widths[-1], rays)

    @property
    def exact(self) -> bool:
        """Whether everything is read exactly."""
        return self.field is None and self.shadow is None and self.rays != "density"


class Groups(NamedTuple):
    """Groups of rows that are left out in turn, as arrays: one program serves any groups. A row is
    in one group at most, of number ``of``. ``order`` lists the rows group by group: group g begins
    at ``first`` and stops before ``end``. A spare group is empty: nothing is left out."""

    order: Int[Array | np.ndarray, " S"]
    of: Int[Array | np.ndarray, " S"]
    first: Int[Array | np.ndarray, " G"]
    end: Int[Array | np.ndarray, " G"]

    @classmethod
    def of_rows(
        cls, groups: Sequence[Sequence[int]], rows: int, room: int | None = None
    ) -> "Groups | None":
        """Groups of numbers of ``rows`` rows, with spare ones up to ``room``; None without any."""
        if not groups:
            return None
        listed = [row for group in groups for row in group]
        order = listed + sorted(set(range(rows)) - set(listed))
        of, ends = np.zeros(rows, np.int32), np.cumsum([0, *map(len, groups)])
        for number, group in enumerate(groups):
            of[list(group)] = number
        spare = (room or len(groups)) - len(groups)
        return cls(
            np.array(order, np.int32),
            of,
            np.array([*ends[:-1], *[rows] * spare], np.int32),
            np.array([*ends[1:], *[rows] * spare], np.int32),
        )


def without_each(
    rows: Shaped[Array, "S ..."],
    groups: Groups,
    both: Callable[[Array, Array], Array],
    nothing: Shaped[Array, "..."],
) -> Shaped[Array, "1+G ..."]:
    """All rows combined by ``both``, whose neutral element is ``nothing``, and for each group all
    rows outside it: what comes before it with what comes after it, without an inverse."""

    def combine(total: Array, row: Array) -> tuple[Array, Array]:
        total = both(total, row)
        return total, total

    rows = rows[groups.order]
    whole, before = jax.lax.scan(combine, nothing, rows)
    after = jax.lax.scan(combine, nothing, rows, reverse=True)[1]
    before = jnp.concatenate([nothing[None], before])
    after = jnp.concatenate([after, nothing[None]])
    return jnp.concatenate([whole[None], both(before[groups.first], after[groups.end])])


def leave_one_out(p: Float[Array, "S ..."], groups: Groups | None) -> Float[Array, "1+G ..."]:
    """Chance that some reading holds, 1 − ∏(1 − p): of all rows in row 0, of all but group g in row
    1 + g. It is exactly 0 or 1 if every p is 0 or 1."""
    if groups is None:
        return 1.0 - jnp.prod(1.0 - p, axis=0)[None]
    return 1.0 - without_each(1.0 - p, groups, jnp.multiply, jnp.ones_like(p[0]))


def dot(x: Float[Array, "... V"], y: Float[Array, " V"]) -> Float[Array, "..."]:
    """Σ x·y along the last axis, in three levels of partial sums: of a million numbers in single
    precision, the error is 1e-6, not 1e-4. Barriers keep XLA from merging the sums."""
    n = y.shape[-1]
    block = max(1, round(n ** (1 / 3)))
    room = block * block * max(1, -(-n // (block * block)))
    x = jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, room - n)])
    y = jnp.pad(y, (0, room - n)).reshape(-1, block, block)
    x = x.reshape(*x.shape[:-1], -1, block, block)
    total = (x * y.reshape((1,) * (x.ndim - 3) + y.shape)).sum(-1)
    for _ in range(2):
        total = jax.lax.optimization_barrier(total).sum(-1)
    return total


def weighted_mean(x: Float[Array, "... V"], weight: Float[Array, " V"]) -> Float[Array, "..."]:
    """Σ w·x / Σ w along the last axis."""
    return dot(x, weight) / dot(jnp.ones_like(x), weight)


def nonzero(x: Float[Array, "*n"], least: float = 1e-6) -> Float[Array, "*n"]:
    """``x`` moved to at least ``least`` from zero, with its sign: a safe denominator."""
    return jnp.where(jnp.abs(x) < least, jnp.where(x < 0, -least, least), x)


_ARCTAN = (
    1.0, -0.3333314528, 0.1999355085, -0.1420889944, 0.1065626393, -0.0752896400, 0.0429096138,
    -0.0161657367, 0.0028662257,
)  # fmt: skip


def arctan2(y: Float[Array, "*n"], x: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Angle of (x, y) [rad], to 2e-7, with its derivative 0 at the origin (Abramowitz and Stegun,
    4.4.49). Some forty times faster than the C library's, which XLA calls point by point on a
    CPU."""
    a, b = jnp.abs(x), jnp.abs(y)
    larger = jnp.maximum(a, b)
    t = jnp.minimum(a, b) / jnp.where(larger > 0, larger, 1.0)
    series = jnp.full_like(t, _ARCTAN[-1])
    for coefficient in _ARCTAN[-2::-1]:
        series = series * (t * t) + coefficient
    angle = jnp.where(b > a, np.pi / 2 - t * series, t * series)
    angle = jnp.where(x < 0, np.pi - angle, angle)
    return jnp.where(y < 0, -angle, angle)
