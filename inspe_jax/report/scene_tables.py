"""Tables of scenes, layouts, devices, profiles and junctions for people."""

from collections import Counter
from collections.abc import Iterable, Mapping

import numpy as np
from jaxtyping import Float
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from inspe_jax.core.errors import InspeError
from inspe_jax.core.tables import table_of
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.maps.road_map import JunctionInfo
from inspe_jax.scene.procedural.built_ins import BUILT_INS, built_in
from inspe_jax.scene.profiles import Profile
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.terrain import Terrain
from inspe_jax.sensing.catalogue import Device
from inspe_jax.sensing.layout import Layout, device_words
from inspe_jax.sensing.sensors import Spec


def scene_table(scene: Scene) -> RenderableType:
    """A scene: its source, voxels, traffic, settings, notes and regions."""
    place, grid, traffic = scene.intersection, scene.voxels, scene.traffic
    facts = table_of(scene.name, "scene", "")
    rows = {
        "source": place.source,
        "centre": _position(place.center),
        "latitude, longitude": _on_earth(place.georeference, place.center),
        "region of interest": f"radius {grid.radius:g} m",
        "voxels": f"{len(grid.columns):,} columns × {grid.level_count} levels = {grid.count:,}; "
        f"{grid.words}",
        "arms, poles, routes": f"{len(place.arms)}, {len(scene.poles)}, {len(place.routes)}",
        "traffic": f"{traffic.frame_count} frames, {traffic.mean_count:.1f} road users on average",
        "static bodies": _bodies(scene),
        "terrain": _terrain(scene.terrain),
        "settings": ", ".join(f"{key} {value}" for key, value in scene.settings),
        "notes": "\n".join(place.notes),
    }
    for name, value in rows.items():
        if value:
            facts.add_row(name, Text(value))
    regions = table_of("Regions", "region", "weight", "columns", "share")
    for region in Region:
        count = int((grid.region == region).sum())
        if count:
            part = f"{count / len(grid.columns):.1%}"
            regions.add_row(region.key, f"{grid.region_weight[region]:g}", f"{count:,}", part)
    return Group(facts, "", regions)


def _on_earth(georeference: Georeference | None, point: Float[np.ndarray, "3"]) -> str:
    """Latitude and longitude of a point; empty where they are unknown, or pyproj is missing."""
    try:
        return "" if georeference is None else georeference.words(point[:2])
    except InspeError:
        return ""


def _terrain(terrain: Terrain | None) -> str:
    if terrain is None:
        return ""
    low, high = terrain.heights.min(), terrain.heights.max()
    return f"{high - low:.1f} m from lowest to highest, slopes up to {terrain.steepest:.0%}"


def _bodies(scene: Scene) -> str:
    counts = Counter(one.kind for one in scene.statics)
    inside = scene.inside_statics
    share = "" if inside is None else f"; {inside.mean():.1%} of the voxels are inside"
    return ", ".join(f"{kind} {count}" for kind, count in counts.items()) + share


def layout_table(layout: Layout) -> RenderableType:
    """A layout: each sensor with its device and pose [m, degrees]. Height is above the unit's base.
    Roll has a column only if a sensor has one."""
    poses = np.asarray(layout.poses, float)
    height = poses[:, 2] - [layout.units[sensor.unit].base[2] for sensor in layout.sensors]
    roll, pitch, yaw = np.degrees(poses[:, 3:]).T
    numbers = {
        "x\n[m]": poses[:, 0],
        "y\n[m]": poses[:, 1],
        "height\n[m]": height,
        "yaw\n[°]": 180 - (180 - yaw) % 360,
        "pitch\n[°]": pitch,
        **({"roll\n[°]": roll} if np.any(np.abs(roll) >= 0.05) else {}),
    }
    table = table_of(f"Layout {layout.name}", "#", "sensor", "device", *numbers)
    for k, sensor in enumerate(layout.sensors):
        names = [Text(name) for name in (sensor.name, device_words(sensor.spec))]
        table.add_row(str(k + 1), *names, *(f"{values[k]:z.1f}" for values in numbers.values()))
    return table


RESOLUTIONS = dict(camera="pixels", thermal="pixels", lidar="channels", radar="range,\nazimuth")
"""What the resolution of each kind of sensor is of."""


def devices_table(devices: Mapping[str, Device]) -> RenderableType:
    """The catalogue: maker, resolution, reach and price of each device, a table for each kind of
    sensor, and the sources of the data."""
    tables: dict[str, Table] = {}
    sources = [Text("Where their figures are from", style="bold")]
    for device in devices.values():
        spec, kind = device.spec, device.kind
        if kind not in tables:
            heads = RESOLUTIONS.get(kind, "resolution"), "view", "reach\n[m]", "price\n[US$]"
            tables[kind] = table_of(f"Devices: {spec.title}s", "device", "maker", *heads)
        price = "–" if device.price_usd is None else f"{device.price_usd:,.0f}"
        numbers = *resolution_of(spec), f"{round(spec.grid.reach, 1):g}", price
        tables[kind].add_row(device.name, device.maker, *numbers)
        words = f"{device.name}: {device.source.rstrip('.')}. {device.note}".strip()
        sources.append(Text(words, style="dim"))
    return Group(*tables.values(), "", *sources)


def profile_table(profile: Profile) -> RenderableType:
    """A profile: every value, and the reason for it."""
    table = table_of(f"{profile.name}: {profile.title}", "setting", "value", "reason")
    for key, reason in profile.reasons.items():
        table.add_row(key, f"{getattr(profile, key)}", reason)
    return table


def junctions_table(
    infos: Iterable[JunctionInfo], map_name: str, georeference: Georeference | None = None
) -> RenderableType:
    """The junctions of a map: id, centre (x, y, z) [m], arms, size, crosswalks and signals. With a
    projection also latitude and longitude, and streets where they have names."""
    infos = list(infos)
    places = [_on_earth(georeference, np.array(info.center)) for info in infos]
    degrees = ["latitude, longitude"] if any(places) else []
    named = ["streets"] if any(info.streets for info in infos) else []
    heads = ("arms", "size\n[m]", "cross-\nwalks", "signals", *named)
    table = table_of(f"Junctions of {map_name}", "id", "centre [m]", *degrees, *heads)
    for info, place in zip(infos, places, strict=True):
        at = [_position(info.center), *([place] if degrees else [])]
        numbers = (f"{info.arms}", f"{info.size:.1f}", f"{info.crosswalks}", f"{info.signals}")
        streets = [Text(", ".join(info.streets))] if named else []
        table.add_row(f"{info.id}", *at, *numbers, *streets)
    return table


def built_ins_table() -> RenderableType:
    """The built-in intersections."""
    heads = ("name", "arms", "poles", "routes", "regions", "notes")
    table = table_of("Built-in intersections", *heads)
    for name in BUILT_INS:
        place = built_in(name)
        there = [one for one in Region if one in place.regions and not place.regions[one].is_empty]
        counts = (str(len(each)) for each in (place.arms, place.poles, place.routes))
        regions, notes = ", ".join(one.key for one in there), Text("\n".join(place.notes))
        table.add_row(name, *counts, regions, notes)
    return table


def resolution_of(spec: Spec) -> tuple[str, str]:
    """The resolution, and the field of view from edge to edge [degrees], as text."""
    across, high = np.degrees(spec.field_of_view)
    return spec.resolution, f"{across:.0f}° × {high:.0f}°"


def _position(center: Iterable[float]) -> str:
    return ", ".join(f"{value:z.1f}" for value in center)
