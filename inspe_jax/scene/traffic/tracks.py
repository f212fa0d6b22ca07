"""Traffic from tracks: where road users were, in a CSV file or arrays.

A row is a road user at a moment, in any order. Columns go by their names, as in inD, rounD, SinD,
INTERACTION and V2X-Seq (:data:`COLUMNS`): needed are the user's number, a time, a class and the
box's middle, ``x`` and ``y`` in the map's coordinates [m] or ``lat`` and ``lon`` [degrees].
Everybody stands on the ground. Without a direction, it is that of movement; without sizes, they are
the usual ones. Of inD and rounD name ``00_tracks.csv``: its two files of facts lie beside it.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import shapely
from jaxtyping import Float
from shapely.ops import unary_union

from inspe_jax.core.errors import InspeError, brief, error_at
from inspe_jax.core.files import cached_by_file, read_columns, read_csv
from inspe_jax.core.words import counted
from inspe_jax.scene.geojson import known_georeference
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.traffic.frames import (
    CLASSES,
    ROAD_USERS,
    Snapshot,
    TrafficFrames,
    pack_frames,
    standing_on,
)

TRACK_SUFFIXES = (".csv",)
DEGREE = np.pi / 180
COLUMNS: dict[str, tuple[str, float]] = {
    **dict.fromkeys(("track_id", "trackId", "id"), ("track", 1.0)),
    **dict.fromkeys(("time", "timestamp"), ("time", 1.0)),
    "timestamp_ms": ("time", 1e-3),
    "frame": ("frame", 1.0),
    **dict.fromkeys(("x", "xCenter"), ("x", 1.0)),
    **dict.fromkeys(("y", "yCenter"), ("y", 1.0)),
    **dict.fromkeys(("lat", "latitude"), ("lat", 1.0)),
    **dict.fromkeys(("lon", "longitude"), ("lon", 1.0)),
    **dict.fromkeys(("yaw", "yaw_rad", "psi_rad", "theta"), ("yaw", 1.0)),
    **dict.fromkeys(("yaw_deg", "heading"), ("yaw", DEGREE)),
    **dict.fromkeys(("sub_type", "class", "agent_type", "type", "category"), ("class", 1.0)),
    **{size: (size, 1.0) for size in ("length", "width", "height")},
    **dict.fromkeys(("vx", "v_x", "xVelocity"), ("vx", 1.0)),
    **dict.fromkeys(("vy", "v_y", "yVelocity"), ("vy", 1.0)),
}
"""What a column of tracks holds, and its unit [m, s, rad]; of several the first counts."""

NAMES: dict[str, int] = {
    **dict.fromkeys(("car", "van"), 0),
    **dict.fromkeys(("truck", "bus", "truck_bus", "trailer"), 1),
    **dict.fromkeys(("cyclist", "bicycle", "motorcycle", "motorcyclist", "tricycle"), 2),
    **dict.fromkeys(("pedestrian", "person", "walker", "pedestrian/bicycle"), 3),
}
"""Names of classes, as indices of :data:`~inspe_jax.scene.traffic.frames.CLASSES`."""
LARGEST = (
    ("length", 60.0, "metres"), ("width", 10.0, "metres"), ("height", 10.0, "metres"),
    ("yaw", 13.0, "radians"),
)  # fmt: skip
"""Columns with the largest value that is meant; directions count to two turns."""
VEHICLE, LONG = "vehicle", 6.0  # one of no other name is a truck from this length on [m]
JUMP = 5.0  # who moves farther than this between two rows [m]
FASTEST = 70.0  # and faster than anybody drives [m/s], was set down elsewhere,
NEAR = 1.0  # as who was lost for twice this: they are where a row says, so long from it [s]
SAME = 1e-6  # times this near are one: those of the Earth's clocks are rounded so far [s]
MOVES = 0.5  # least speed that has a direction [m/s]
ON_ROADS = 0.5  # least share of the cars and trucks that are on roads


class Tracks(NamedTuple):
    """N rows of tracks: road users ``who``, each at a ``time`` [s]. ``foot`` is the height in the
    map's coordinates on which they stand [m], not a number if it is that of the ground."""

    who: Snapshot
    time: Float[np.ndarray, " N"]
    foot: Float[np.ndarray, " N"]


