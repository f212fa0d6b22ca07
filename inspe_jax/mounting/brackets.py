"""Brackets: sensors hang beside a pole that stands in the scene, never within it: on the side that
they look to, if aimed, else towards the middle. A pole of 0.2 m hides 29° of one 0.4 m away."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.scene.statics import StaticBody

STANDOFF = 0.3  # from a pole's surface to a sensor, at least: a bracket and half a housing [m]
THICKEST = 0.5  # largest radius of a pole that carries sensors [m]
AT_AXIS = 0.02  # a unit whose foot is this near to the axis of a pole is on it [m]
_LEAST = 5e-4  # a point this near to an axis in coordinates has no direction from there [m]


def pole_radius(pole: StaticBody) -> float:
    """Radius of a pole at its corners [m]."""
    return float(np.hypot(*(pole.outline - pole.middle).T).max())


def bracket_length(pole: StaticBody) -> float:
    """From the axis of a pole to a sensor that hangs on it [m]."""
    return pole_radius(pole) + STANDOFF


def separate(poles: Sequence[StaticBody]) -> tuple[StaticBody, ...]:
    """The poles that are far enough from each other, and thin enough, to carry sensors."""
    thin = [pole for pole in poles if pole_radius(pole) <= THICKEST]
    reach = np.array([2 * bracket_length(pole) for pole in thin])
    at = np.array([pole.middle for pole in thin]).reshape(-1, 2)
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1)) + 1e9 * np.eye(len(at))
    free = (apart > reach[:, None] + reach[None]).all(1)
    return tuple(pole for pole, alone in zip(thin, free, strict=True) if alone)


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Brackets:
    """The poles (P,) that carry sensors: each ``axis`` about the scene's centre, and the ``length``
    of its brackets from there [m].

    A point in coordinates at r < 2 lengths from an axis is a position at ``length + r / 2``, in the
    same direction; one on the axis is the end of the usual bracket. Points farther out do not move.
    """

    axis: Float[np.ndarray, "P 2"]
    length: Float[np.ndarray, " P"]

    @classmethod
    def of(cls, poles: Sequence[StaticBody], center: Float[np.ndarray, "2"]) -> "Brackets":
        """Those of the poles of a site (:attr:`~inspe_jax.mounting.site.Site.carriers`)."""
        axis = np.array([pole.middle - center for pole in poles], float).reshape(-1, 2)
        return cls(axis, np.array([bracket_length(pole) for pole in poles], float))

    def __bool__(self) -> bool:
        return len(self.axis) > 0

    def largest_offset(self, plan: float) -> float:
        """How far points of a unit may be apart, for their positions to be within ``plan`` [m].

        Two points d apart, r and s from an axis, become positions that are at most d + max(0,
        length − r/2) + max(0, length − s/2) apart, and r + s ≥ d: at most d + length where one is
        far out, and d/2 + 2 length where neither is.
        """
        longest = float(self.length.max(initial=0.0))
        return min(plan - longest, 2 * plan - 4 * longest)

    def positions(
        self, points: Float[Any, "S 2"], yaw: Float[Any, " S"], aimed: np.ndarray, xp: Any
    ) -> Float[Any, "S 2"]:
        """The positions of sensors from their points in coordinates."""
        pole, away, off = self._nearest(points, xp)
        length = xp.asarray(self.length, points.dtype)[pole]
        direction = xp.where(
            (away < _LEAST)[:, None],
            self._usual(pole, yaw, aimed, xp),
            off / xp.maximum(away, _LEAST)[:, None],
        )
        return points + xp.maximum(length - away / 2, 0.0)[:, None] * direction

    def points(
        self, positions: Float[np.ndarray, "S 2"], yaw: Float[np.ndarray, " S"], aimed: np.ndarray
    ) -> Float[np.ndarray, "S 2"]:
        """The inverse of :meth:`positions`; what is too near to an axis is moved out."""
        pole, away, off = self._nearest(positions, np)
        length, axis = self.length[pole], self.axis[pole]
        usual = axis + length[:, None] * self._usual(pole, yaw, aimed, np)
        on_usual = (np.hypot(*(positions - usual).T) < _LEAST) | (away < _LEAST)
        before = np.where(on_usual, 0.0, np.maximum(2 * (away - length), 2 * _LEAST))
        point = axis + (before / away)[:, None] * off
        return np.where((away < 2 * length)[:, None], point, positions)

    def _usual(self, pole: Any, yaw: Any, aimed: np.ndarray, xp: Any) -> Any:
        """The direction of each sensor's usual bracket: as it looks, or to the centre."""
        inward = xp.asarray(np.arctan2(*-self.axis.T[::-1]), yaw.dtype)[pole]
        way = xp.where(xp.asarray(aimed), yaw, inward)
        return xp.stack([xp.cos(way), xp.sin(way)], -1)

    def _nearest(self, at: Any, xp: Any) -> tuple[Any, Any, Any]:
        """The pole of each point, its distance (never 0), and the way from its axis."""
        off = at[:, None] - xp.asarray(self.axis, at.dtype)[None]
        away = xp.sqrt(xp.maximum((off * off).sum(-1), 1e-12))  # a norm has no gradient at 0
        pole = (away - 2 * xp.asarray(self.length, at.dtype)[None]).argmin(-1)
        row = xp.arange(len(pole))
        return pole, away[row, pole], off[row, pole]
