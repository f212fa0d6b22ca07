"""Traffic from logs of CARLA's recorder: packets, each with an id and a length, in centimetres and
left-handed. No server is needed."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from inspe_jax.core.carla_frame import flip, from_carla, whole_box
from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import ARRAYS, cached_by_file, check_input
from inspe_jax.core.words import counted
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.traffic import frames as traffic
from inspe_jax.scene.traffic.frames import CLASSES, Snapshot, TrafficFrames
from inspe_jax.scene.traffic.tracks import LONG, ON_ROADS, Tracks, track_frames

LOG_SUFFIXES = (".log",)
_MAGIC = "CARLA_RECORDER"
_FRAME, _APPEARS, _POSITIONS, _KINEMATICS, _BOXES = 0, 2, 6, 12, 13
_VEHICLE, _WALKER = "vehicle.", "walker."


class _PacketReader:
    """Reads values one after the other, as CARLA packs them: little-endian, without gaps."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values

    def text(self) -> str:
        (length,) = self.take("H")
        self.at += length
        return self.data[self.at - length : self.at].decode()

    def rows(self, form: str) -> Iterator[tuple[Any, ...]]:
        (count,) = self.take("H")
        for _ in range(count):
            yield self.take(form)

    def by_actor(self) -> dict[int, np.ndarray]:
        return {actor: np.array(six) for actor, *six in self.rows("I6f")}


@dataclass
class _Moment:
    """A recorded frame: time [s], and by actor pose and velocity, six numbers in log units."""

    time: float
    where: dict[int, np.ndarray] = field(default_factory=dict)
    velocity: dict[int, np.ndarray] = field(default_factory=dict)


@dataclass
class RecorderLog:
    """A log: the name of its map, its moments in order, and by actor the class and the box, its
    offset from the actor and its half sizes [m]. ``notes`` say which are usual ones."""

    map: str
    moments: list[_Moment] = field(default_factory=list)
    kinds: dict[int, int] = field(default_factory=dict)
    boxes: dict[int, np.ndarray] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@cached_by_file(4)
def load_log(path: Path) -> RecorderLog:
    """A recorder log, cached while the file does not change. Raises InspeError if the file is
    missing, cut short or not a log."""
    check_input(path, ARRAYS)
    reader = _PacketReader(path.read_bytes())
    fault = "not a log of CARLA's recorder"
    try:
        reader.take("H")
        if reader.text() != _MAGIC:
            raise ValueError
        reader.take("q")
        log = RecorderLog(reader.text().rpartition("/")[2])
        fault = "the log is cut short or broken"
        _read_packets(reader, log)
    except (struct.error, ValueError, IndexError) as error:
        raise InspeError(f"{path}: {fault}") from error
    if not log.moments:
        raise InspeError(f"{path}: the log has no frames")
    return log


def _read_packets(reader: _PacketReader, log: RecorderLog) -> None:
    actors: dict[int, tuple[str, dict[str, str]]] = {}
    while reader.at < len(reader.data):
        packet, size = reader.take("BI")
        end = reader.at + size
        if end > len(reader.data):
            raise ValueError
        if packet == _FRAME:
            log.moments.append(_Moment(reader.take("Qdd")[2]))
        elif packet == _APPEARS:
            for actor, *_ in reader.rows("IB6fI"):
                name = reader.text()
                actors[actor] = name, {reader.text(): reader.text() for _ in reader.rows("B")}
        elif packet == _POSITIONS:
            log.moments[-1].where = reader.by_actor()
        elif packet == _KINEMATICS:
            log.moments[-1].velocity = reader.by_actor()
        elif packet == _BOXES:
            log.boxes |= {actor: box / 100 for actor, box in reader.by_actor().items()}
        reader.at = end
    usual = 0
    for actor, (name, facts) in actors.items():
        if actor in log.boxes:
            kind = kind_of(name, facts, 2 * log.boxes[actor][3])
            if kind is not None:
                log.kinds[actor], box = kind, log.boxes[actor]
                whole = whole_box(box[:3], box[3:], np.array(traffic.ROAD_USERS[kind].size))
                log.boxes[actor] = np.concatenate(whole)
                usual += not np.array_equal(log.boxes[actor], box)
    if usual:
        words = counted(usual, "road user")
        log.notes = (f"the log has boxes without a size: {words} of the usual size of the kind",)


def kind_of(name: str, facts: dict[str, str], length: float) -> int | None:
    """The class of an actor, an index into :data:`CLASSES`; None if it is no road user. Two wheels
    are a cyclist's. Before CARLA 0.9.14 the length [m] tells trucks, since then the blueprint."""
    if name.startswith(_WALKER):
        return CLASSES.index("pedestrian")
    if not name.startswith(_VEHICLE):
        return None
    if facts.get("number_of_wheels") == "2":
        return CLASSES.index("cyclist")
    large = length >= LONG or facts.get("base_type", "").lower() in ("truck", "bus")
    return CLASSES.index("truck" if large else "car")


def log_traffic(
    intersection: Intersection, source: Path, *, radius: float, frames: int, step: float = 1.0,
    notes: list[str] | None = None,
) -> TrafficFrames:  # fmt: skip
    """The recorded traffic at an intersection of the log's own map, whatever its file is called:
    :func:`~inspe_jax.scene.traffic.tracks.track_frames`.

    ``notes`` get those of the log, and that most cars and trucks are beside the roads of a map of
    the log's name. Raises InspeError if the log cannot be read, if nobody comes within the radius,
    or if they are so on another map.
    """
    log = load_log(source)
    size: dict[str, Any] = dict(radius=radius, frames=frames, step=step)
    found, on = track_frames(_tracks(log), intersection, source, **size)
    notes = [] if notes is None else notes
    notes += log.notes
    own = intersection.map is not None and intersection.map.name.split(".")[0] == log.map
    if on < ON_ROADS and own:
        notes.append(f"{on:.0%} of the log's cars and trucks are on the roads here")
    elif on < ON_ROADS:
        raise InspeError(
            f"{source}: a log of map '{log.map}', and not of {intersection.name}: {on:.0%} of its "
            "cars and trucks are on the roads here; read the intersection from the log's own map"
        )
    return found


def _tracks(log: RecorderLog) -> Tracks:
    """Everybody at every moment, in our coordinates."""
    rows = [
        (moment.time, actor, *pose, *moment.velocity.get(actor, np.zeros(6))[:3], *log.boxes[actor])
        for moment in log.moments
        for actor, pose in moment.where.items()
        if actor in log.kinds
    ]
    table = np.reshape(rows, (-1, 17))
    time, actor, x, y, z, roll, pitch, yaw = table[:, :8].T
    poses = from_carla(np.column_stack([x / 100, y / 100, z / 100, roll, yaw, pitch]))
    at, yaw = poses[:, :3], poses[:, 5]
    speed, offset, size = flip(table[:, 8:11]), flip(table[:, 11:14]), 2 * table[:, 14:]
    cos, sin = np.cos(yaw), np.sin(yaw)
    ahead, left = offset[:, :2].T
    middle = at[:, :2] + np.column_stack([cos * ahead - sin * left, sin * ahead + cos * left])
    foot = at[:, 2] + offset[:, 2] - size[:, 2] / 2
    kind = np.array([log.kinds[int(one)] for one in actor], np.int8)
    center = np.column_stack([middle, foot + size[:, 2] / 2])
    return Tracks(Snapshot(center, yaw, size, kind, actor.astype(np.int32), speed), time, foot)