def track_frames(
    tracks: Tracks, place: Intersection, where: object, *, radius: float, frames: int, step: float
) -> tuple[TrafficFrames, float]:
    """Frames of tracks, and the share of the cars and trucks in them that are on the roads.

    There are up to ``frames`` frames ``step`` seconds apart from the first row, interpolated
    linearly but not over jumps and gaps (:data:`JUMP`), with all road users on the ground within
    ``radius`` [m] of the centre. Raises InspeError if nobody is left.
    """
    order = np.lexsort((tracks.time, tracks.who.track))
    who, time, foot = (
        Snapshot(*(part[order] for part in tracks.who)),
        *(part[order] for part in tracks[1:]),
    )
    time = time - time.min()
    wanted = step * np.arange(frames)
    wanted = wanted[wanted <= time.max() + SAME]
    ends = np.append(np.flatnonzero(np.diff(who.track)) + 1, len(time))
    found: list[tuple[np.ndarray, np.ndarray]] = []  # frames, and rows at or before them
    for first, end in zip([0, *ends[:-1]], ends, strict=True):
        own = time[first:end]
        seen = np.flatnonzero((wanted >= own[0] - SAME) & (wanted <= own[-1] + SAME))
        before = np.searchsorted(own, wanted[seen] + SAME, "right") - 1
        found.append((seen, first + np.minimum(before, max(len(own) - 2, 0))))
    frame, one = map(np.concatenate, zip(*found, strict=True))
    two = np.minimum(one + 1, ends[np.searchsorted(ends, one, "right")] - 1)
    gap = np.maximum(time[two] - time[one], SAME)
    share = np.clip((wanted[frame] - time[one]) / gap, 0.0, 1.0)
    away = np.abs(who.center[two] - who.center[one]).max(1)
    jumps = (away > JUMP) & ((away > FASTEST * gap) | (gap > 2 * NEAR))
    share = np.where(jumps, np.round(share), share)
    there = ~jumps | (np.abs(wanted[frame] - time[np.where(share > 0.5, two, one)]) <= NEAR)
    frame, one, two, share = (part[there] for part in (frame, one, two, share))

    def between(part: np.ndarray, period: float = np.inf) -> np.ndarray:
        change = part[two] - part[one]
        if np.isfinite(period):
            change = (change + period / 2) % period - period / 2
        return part[one] + share.reshape(-1, *[1] * (part.ndim - 1)) * change

    center = between(who.center)
    near = np.flatnonzero(np.hypot(*(center - place.center)[:, :2].T) <= radius)
    near = near[np.argsort(frame[near], kind="stable")]
    parts = (
        center, between(who.yaw, 2 * np.pi), who.size[one], who.kind[one], who.track[one],
        between(who.velocity), between(foot),
    )  # fmt: skip
    ends = np.searchsorted(frame[near], np.arange(1, len(wanted)))
    each = zip(*(np.split(part[near], ends) for part in parts), strict=True)
    kept = [standing_on(place, radius, Snapshot(*own), level) for *own, level in each]
    if not any(len(part.kind) for part in kept):
        raise InspeError(
            f"{where}: in {time.max():.0f} s nobody comes within {radius:g} m of "
            f"({place.center[0]:.1f}, {place.center[1]:.1f})"
        )
    cars = np.concatenate([part.center[part.kind < CLASSES.index("cyclist")] for part in kept])
    roads = unary_union(list(place.regions.values()))
    on = shapely.intersects_xy(roads, *cars[:, :2].T).mean() if len(cars) else 1.0
    return pack_frames(kept, step), float(on)


