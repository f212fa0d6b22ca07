"""The installation schedule of a layout: what is to be mounted where, and what it costs."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from inspe_jax.core.words import counted
from inspe_jax.scene.intersection import Intersection
from inspe_jax.sensing.catalogue import devices
from inspe_jax.sensing.layout import Layout, device_words, lens_keys

SAME_POLE = 1.0  # a unit this near to an existing pole is mounted on it [m]
EXISTING_POLE = "existing pole"  # what such a unit stands on, in words
ON_AXIS = 0.005  # a sensor that is nearer to the axis of its pole is on it [m]


@dataclass(frozen=True)
class SensorRow:
    """One sensor, with its ``number`` from 1 and its ``price`` [US dollars], None if unknown.
    ``position`` is x and y of its optical centre, ``height`` above the ground at its unit's base,
    ``offset`` how far it hangs from that in plan [m]. ``azimuth`` and ``offset_azimuth`` are
    clockwise from north, ``tilt`` downward, ``roll`` with its left side up [degrees]."""

    number: int
    name: str
    device: str
    title: str
    position: tuple[float, float]
    height: float
    azimuth: float
    tilt: float
    roll: float
    offset: float
    offset_azimuth: float
    price: float | None

    @property
    def on_axis(self) -> bool:
        """Whether it is on the axis of its pole."""
        return self.offset < ON_AXIS


@dataclass(frozen=True)
class UnitRow:
    """One unit: its base in the world and on the Earth, and its sensors.

    ``position`` is x, y and the height of the ground [m], of the existing pole if it is on one;
    ``degrees`` latitude and longitude, None without coordinates; ``pole`` what it stands on.
    """

    name: str
    position: tuple[float, float, float]
    degrees: tuple[float, float] | None
    pole: str
    sensors: tuple[SensorRow, ...]


@dataclass(frozen=True)
class MaterialRow:
    """A device with its varifocal lens set in one way, ``hfov_deg``: how many, on which units, and
    what one and all of them cost [US dollars]. ``maker`` is empty for a device that the layout
    itself describes; ``product`` is False for a model that nobody sells."""

    device: str
    words: str
    hfov_deg: float | None
    title: str
    maker: str
    count: int
    price: float | None
    units: tuple[str, ...]
    product: bool = True

    @property
    def total(self) -> float | None:
        """What all of them cost; None if the price is unknown."""
        return None if self.price is None else self.price * self.count


def installation_schedule(
    layout: Layout, place: Intersection, prices: Mapping[str, float]
) -> tuple[UnitRow, ...]:
    """The units of a layout, each with its sensors. Azimuths are from true north where the place
    has coordinates, and else from the y axis of the map. ``prices`` replace the catalogue's."""
    poses = np.asarray(layout.poses, float)
    bare = np.array([unit.base[:2] for unit in layout.units], float)
    feet, words = zip(*(_stand(place, foot) for foot in bare), strict=True)
    feet = np.array(feet)
    ground, azimuths = place.ground(feet), _azimuths(place, poses[:, :2], poses[:, 5])
    bases = feet[[sensor.unit for sensor in layout.sensors]]
    away = poses[:, :2] - bases
    arms = _azimuths(place, bases, np.arctan2(away[:, 1], away[:, 0]))
    degrees = None if place.georeference is None else place.georeference.to_degrees(feet)
    bought, rows = {row.device: row for row in materials(layout, prices)}, []
    for u, members in enumerate(layout.members()):
        sensors = tuple(
            SensorRow(
                number=s + 1,
                name=layout.sensors[s].name,
                device=device_words(spec := layout.sensors[s].spec),
                title=bought[spec.name].title,
                position=(float(poses[s, 0]), float(poses[s, 1])),
                height=float(poses[s, 2] - ground[u]),
                azimuth=float(azimuths[s]) % 360,
                tilt=float(-np.degrees(poses[s, 4])) + 0.0,
                roll=float(np.degrees(poses[s, 3])) + 0.0,
                offset=float(np.hypot(*away[s])),
                offset_azimuth=float(arms[s]) % 360,
                price=bought[spec.name].price,
            )
            for s in members
        )
        at = (*feet[u].tolist(), float(ground[u]))
        lat_lon = None if degrees is None else tuple(degrees[u, ::-1].tolist())
        rows.append(UnitRow(layout.units[u].name, at, lat_lon, words[u], sensors))
    return tuple(rows)


def materials(layout: Layout, prices: Mapping[str, float]) -> tuple[MaterialRow, ...]:
    """The devices of a layout, in its order, those with another lens apart. ``prices`` replace the
    catalogue's."""
    known, rows = devices(), []
    specs = {device_words(sensor.spec): sensor.spec for sensor in layout.sensors}
    for words, spec in specs.items():
        view = next((round(view, 1) for view in lens_keys(spec).values()), None)
        at = [layout.units[s.unit].name for s in layout.sensors if device_words(s.spec) == words]
        name, count = spec.name, len(at)
        units = tuple(unit for unit, _ in groupby(at))
        one = known.get(name)
        title, maker = (one.title, one.maker) if one else ("", "")
        price, product = prices.get(name, one.price_usd if one else None), not one or one.product
        rows.append(MaterialRow(name, words, view, title, maker, count, price, units, product))
    return tuple(rows)


def total_price(rows: tuple[MaterialRow, ...]) -> tuple[float | None, tuple[str, ...]]:
    """What all devices of known price cost [US dollars], None if there are none; and the others."""
    known = [row.total for row in rows if row.total is not None]
    return sum(known) if known else None, tuple(row.words for row in rows if row.total is None)


def sensors_in_words(layout: Layout) -> str:
    """How many sensors of each kind there are: ``8 cameras and 4 LiDARs``."""
    count = Counter(sensor.spec.title for sensor in layout.sensors)
    return " and ".join(counted(number, title) for title, number in count.items())


def _azimuths(place: Intersection, points: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    if place.georeference is None:
        return 90.0 - np.degrees(yaw)
    return np.asarray(place.georeference.azimuth(points, yaw))


def _stand(place: Intersection, foot: np.ndarray) -> tuple[np.ndarray, str]:
    """Where a unit stands in plan [m], and on what, in words: on the existing pole beside it, or
    where the layout has it."""
    if not len(place.poles):
        return foot, "new pole"
    away = np.hypot(*(place.poles[:, :2] - foot).T)
    if away.min() < SAME_POLE:
        return place.poles[away.argmin(), :2], EXISTING_POLE
    return foot, f"new pole, {away.min():.0f} m from the nearest"
