"""The coordinates of a search, and their limits: discs about feet and mast heads, and intervals.
Where a foot may stand is for :mod:`inspe_jax.placement.space`. ``xp`` is NumPy or JAX."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from inspe_jax.placement.convex_regions import INSIDE, from_bounded, to_bounded, turns

STEPS = dict(base=5.0, arm=0.5, height=2.0, offset=0.5, rise=1.0, yaw=np.pi / 4, pitch=np.pi / 18,
             lens=0.25)  # fmt: skip
"""A typical step of each coordinate [m or rad]; of a lens in the logarithm of its focal length."""
PLANE = ("base", "arm", "offset")
"""Coordinates that come in pairs, x and y."""

_TOWARDS = np.radians(60.0)  # half of the random yaws are this near to the centre's direction
_DOWNWARD = np.radians([-40.0, -5.0])  # random pitch of sensors that are aimed
_LEVEL = np.radians([-10.0, 10.0])  # … and of the others


class Coordinates(NamedTuple):
    """The variables of a search, in metres about the scene's centre and radians.

    Of units: the ``base`` is the foot, ``arm`` leads from there to the mast head, ``height`` is
    that of the head above the ground at the foot. Of sensors: ``offset`` and ``rise`` lead there
    from the head, 0 for a unit's only sensor; ``lens`` is the logarithm of the focal length, in
    times the usual one.
    """

    base: Float[Any, "U 2"]
    arm: Float[Any, "U 2"]
    height: Float[Any, " U"]
    offset: Float[Any, "S 2"]
    rise: Float[Any, " S"]
    yaw: Float[Any, " S"]
    pitch: Float[Any, " S"]
    lens: Float[Any, " S"]

    def flat(self, xp: Any = np) -> Float[Any, " N"]:
        """All coordinates in one array, in the order of the fields."""
        return xp.concatenate([part.reshape(-1) for part in self])

    @classmethod
    def split(cls, x: Float[Any, " N"], units: int, sensors: int) -> "Coordinates":
        """The coordinates in a flat array of 5·units + 6·sensors numbers."""
        sizes = [2 * units, 2 * units, units, 2 * sensors, *[sensors] * 4]
        ends = np.cumsum(sizes).tolist()
        parts = [x[end - n : end] for end, n in zip(ends, sizes, strict=True)]
        named = zip(cls._fields, parts, strict=True)
        return cls(*(part.reshape(-1, 2) if name in PLANE else part for name, part in named))


class Range(NamedTuple):
    """Intervals from ``low`` to ``high``, one for each element."""

    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]

    @property
    def middle(self) -> Float[np.ndarray, " n"]:
        """The middle of each interval."""
        return (self.low + self.high) / 2

    @property
    def half(self) -> Float[np.ndarray, " n"]:
        """Half the length of each interval."""
        return (self.high - self.low) / 2

    def clip(self, x: Any, xp: Any) -> Any:
        """The nearest values within the intervals."""
        return xp.clip(x, xp.asarray(self.low, x.dtype), xp.asarray(self.high, x.dtype))

    def to_bounded(self, v: Any, xp: Any) -> Any:
        """Values within the intervals, from any numbers, as by :func:`to_bounded`."""
        return xp.asarray(self.middle, v.dtype) + to_bounded(v, xp.asarray(self.half, v.dtype), xp)

    def from_bounded(self, x: Any, xp: Any) -> Any:
        """The inverse of :meth:`to_bounded`."""
        return from_bounded(x - self.middle, self.half, xp)


class Disc(NamedTuple):
    """Discs about 0 with the radii ``half`` (n,); methods as of :class:`Range`, along each ray."""

    half: Float[np.ndarray, " n"]

    def clip(self, x: Any, xp: Any) -> Any:
        """The nearest points (n, 2) of the discs."""
        return x * xp.minimum(1.0, xp.asarray(self.half, x.dtype)[..., None] / _length(x, xp))

    def to_bounded(self, v: Any, xp: Any) -> Any:
        """Points of the discs, from any points (n, 2)."""
        radius = xp.asarray(self.half, v.dtype)[..., None]
        w = turns(v, radius, xp)
        length = _length(w, xp)
        return radius * w * xp.sin(length) / length

    def from_bounded(self, x: Any, xp: Any) -> Any:
        """The inverse of :meth:`to_bounded`; the rim counts as slightly inside."""
        w = x / xp.where(self.half > 0, self.half, xp.ones_like(self.half))[..., None]
        length = _length(w, xp)
        inside = xp.arcsin(xp.minimum(length, INSIDE))
        return xp.asarray(self.half)[..., None] * w * inside / length


def _length(x: Any, xp: Any) -> Any:
    # Never 0, where a norm has no gradient. The ratios formed with it are right at 0.
    return xp.sqrt(xp.maximum((x * x).sum(-1, keepdims=True), 1e-12))


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Limits:
    """The limits of all coordinates except ``base``; ``sector`` (S,): whose yaw is limited,
    ``aimed`` (S,): which are usually aimed down, as cameras."""

    arm: Disc
    height: Range
    offset: Disc
    rise: Range
    yaw: Range
    pitch: Range
    lens: Range
    sector: Bool[np.ndarray, " S"]
    aimed: Bool[np.ndarray, " S"]

    def clip(self, c: Coordinates, xp: Any) -> Coordinates:
        """The nearest coordinates within the limits. A yaw keeps its number of turns."""
        turned = nearest_turn(c.yaw, xp.asarray(self.yaw.middle, c.yaw.dtype), xp)
        back = self.yaw.clip(turned, xp) - turned
        yaw = c.yaw + xp.where(xp.asarray(self.sector), back, xp.zeros_like(back))
        return self._each("clip", c, yaw, xp)

    def to_bounded(self, v: Coordinates, xp: Any) -> Coordinates:
        """Coordinates within the limits, from any ``v``; in the middle they move as ``v`` does."""
        yaw = xp.where(xp.asarray(self.sector), self.yaw.to_bounded(v.yaw, xp), v.yaw)
        return self._each("to_bounded", v, yaw, xp)

    def from_bounded(self, c: Coordinates) -> Coordinates:
        """The inverse of :meth:`to_bounded`; a coordinate on a limit counts as slightly inside."""
        turned = nearest_turn(c.yaw, self.yaw.middle, np)
        yaw = np.where(self.sector, self.yaw.from_bounded(turned, np), c.yaw)
        return self._each("from_bounded", c, yaw, np)

    def _each(self, method: str, c: Coordinates, yaw: Any, xp: Any) -> Coordinates:
        names = ("arm", "height", "offset", "rise", "pitch", "lens")
        parts = {name: getattr(getattr(self, name), method)(getattr(c, name), xp) for name in names}
        return c._replace(yaw=yaw, **parts)

    def draw(
        self, rng: np.random.Generator, base: Float[np.ndarray, "M U 2"], unit: np.ndarray
    ) -> list[Coordinates]:
        """Random coordinates within the limits, one for each row of feet, spread evenly. Sensors
        that are aimed look down by 5° to 40°, others are level to within 10°; half of all look
        within 60° of the centre, half in any direction."""
        count = len(base)

        def even(limits: Range) -> np.ndarray:
            return rng.uniform(limits.low, limits.high, (count, len(limits.low)))

        def disc(radius: np.ndarray) -> np.ndarray:
            angle = rng.uniform(-np.pi, np.pi, (count, len(radius)))
            far = radius * np.sqrt(rng.uniform(size=angle.shape))
            return far[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)

        usual = np.where(self.aimed[:, None], _DOWNWARD, _LEVEL)
        low, high = self.pitch.clip(usual[:, 0], np), self.pitch.clip(usual[:, 1], np)
        inward = np.arctan2(*np.moveaxis(-base[:, unit], -1, 0)[::-1])
        anywhere = even(self.yaw)
        aimed = inward + rng.uniform(-_TOWARDS, _TOWARDS, anywhere.shape)
        aimed = nearest_turn(aimed, self.yaw.middle, np)
        may = (aimed >= self.yaw.low) & (aimed <= self.yaw.high)
        yaw = np.where(may & (rng.uniform(size=may.shape) < 0.5), aimed, anywhere)
        parts = (
            base,
            disc(self.arm.half),
            even(self.height),
            disc(self.offset.half),
            even(self.rise),
        )
        pitch = rng.uniform(low, high, (count, len(low)))
        rows = zip(*parts, yaw, pitch, even(self.lens), strict=True)
        return [Coordinates(*row) for row in rows]


def nearest_turn(angle: Any, about: Any, xp: Any) -> Any:
    """The angle of the same direction that is nearest to ``about`` [rad]."""
    return angle - 2 * np.pi * xp.round((angle - about) / (2 * np.pi))
