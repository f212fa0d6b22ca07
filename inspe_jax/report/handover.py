"""Files that a plan is handed on in: GeoJSON, KML, a calibration and a bill of materials."""

import json
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from shapely.geometry import Polygon, mapping
from shapely.geometry.polygon import orient

from inspe_jax.core.errors import needs
from inspe_jax.core.files import csv_text
from inspe_jax.core.geometry import pose_matrix
from inspe_jax.core.rigid import CONVENTIONS
from inspe_jax.core.words import visible
from inspe_jax.report.outlines import view_outline
from inspe_jax.report.perception_regions import perception_regions
from inspe_jax.report.schedule import EXISTING_POLE, installation_schedule, materials
from inspe_jax.scene.geojson import known_georeference
from inspe_jax.scene.intersection import Intersection
from inspe_jax.sensing.layout import Layout, lens_keys, made_with
from inspe_jax.sensing.layout_geojson import DIGITS, collection, layout_features
from inspe_jax.sensing.sensors import CameraSpec

LINE = {"camera": "ffb27200", "lidar": "ff00559e", "radar": "ff505d2f", "thermal": "ff005c7a"}
"""Colours of outlines in KML, by kind of sensor: alpha, blue, green, red."""
FILL = "30"  # alpha of what is within them


def plan_features(layout: Layout, place: Intersection) -> list[dict[str, Any]]:
    """A plan as GeoJSON features in degrees: units, sensors, a ``view`` of each, on level ground
    at the height of its foot, whatever stands in the way. A unit is where the layout has it, says
    what it ``stands_on``, and where an existing ``pole`` beside it stands (longitude, latitude).
    Raises InspeError if the place has no coordinates."""
    found, poses = layout_features(layout, place), np.asarray(layout.poses, float)
    units = (one["properties"] for one in found if one["properties"]["feature"] == "unit")
    for about, row in zip(units, installation_schedule(layout, place, {}), strict=True):
        about["stands_on"] = row.pole
        if row.degrees is not None and row.pole == EXISTING_POLE:
            about["pole"] = [round(degree, DIGITS) for degree in reversed(row.degrees)]
    ground = place.ground(np.array([layout.units[s.unit].base[:2] for s in layout.sensors]))
    for sensor, pose, level in zip(layout.sensors, poses, ground, strict=True):
        outline = view_outline(sensor.spec, pose, float(level))
        if len(outline) < 4:  # it looks at nothing, as from below the ground
            continue
        ring = orient(Polygon(known_georeference(place).to_degrees(outline).round(DIGITS)))
        about = dict(feature="view", name=sensor.name, kind=sensor.spec.kind)
        found.append({"type": "Feature", "geometry": mapping(ring), "properties": about})
    return found


def plan_geojson(layout: Layout, place: Intersection) -> str:
    """A plan as GeoJSON, which can be read back as a layout. Raises as :func:`plan_features`."""
    return json.dumps(collection(layout, plan_features(layout, place)), indent=1) + "\n"


def city_geojson(
    layouts: Mapping[str, tuple[Layout, Intersection]], junctions: Sequence[dict[str, Any]]
) -> str:
    """The plan of a city as GeoJSON: ``junctions`` as features, and the plan of each that has one.

    ``layouts`` are by the ids of their junctions, which their features have as their property
    ``junction``. Raises as :func:`plan_features`.
    """
    found, own_devices = [*junctions], dict[str, Any]()
    for name, (layout, place) in layouts.items():
        own_devices |= made_with(layout).get("devices", {})
        for feature in plan_features(layout, place):
            feature["properties"] = {"junction": name, **feature["properties"]}
            found.append(feature)
    further = {"devices": own_devices} if own_devices else {}
    return json.dumps({"type": "FeatureCollection", **further, "features": found}, indent=1) + "\n"


def plan_kml(layout: Layout, place: Intersection) -> str:
    """A plan as KML 2.2, with heights above the ground. Raises as :func:`plan_features`, and
    InspeError where fastkml is missing."""
    with needs("KML needs fastkml", "geo"):
        from fastkml import KML, Document, Folder, Placemark, Style, StyleUrl, enums
        from fastkml.geometry import create_kml_geometry
        from fastkml.styles import LineStyle, PolyStyle
        from pygeoif import shape

    def placemark(one: dict[str, Any]) -> Any:
        own, geometry = dict(one["properties"]), one["geometry"]
        mode = None
        if own["feature"] == "sensor":
            mode = enums.AltitudeMode.relative_to_ground
            geometry = geometry | {"coordinates": [*geometry["coordinates"], own["height_m"]]}
        view = own.pop("feature") == "view"
        return Placemark(
            name=visible(own.pop("name")),
            description="<br/>".join(  # viewers of maps read it as HTML
                escape(visible(f"{key}: {value}")) for key, value in own.items()
            ),
            style_url=StyleUrl(url=f"#{own['kind']}") if view and own["kind"] in LINE else None,
            kml_geometry=create_kml_geometry(shape(geometry), altitude_mode=mode),
        )

    by_kind: dict[str, list[Any]] = {"unit": [], "sensor": [], "view": []}
    for one in plan_features(layout, place):
        by_kind[one["properties"]["feature"]].append(placemark(one))
    folders = [Folder(name=f"{kind}s", features=own) for kind, own in by_kind.items()]
    styles = [
        Style(
            id=kind, styles=[LineStyle(color=colour, width=1.5), PolyStyle(color=FILL + colour[2:])]
        )
        for kind, colour in LINE.items()
    ]
    title = visible(f"{layout.name} at {place.name}")
    document = KML(features=[Document(name=title, styles=styles, features=folders)])
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + document.to_string(prettyprint=True)


