"""Brackets: sensors hang beside a pole that stands in the scene, never within it.

A pole that is one of the scene's bodies hides what is behind it, also from the sensors that it
carries: one of 0.2 m hides 29° of a sensor 0.4 m from its axis. A sensor that is aimed hangs on the
side that it looks to; another hangs towards the middle of the junction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.scene.statics import StaticBody

STANDOFF = 0.3
"""Length of a bracket, from the surface of a pole to a sensor [m]."""
NEAREST = 0.2
"""No sensor is nearer to the surface of a pole [m]: half a housing and what holds it."""
THICKEST = 0.5
"""Largest radius of a pole that carries sensors [m]."""
AT_AXIS = 0.02
"""A unit whose foot is this near to the axis of a pole is on it [m]."""


def pole_radius(pole: StaticBody) -> float:
    """Radius of a pole at its corners [m]."""
    return float(np.hypot(*(pole.outline - pole.middle).T).max())


def bracket_length(pole: StaticBody) -> float:
    """From the axis of a pole to a sensor that hangs on it [m]."""
    return pole_radius(pole) + STANDOFF


def separate(poles: Sequence[StaticBody]) -> tuple[StaticBody, ...]:
    """The poles that are far enough from each other, and thin enough, to carry sensors."""
    thin = [pole for pole in poles if pole_radius(pole) <= THICKEST]
    reach = np.array([2 * (pole_radius(pole) + NEAREST) for pole in thin])
    at = np.array([pole.middle for pole in thin]).reshape(-1, 2)
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1)) + 1e9 * np.eye(len(at))
    free = (apart > reach[:, None] + reach[None]).all(1)
    return tuple(pole for pole, alone in zip(thin, free, strict=True) if alone)


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Brackets:
    """The poles (P,) that carry sensors: each ``axis`` about the scene's centre, and the distance
    from there that a sensor keeps at ``least`` [m].

    Coordinates know no poles: in them a sensor may be anywhere about its foot. What is nearer to an
    axis than twice ``least`` is moved away from it, so that all is outside and each place is that
    of one point: r becomes least + r / 2.
    """

    axis: Float[np.ndarray, "P 2"]
    least: Float[np.ndarray, " P"]

    @classmethod
    def of(cls, poles: Sequence[StaticBody], center: Float[np.ndarray, "2"]) -> "Brackets":
        """Those of the poles of a site (:attr:`~inspe_jax.placement.site.Site.carriers`)."""
        axis = np.array([pole.middle - center for pole in poles], float).reshape(-1, 2)
        return cls(axis, np.array([pole_radius(pole) + NEAREST for pole in poles], float))

    def __bool__(self) -> bool:
        return len(self.axis) > 0

    def within(self, plan: float) -> float:
        """How far from each other coordinates may have sensors of a unit, so that all are within
        ``plan`` [m] of each other and of their foot once they hang on brackets.

        Two points r and s from an axis that are d apart come to be 2 least + (r + s) / 2 apart at
        most, or d where both are far out.
        """
        if not self:
            return plan
        return float(min(plan, 2 * plan - 4 * self.least.max())) - 2 * _OUT

    def hung(
        self,
        foot: Float[Any, "S 2"],
        out: Float[Any, "S 2"],
        yaw: Float[Any, " S"],
        aimed: np.ndarray,
        xp: Any,
    ) -> Float[Any, "S 2"]:
        """Places of sensors whose coordinates are ``out`` from the ``foot`` of their unit.

        With 0, a sensor hangs at the end of a bracket of the usual length.
        """
        at = foot + out + self._way(foot, yaw, aimed, xp)
        pole, away, off = self._nearest(at, xp)
        least = xp.asarray(self.least, at.dtype)[pole]
        further = xp.maximum(least - away / 2, 0.0)
        return at + (further / away)[:, None] * off

    def out(
        self,
        foot: Float[np.ndarray, "S 2"],
        at: Float[np.ndarray, "S 2"],
        yaw: Float[np.ndarray, " S"],
        aimed: np.ndarray,
    ) -> Float[np.ndarray, "S 2"]:
        """The inverse of :meth:`hung`. A sensor nearer to an axis than allowed is at 0."""
        pole, away, off = self._nearest(at, np)
        least = self.least[pole]
        before = np.where(away < 2 * least, 2 * (away - least), away)
        point = at + ((before - away) / away)[:, None] * off
        found = point - foot - self._way(foot, yaw, aimed, np)
        return np.where((away < least - _ROUNDING)[:, None], 0.0, found)

    def _way(self, foot: Any, yaw: Any, aimed: np.ndarray, xp: Any) -> Any:
        """What is added to the coordinates of a sensor on a pole, so that 0 is on its bracket."""
        pole, away, _ = self._nearest(foot, xp)
        inward = xp.asarray(np.arctan2(*-self.axis.T[::-1]), yaw.dtype)[pole]
        way = xp.where(xp.asarray(aimed), yaw, inward)
        length = xp.where(away <= AT_AXIS, xp.asarray(_OUT, yaw.dtype), xp.zeros_like(away))
        return length[:, None] * xp.stack([xp.cos(way), xp.sin(way)], -1)

    def _nearest(self, at: Any, xp: Any) -> tuple[Any, Any, Any]:
        """The nearest pole of each point, its distance (never 0), and the way from its axis."""
        off = at[:, None] - xp.asarray(self.axis, at.dtype)[None]
        away = xp.sqrt(xp.maximum((off * off).sum(-1), 1e-12))  # a norm has no gradient at 0
        pole = away.argmin(-1)
        row = xp.arange(len(pole))
        return pole, away[row, pole], off[row, pole]


_OUT = 2 * (STANDOFF - NEAREST)  # becomes a bracket's length
_ROUNDING = 1e-3  # of a sensor's place [m]
