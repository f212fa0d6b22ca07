"""What mounting allows: heights, clearance over lanes, angles and places."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from shapely.geometry.base import BaseGeometry

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.mounting.site import CENTRAL_HEIGHTS, POLE_HEIGHTS
from inspe_jax.sensing.kinds import SENSOR_KINDS
from inspe_jax.sensing.layout import UNIT_HEIGHT

PLACES = {
    "any": (True, True),
    "areas": (True, False),
    "poles": (False, True),
    "keep": (False, False),
}
"""Where units may stand: whether in mounting areas, and whether on poles."""


def default_pitch() -> dict[str, tuple[float, float]]:
    """Lowest and highest pitch [rad] that a mount allows, by kind of sensor."""
    limits = {kind: keys.spec_type.pitch_limits_deg for kind, keys in SENSOR_KINDS.items()}
    return {
        kind: (float(np.radians(low)), float(np.radians(high)))
        for kind, (low, high) in limits.items()
    }


@dataclass(frozen=True)
class Constraints:
    """What mounting allows, in metres and radians.

    ``heights`` are the lowest and highest height of a sensor above the ground at its unit's foot.
    ``span_heights`` are those of sensors on a span wire: the unit's foot is then in the middle of
    the junction, and stays there. A sensor lower than ``clearance`` may not hang over a lane; a
    search also keeps it up to 0.3 m away from the lane. ``pitch`` gives (from, to) by kind of
    sensor; a kind that is not named has its own. ``yaw`` gives (from, to), counter-clockwise, by
    name of sensor; a sensor that is not named may look in any direction.

    ``places`` is one of :data:`PLACES`, for all units or by name of unit; a unit that is not named
    has "any". With "poles" a unit stands on one of the poles, with "areas" anywhere in the mounting
    areas, with "keep" where it is. ``area``, a shapely polygon in world metres, replaces the map's
    mounting area.

    >>> limits = inspe_jax.Constraints(heights=(4.0, 8.0), places="poles")
    >>> limits.heights, limits.clearance
    ((4.0, 8.0), 5.0)
    """

    heights: tuple[float, float] = POLE_HEIGHTS
    span_heights: tuple[float, float] = CENTRAL_HEIGHTS
    clearance: float = 5.0
    pitch: Mapping[str, tuple[float, float]] = field(default_factory=default_pitch)
    yaw: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    places: str | Mapping[str, str] = "any"
    area: BaseGeometry | None = None

    def __post_init__(self) -> None:
        """Kinds of sensor without a pitch have their usual one."""
        object.__setattr__(self, "pitch", default_pitch() | dict(self.pitch))

    def check(self) -> None:
        """Raise InspeError if a value is unknown, out of range or contradicts another.

        >>> inspe_jax.Constraints(heights=(8.0, 4.0)).check()
        Traceback (most recent call last):
            ...
        inspe_jax.core.errors.InspeError: heights 8 to 4 m: give 0 or more, the lower first
        """
        for places in [self.places] if isinstance(self.places, str) else self.places.values():
            check_known(places, PLACES, "places")
        for name in ("heights", "span_heights"):
            low, high = getattr(self, name)
            if not 0 <= low <= high < np.inf:
                raise InspeError(f"{name} {low:g} to {high:g} m: give 0 or more, the lower first")
            # Otherwise raising a sensor over a lane could break the unit rule; see Space._sensors.
            most = min(high, low + UNIT_HEIGHT)
            if not 0 <= self.clearance <= most:
                raise InspeError(
                    f"clearance {self.clearance:g} m: must be from 0 to {most:g} m where {name} "
                    f"are {low:g} to {high:g} m"
                )
        for kind, (low, high) in self.pitch.items():
            check_known(kind, SENSOR_KINDS, "pitch of kind")
            if not -np.pi / 2 <= low <= high <= np.pi / 2:
                raise InspeError(
                    f"pitch of {kind} {np.degrees(low):g}° to {np.degrees(high):g}°: "
                    "give the lower first, within −90° to 90°"
                )
        for name, (low, high) in self.yaw.items():
            if not 0 <= high - low <= 2 * np.pi or abs(low) > 2 * np.pi:
                raise InspeError(
                    f"yaw of '{name}' {np.degrees(low):g}° to {np.degrees(high):g}°: give a start "
                    "within −360° to 360° and an end up to one turn counter-clockwise of it"
                )
        if self.area is not None and (not self.area.is_valid or self.area.area <= 0):
            raise InspeError("area: not a valid polygon with an area")

    def places_of(self, unit: str) -> str:
        """Where one unit may stand, one of :data:`PLACES`.

        >>> limits = inspe_jax.Constraints(places={"corner 1": "poles"})
        >>> limits.places_of("corner 1"), limits.places_of("corner 2")
        ('poles', 'any')
        """
        return self.places if isinstance(self.places, str) else self.places.get(unit, "any")
