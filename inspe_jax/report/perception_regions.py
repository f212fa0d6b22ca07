"""What stations tell of their sensors: the sensor information container of ETSI's collective
perception messages (TS 103 324, with the data elements of TS 102 894-2 v2.1.1), as JSON."""

from typing import Any

import numpy as np

from inspe_jax.scene.geojson import known_georeference
from inspe_jax.scene.intersection import Intersection
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec

TYPES = {"radar": 1, "lidar": 2, "camera": 3}
"""SensorType by kind; a fisheye's is 9, spherical camera, and 0 is undefined."""
FARTHEST = 4095  # of StandardLength12b, in 0.1 m


def perception_regions(layout: Layout, place: Intersection) -> list[dict[str, Any]]:
    """The sensors of each unit, which is a station, as it would send them.

    Latitude and longitude are in 1e-7 degrees, lengths in 0.1 m, coordinates east, north and up of
    the station in 0.01 m, angles in 0.1 degrees: horizontal ones clockwise from true north, from
    start to end; vertical ones upward from the horizon. Regions are cones without regard to what
    stands in the way, which ``shadowingApplies`` says. Raises InspeError if the place has no
    coordinates.
    """
    known, found = known_georeference(place), []
    for unit, members in zip(layout.units, layout.members(), strict=True):
        base = np.array(unit.base)
        lon, lat = known.to_degrees(base[None, :2])[0]
        sensors = [
            dict(
                sensorId=s,
                sensorType=_type(layout, s),
                perceptionRegionShape=_shape(layout, s, base, known.azimuth),
                shadowingApplies=True,
            )
            for s in members
        ]
        position = dict(latitude=round(1e7 * float(lat)), longitude=round(1e7 * float(lon)))
        found.append(dict(name=unit.name, referencePosition=position, sensorInformation=sensors))
    return found


def _type(layout: Layout, s: int) -> int:
    spec = layout.sensors[s].spec
    return 9 if isinstance(spec, CameraSpec) and spec.fisheye else TYPES.get(spec.kind, 0)


def _shape(layout: Layout, s: int, base: np.ndarray, azimuth: Any) -> dict[str, Any]:
    """A cylinder for what looks all round, else a cone."""
    spec, pose = layout.sensors[s].spec, np.asarray(layout.poses[s], float)
    x, y, z = np.round(100 * (pose[:3] - base)).astype(int).tolist()
    at = dict(xCoordinate=x, yCoordinate=y, zCoordinate=z)
    reach = min(round(10 * spec.grid.reach), FARTHEST)
    right, left = spec.azimuth_limits
    if left - right > 2 * np.pi - 1e-6:
        return dict(circular=dict(shapeReferencePoint=at, radius=reach))
    start, end = azimuth(np.stack([pose[:2]] * 2), pose[5] + np.array([left, right]))
    half = np.degrees(spec.field_of_view[1]) / 2
    below, above = (np.degrees(pose[4]) + side for side in (-half, half))
    turns = dict(
        stationaryHorizontalOpeningAngleStart=start,
        stationaryHorizontalOpeningAngleEnd=end,
        verticalOpeningAngleStart=below,
        verticalOpeningAngleEnd=above,
    )
    angles = {key: round(10 * float(angle)) % 3600 for key, angle in turns.items()}
    return dict(radial=dict(shapeReferencePoint=at, range=reach) | angles)
