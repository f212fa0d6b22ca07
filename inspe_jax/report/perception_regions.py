"""What stations tell of their sensors: the sensor information container of ETSI's collective
perception messages (TS 103 324, with the data elements of TS 102 894-2 v2.1.1), as JSON."""

from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.geometry import rotation
from inspe_jax.scene.geojson import known_georeference
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Intersection
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.lens import rim
from inspe_jax.sensing.sensors import CameraSpec, Spec

TYPES = {"radar": 1, "lidar": 2, "camera": 3, "thermal": 5}
"""SensorType by kind, of a thermal camera night vision; 0 is undefined."""
SPHERICAL = 9  # of a fisheye
ALL_ROUND = np.radians(10)  # a gap between rays in plan that is no side without view
FARTHEST = 4095  # of StandardLength12b, in 0.1 m


def perception_regions(layout: Layout, place: Intersection) -> list[dict[str, Any]]:
    """The sensors of each unit, which is a station, as it would send them.

    Latitude and longitude are in 1e-7 degrees, lengths in 0.1 m, coordinates true east, north and
    up of the station in 0.01 m, angles in 0.1 degrees: horizontal ones clockwise from true north,
    from start to end; vertical ones upward from the horizon. A region is what a sensor looks at
    without regard to what stands in the way, which ``shadowingApplies`` says: a cylinder if it
    looks all round, else a cone. Raises InspeError if the place has no coordinates.
    """
    known, poses, found = known_georeference(place), np.asarray(layout.poses, float), []
    for unit, members in zip(layout.units, layout.members(), strict=True):
        base = np.array(unit.base)
        lon, lat = known.to_degrees(base[None, :2])[0]
        sensors = []
        for s in members:
            spec, away = layout.sensors[s].spec, poses[s, :3] - base
            (bearing,) = np.radians(known.azimuth(base[None, :2], np.arctan2([away[1]], [away[0]])))
            flat = np.hypot(*away[:2])
            offset = flat * np.sin(bearing), flat * np.cos(bearing), away[2]
            x, y, z = (round(100 * float(part)) for part in offset)
            fisheye = isinstance(spec, CameraSpec) and bool(spec.fisheye)
            sensors.append(
                dict(
                    sensorId=s,
                    sensorType=SPHERICAL if fisheye else TYPES.get(spec.kind, 0),
                    perceptionRegionShape=_shape(
                        spec, poses[s], dict(xCoordinate=x, yCoordinate=y, zCoordinate=z), known
                    ),
                    shadowingApplies=True,
                )
            )
        position = dict(latitude=round(1e7 * float(lat)), longitude=round(1e7 * float(lon)))
        found.append(dict(name=unit.name, referencePosition=position, sensorInformation=sensors))
    return found


def _shape(
    spec: Spec, pose: Float[np.ndarray, "6"], at: dict[str, int], known: Georeference
) -> dict[str, Any]:
    """Of the rays at the rim of what a sensor looks at, turned as it hangs."""
    reach = min(round(10 * spec.grid.reach), FARTHEST)
    if isinstance(spec, CameraSpec):
        rays = spec.optics.rays(rim(spec.width, spec.height))
    else:
        rays = spec.grid.directions()
    x, y, z = rotation(pose[3:], np) @ rays.T
    level = np.hypot(x, y) > 1e-9
    turn = np.sort(np.arctan2(y, x)[level])
    gaps = np.diff(turn, append=turn[:1] + 2 * np.pi)
    widest = int(gaps.argmax())
    if gaps[widest] < ALL_ROUND:
        return dict(circular=dict(shapeReferencePoint=at, radius=reach))
    ends = np.array([turn[widest], turn[(widest + 1) % len(turn)]])  # left and right
    start, end = known.azimuth(np.stack([pose[:2]] * 2), ends)
    steep = np.degrees(np.arcsin(np.clip(z, -1, 1)))
    turns = dict(
        stationaryHorizontalOpeningAngleStart=start,
        stationaryHorizontalOpeningAngleEnd=end,
        verticalOpeningAngleStart=steep.min(),
        verticalOpeningAngleEnd=steep.max(),
    )
    angles = {key: round(10 * float(angle)) % 3600 for key, angle in turns.items()}
    return dict(radial=dict(shapeReferencePoint=at, range=reach) | angles)