def tracks_traffic(
    intersection: Intersection, source: Path | Mapping[str, Any], *, radius: float, frames: int,
    step: float = 1.0, notes: list[str] | None = None,
) -> TrafficFrames:  # fmt: skip
    """The traffic of tracks at an intersection: a CSV file, or its columns by name, each an array
    of N.

    It has at most ``frames`` frames ``step`` seconds apart, with the road users within ``radius``
    [m] of the centre. ``notes`` get what was assumed. Raises InspeError if a column is missing or
    has what is no number, a class is unknown, nobody comes within the radius, or most cars and
    trucks are beside the roads.
    """
    notes = [] if notes is None else notes
    where = "tracks" if isinstance(source, Mapping) else str(source)
    columns = dict(source) if isinstance(source, Mapping) else load_tracks(source)
    found, on = track_frames(
        _tracks(columns, intersection, where, notes),
        intersection, where, radius=radius, frames=frames, step=step,
    )  # fmt: skip
    if on < ON_ROADS:
        raise InspeError(
            f"{where}: {on:.0%} of its cars and trucks are on the roads of {intersection.name}: "
            "give x and y in the map's coordinates, or lat and lon"
        )
    return found


@cached_by_file(2)
def load_tracks(path: Path) -> dict[str, Any]:
    """The columns of a file, cached while it does not change; of inD's with the facts that lie
    beside it. Raises InspeError if a file is missing or not CSV."""
    words = {name for name, (field, _) in COLUMNS.items() if field in ("track", "class")}
    columns: dict[str, Any] = read_columns(path, {*COLUMNS} - words, words)
    if "xCenter" not in columns or not path.name.endswith("tracks.csv"):
        return columns
    tracks, recording = (
        read_csv(path.with_name(path.name.replace("tracks.csv", f"{of}Meta.csv")))
        for of in ("tracks", "recording")
    )
    with error_at(f"{path}: the files of facts beside it", KeyError, IndexError, ValueError):
        names = {row["trackId"]: row["class"] for row in tracks}
        columns["class"] = [names[track] for track in columns["trackId"]]
        rate, lat, lon, x, y = (
            float(recording[0][key])
            for key in ("frameRate", "latLocation", "lonLocation", "xUtmOrigin", "yUtmOrigin")
        )
        columns["time"] = columns["frame"] / rate
    zone = int((lon + 180) // 6) + 1
    columns["utm"] = f"EPSG:{326 if lat >= 0 else 327}{zone:02d}", x, y
    return columns


def _tracks(columns: dict[str, Any], place: Intersection, where: str, notes: list[str]) -> Tracks:
    """Checked rows in the coordinates of a place."""
    given = {
        field: (name, factor) for name, (field, factor) in reversed(COLUMNS.items())
        if name in columns
    }  # fmt: skip

    shapes = {np.shape(columns[name]) for name, _ in given.values()}
    if len(shapes) > 1 or any(len(shape) != 1 for shape in shapes):
        raise InspeError(f"{where}: columns are not arrays of one length")

    @cache
    def numbers(field: str) -> Float[np.ndarray, " N"]:
        name, factor = given[field]
        try:
            found = np.asarray(columns[name], float) * factor
            bad = ~np.isfinite(found)
        except ValueError:
            found = bad = np.array([not _is_number(cell) for cell in columns[name]])
        if bad.any():
            k = int(bad.argmax())
            raise InspeError(
                f"{where}: row {k + 1}, {name}: {brief(columns[name][k])} is no number"
            )
        return found

    for field, most, unit in LARGEST:
        if field in given and (large := np.abs(numbers(field))).max(initial=0.0) > most:
            raise InspeError(
                f"{where}: {given[field][0]}: {large.max():g} is too large for {unit}"
                + "; name a column in degrees yaw_deg" * (field == "yaw")
            )
    spot = ("lat", "lon") if {"lat", "lon"} <= {*given} else ("x", "y")
    for field in ("track", "time", *spot, "class"):
        if field not in given:
            known_as = ", ".join(name for name, (of, _) in COLUMNS.items() if of == field)
            raise InspeError(f"{where}: needs a column of {field}: one of {known_as}")
    kind, known = _kinds(columns[given["class"][0]], where, notes)
    size = np.column_stack(
        [numbers(s) if s in given else np.zeros(len(kind)) for s in ("length", "width", "height")]
    )
    kind = np.where(kind < 0, size[:, 0] >= LONG, kind)
    usual = np.array([user.size for user in ROAD_USERS])[kind]
    if (lacks := (size <= 0)[known].any(1)).any():
        notes.append(
            f"{where}: lengths, widths or heights are missing: {counted(int(lacks.sum()), 'row')} "
            "of the usual size of the class"
        )
    size = np.where(size > 0, size, usual)
    at = np.column_stack([numbers(field) for field in spot])
    if spot == ("lat", "lon"):
        at = known_georeference(place).from_degrees(at[:, ::-1])
    elif "utm" in columns and place.georeference is not None:
        crs, x, y = columns["utm"]
        at = place.georeference.from_degrees(Georeference(crs).to_degrees(at + [x, y]))
    ids = np.array([str(one) for one in columns[given["track"][0]]])
    names, track = np.unique(ids, return_inverse=True)
    time, velocity, yaw = numbers("time"), np.zeros((len(kind), 3)), np.zeros(len(kind))
    moves, turns = {"vx", "vy"} <= {*given}, "yaw" in given
    if moves:
        velocity[:, :2] = np.column_stack([numbers("vx"), numbers("vy")])
    if turns:
        yaw = numbers("yaw")
    order = np.lexsort((time, track))
    if (twice := (np.diff(time[order]) == 0) & (np.diff(track[order]) == 0)).any():
        k = order[twice.argmax()]
        raise InspeError(f"{where}: track {names[track[k]]} has two rows at {time[k]:g} s")
    for rows in np.split(order, np.flatnonzero(np.diff(track[order])) + 1):
        if not moves and len(rows) > 1:
            velocity[rows, :2] = np.gradient(at[rows], time[rows], axis=0)
        if not turns:
            yaw[rows] = _headings(velocity[rows, :2])
    center = np.column_stack([at, size[:, 2] / 2])
    who = Snapshot(center, yaw, size, kind.astype(np.int8), track.astype(np.int32), velocity)
    who, time = Snapshot(*(part[known] for part in who)), time[known]
    return Tracks(who, time, np.full(len(time), np.nan))


def _is_number(cell: Any) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except (TypeError, ValueError):
        return False


def _kinds(names: Any, where: str, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """The class of each row, −1 for a vehicle of no other name; and whether it is known."""
    kinds = {**NAMES, VEHICLE: -1}
    given, of = np.unique([str(name).strip().lower() for name in names], return_inverse=True)
    known = np.array([name in kinds for name in given], bool)
    if not known.any():
        raise InspeError(
            f"{where}: no class of {', '.join(kinds)} among {', '.join(given[:5]) or 'no rows'}: "
            "rename them"
        )
    if not known.all():
        notes.append(f"{where}: left out are rows of class {', '.join(given[~known])}")
    return np.array([kinds.get(name, 0) for name in given])[of], known[of]


def _headings(velocity: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, " M"]:
    """Directions of movement [rad]; where one stands, that of before, or of after at first."""
    moving = np.hypot(*velocity.T) >= MOVES
    if not moving.any():
        return np.zeros(len(velocity))
    last = np.maximum.accumulate(np.where(moving, np.arange(len(velocity)), -1))
    last[last < 0] = moving.argmax()
    return np.arctan2(velocity[last, 1], velocity[last, 0])