def calibration_json(layout: Layout, place: Intersection) -> str:
    """A layout as the calibration that its sensors should come to have, which
    :func:`inspe_jax.layouts_from` reads back.

    Lenses as OpenCV's camera matrices [px]; poses as 4 × 4 matrices from the sensor to the frame,
    cameras in optical axes; and ``looks``: what each looks at, as a polygon on level ground at the
    height of its foot [m], and, where the place has coordinates, its latitude, longitude and
    azimuth, and the polygon in longitudes and latitudes. There also ``stations``, by
    :func:`~inspe_jax.report.perception_regions.perception_regions`.
    """
    known, sensors = place.georeference, []
    made, poses = made_with(layout), np.asarray(layout.poses, float)
    frame: dict[str, Any] = {}
    if known is not None:
        matrix = np.eye(4)
        matrix[:2, 3] = np.negative(known.shift)
        frame = dict(crs=known.crs, matrix=matrix.tolist())
    for sensor, pose in zip(layout.sensors, poses, strict=True):
        spec, unit, matrix = sensor.spec, layout.units[sensor.unit], pose_matrix(pose)
        own: dict[str, Any] = dict(name=sensor.name, kind=spec.kind, device=spec.name)
        own |= dict(unit=unit.name, **lens_keys(spec))
        if isinstance(spec, CameraSpec):
            (fx, fy), (cx, cy) = spec.focals, spec.principal
            own |= dict(width=spec.width, height=spec.height)
            own |= dict(camera_matrix=[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
            own |= dict(distortion=list(spec.distortion)) if spec.distortion else {}
            own |= dict(model="fisheye") if spec.fisheye else {}
            if spec.image_circle:
                own |= dict(image_circle_deg=float(np.degrees(spec.image_circle)))
            matrix = matrix @ np.linalg.inv(CONVENTIONS["optical"][1])
        level = float(place.ground(np.array([unit.base[:2]]))[0])
        outline = view_outline(spec, pose, level)
        looks: dict[str, Any] = dict(polygon=outline.round(3).tolist())
        if known is not None:
            lon, lat = known.to_degrees(pose[None, :2]).round(DIGITS)[0].tolist()
            azimuth = float(known.azimuth(pose[None, :2], pose[5:])[0])
            looks |= dict(lat=lat, lon=lon, azimuth_deg=round(azimuth, 6))
            looks |= dict(wgs84=known.to_degrees(outline).round(DIGITS).tolist())
        sensors.append(own | dict(sensor_to_frame=(matrix + 0.0).tolist(), looks=looks))
    content = dict(name=layout.name, frame=frame, devices=made.get("devices", {}), sensors=sensors)
    if known is not None:
        content |= dict(stations=perception_regions(layout, place))
    return json.dumps(content, indent=1) + "\n"


def bill_of_materials(layout: Layout, prices: Mapping[str, float]) -> str:
    """The devices of a layout as CSV: how many, where, and what they cost [US dollars]. ``prices``
    replace the catalogue's. A device without a price has none here. Where there are varifocal
    lenses, a row is of those that are set alike, ``hfov_deg``.

    >>> print(report.bill_of_materials(layout, {"paper-camera": 500.0}).splitlines()[0])
    device,title,maker,count,price_usd,total_usd,units
    """
    bought = materials(layout, prices)
    zooms = any(row.hfov_deg is not None for row in bought)
    rows = [
        dict(
            **{key: getattr(row, key) for key in ("device", "title", "maker", "count")},
            price_usd="" if row.price is None else f"{row.price:.2f}",
            total_usd="" if row.total is None else f"{row.total:.2f}",
            units="; ".join(row.units),
            **({"hfov_deg": row.hfov_deg or ""} if zooms else {}),
        )
        for row in bought
    ]
    return csv_text(rows)


PLAN_FORMATS: dict[str, Callable[[Layout, Intersection, Mapping[str, float]], str]] = {
    ".geojson": lambda layout, place, prices: plan_geojson(layout, place),
    ".kml": lambda layout, place, prices: plan_kml(layout, place),
    ".json": lambda layout, place, prices: calibration_json(layout, place),
    ".csv": lambda layout, place, prices: bill_of_materials(layout, prices),
}
"""What writes each file that a plan is handed on in, by its suffix."""
