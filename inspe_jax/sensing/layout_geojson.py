"""A layout as GeoJSON: units and sensors as points on the Earth, for maps and back.

A feature's ``feature`` is ``unit`` or ``sensor``; others are left out when a file is read. A unit
is where its base is. A sensor is where it hangs itself, ``height_m`` above the ground at its unit's
base; its ``azimuth_deg`` is clockwise from true north, its ``pitch_deg`` positive nose-up. So a
point that is moved in a map is a sensor or a unit that is moved.
"""

import os
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.core.files import check_model
from inspe_jax.scene.geojson import Feature, known_georeference, read_features
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.layout import Layout, lens_keys, made_with, parse_layout

DIGITS = 9  # decimals of degrees: a tenth of a millimetre

_Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Unit(BaseModel):
    name: str
    profile: str | None = None


class _Sensor(BaseModel):
    name: str
    unit: str
    device: str
    hfov_deg: _Finite | None = None
    height_m: _Finite
    azimuth_deg: Annotated[float, Field(ge=-360, le=720)]
    pitch_deg: _Finite = 0.0
    roll_deg: _Finite = 0.0


def layout_features(layout: Layout, place: Intersection) -> list[dict[str, Any]]:
    """The units and sensors of a layout as features. Raises InspeError if the place has no
    coordinates."""
    georeference, poses = known_georeference(place), np.asarray(layout.poses, float)
    feet = np.array([unit.base[:2] for unit in layout.units])
    ground = place.ground(feet)
    azimuth = georeference.azimuth(poses[:, :2], poses[:, 5])
    bases, ends = (
        georeference.to_degrees(at).round(DIGITS).tolist() for at in (feet, poses[:, :2])
    )
    own = {"profile": layout.profile} if layout.profile else {}
    found = []
    for u, members in enumerate(layout.members()):
        name = layout.units[u].name
        about = dict(feature="unit", name=name, sensors=len(members), **own)
        found.append(point_feature(bases[u], **about))
        for s in members:
            spec, (_, _, z, roll, pitch, _) = layout.sensors[s].spec, poses[s]
            found.append(
                point_feature(
                    ends[s],
                    feature="sensor",
                    name=layout.sensors[s].name,
                    unit=name,
                    device=spec.name,
                    **lens_keys(spec),
                    kind=spec.kind,
                    height_m=round(float(z - ground[u]), 4),
                    azimuth_deg=round(float(azimuth[s]), 6) % 360,
                    pitch_deg=round(float(np.degrees(pitch)), 6) + 0.0,
                    roll_deg=round(float(np.degrees(roll)), 6) + 0.0,
                )
            )
    return found


def point_feature(at: list[float], **properties: Any) -> dict[str, Any]:
    """A feature at a longitude and latitude [degrees]."""
    point = {"type": "Point", "coordinates": at}
    return {"type": "Feature", "geometry": point, "properties": properties}


def collection(layout: Layout, features: list[dict[str, Any]]) -> dict[str, Any]:
    """Features as the content of a file that :func:`load_layout_geojson` reads."""
    own = {"name": layout.name, **made_with(layout)}
    return {"type": "FeatureCollection", **own, "features": features}


def load_layout_geojson(
    path: str | os.PathLike[str], scene: Scene, *, unit_rule: bool = True
) -> Layout:
    """The layout in a GeoJSON file, on the ground of a scene; ``unit_rule`` as in
    :func:`~inspe_jax.sensing.layout.make_layout`. Raises InspeError as
    :func:`~inspe_jax.scene.geojson.read_features` and
    :func:`~inspe_jax.sensing.layout.load_layout`, and if a sensor's unit is not in the file."""
    place, kinds = scene.intersection, ("unit", "sensor")
    features, further, bare = read_features(path, place, lambda own: own.get("feature") in kinds)
    if bare:
        raise InspeError(f"{path}: features[{bare[0]}].geometry: no geometry of GeoJSON")
    units: dict[str, tuple[np.ndarray, list[dict[str, Any]]]] = {}
    profiles = []
    for one in _of("unit", features, path):
        unit = check_model(_Unit, one.properties, f"{one.where}.properties")
        if unit.name in units:
            raise InspeError(f"{one.where}: two units are named '{unit.name}'")
        units[unit.name] = (_point(one), [])
        profiles += [unit.profile] if unit.profile else []
    for one in _of("sensor", features, path):
        where = f"{one.where}.properties"
        sensor, at = check_model(_Sensor, one.properties, where), _point(one)
        if sensor.unit not in units:
            raise InspeError(f"{where}: no unit '{sensor.unit}'{nearest(sensor.unit, [*units])}")
        base, members = units[sensor.unit]
        yaw = known_georeference(place).yaw(at[None], np.array([sensor.azimuth_deg]))[0]
        own = dict(name=sensor.name, device=sensor.device, hfov_deg=sensor.hfov_deg)
        own |= dict(height=sensor.height_m)
        own |= dict(offset=(at - base).tolist(), yaw_deg=float(np.degrees(yaw)))
        members.append(own | dict(pitch_deg=sensor.pitch_deg, roll_deg=sensor.roll_deg))
    content: dict[str, Any] = {"profile": profiles[0]} if profiles else {}
    kept = ("name", "profile", "searched_for", "devices", "order")
    content |= {key: further[key] for key in kept if key in further}
    content["units"] = [
        dict(name=name, base=[*base.tolist(), float(place.ground(base)[0])], sensors=members)
        for name, (base, members) in units.items()
        if members
    ]
    return parse_layout(content, str(path), Path(path).stem, unit_rule=unit_rule)


def _of(kind: str, features: tuple[Feature, ...], path: str | os.PathLike[str]) -> list[Feature]:
    """The features of a kind. Raises InspeError unless there is one, and all are points."""
    found = [f for f in features if f.properties["feature"] == kind]
    for one in found:
        if one.geometry.geom_type != "Point":
            raise InspeError(f"{one.where}: a {kind} is a Point")
    if not found:
        raise InspeError(
            f"{path}: no {kind}: a layout is features whose property 'feature' is 'unit' or "
            "'sensor', as `inspe export` writes them"
        )
    return found


def _point(one: Feature) -> np.ndarray:
    return np.array(one.geometry.coords[0][:2])
