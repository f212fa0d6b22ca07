"""What the sensors of a layout record of a scene's traffic, frame by frame."""

import re
import socket
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from inspe_jax.dataset.camera import Camera
from inspe_jax.dataset.embree import Caster
from inspe_jax.dataset.lidar import Lidar, LidarNoise
from inspe_jax.dataset.movers import Company, things_of
from inspe_jax.dataset.record import Frame, Image, Scan, Station
from inspe_jax.dataset.shading import Shading
from inspe_jax.dataset.statics import build_statics
from inspe_jax.errors import InspeError, nearest
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec

BELOW = 2.5
"""A mast ends so far beneath its unit's lowest sensor [m], out of the sensors' sight."""
LAYERS = ("depth", "instance", "semantic")
"""What a camera can record beside its pictures."""
CONNECTING = 3.0
"""Who listens answers within this time [s]."""


@dataclass(frozen=True)
class Recording:
    """What to record: ``rate`` in frames a second [Hz]; ``layers`` of :data:`LAYERS`;
    ``image_scale`` times the cameras' own resolution."""

    rate: float = 10.0
    layers: tuple[str, ...] = ()
    image_scale: float = 1.0
    noise: LidarNoise = field(default_factory=LidarNoise)

    def check(self) -> None:
        """Raise InspeError where a value is out of range."""
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise InspeError(f"rate {self.rate} Hz is out of range: above 0")
        if not (np.isfinite(self.image_scale) and 0 < self.image_scale <= 4):
            raise InspeError(f"image_scale {self.image_scale} is out of range: above 0, up to 4")
        for name in self.layers:
            if name not in LAYERS:
                raise InspeError(
                    f"layer '{name}': one of {', '.join(LAYERS)}{nearest(name, LAYERS)}"
                )


@dataclass(frozen=True)
class Server:
    """Where a CARLA server listens, and how long it may take to answer [s].

    Apart from :class:`Recording`, as it makes no difference to what is recorded.
    """

    host: str = "127.0.0.1"
    port: int = 2000
    timeout: float = 20.0

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"

    @classmethod
    def of(cls, text: str) -> "Server":
        """A server by "HOST", "HOST:PORT" or "PORT". Raises InspeError for anything else."""
        found = re.fullmatch(r"(?P<alone>\d+)|(?P<host>[^\s:]+)(:(?P<port>\d+))?", text.strip())
        if found is None:
            raise InspeError(f"server '{text}': HOST, HOST:PORT or PORT, as {cls()}")
        server = cls(found["host"] or cls.host, int(found["alone"] or found["port"] or cls.port))
        server.check()
        return server

    def check(self) -> None:
        """Raise InspeError where a value is out of range."""
        if not 0 < self.port < 65535:  # CARLA also takes the next one
            raise InspeError(f"port {self.port} is out of range: 1 to 65534")
        if not (np.isfinite(self.timeout) and self.timeout > 0):
            raise InspeError(f"timeout {self.timeout} s is out of range: above 0")

    def reach(self) -> None:
        """Raise InspeError where nobody listens."""
        try:
            socket.create_connection((self.host, self.port), CONNECTING).close()
        except (OSError, UnicodeError) as error:  # the latter of a name that can be none
            what = getattr(error, "strerror", None) or error
            raise InspeError(
                f"no CARLA server at {self} ({what}): start one, CarlaUE4.sh "
                f"-carla-rpc-port={self.port}, or say where it is: --server HOST:PORT"
            ) from error


class Recorder(Protocol):
    """What records a scene, whichever way; the same frame is the same however often it is asked.

    ``notes`` tell what it cannot record as asked.
    """

    notes: tuple[str, ...]

    def frame(self, t: int) -> Frame:
        """Frame t of the scene's traffic, as every station recorded it."""
        ...


class EmbeddedRecorder:
    """The sensors in a world of triangles, by Embree: no simulator needed."""

    notes: tuple[str, ...] = ()

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        conditions: Conditions = FAIR,
        recording: Recording | None = None,
        seed: int = 0,
    ) -> None:
        self.recording = recording or Recording()
        self.recording.check()
        self.scene, self.seed = scene, seed
        layout = conditions.layout(layout)
        poses = np.asarray(layout.poses, float)
        self.layout = layout
        self.statics = build_statics(scene.intersection, scene.voxels.radius, _masts(layout, poses))
        self.still = Caster(self.statics.triangles)
        shading = Shading(conditions, self.statics.poles - self.statics.center)
        scale = self.recording.image_scale
        self.sensors: list[Camera | Lidar] = [
            Camera(sensor.spec, pose, self.statics, self.still, shading, scale)
            if isinstance(sensor.spec, CameraSpec)
            else Lidar(sensor.spec, pose, self.statics, self.still)
            for sensor, pose in zip(layout.sensors, poses, strict=True)
        ]

    def frame(self, t: int) -> Frame:
        """Frame t, as every station recorded it."""
        things = things_of(self.scene.traffic, t, self.seed)
        company = Company(things, self.statics.center)
        seen: list[Image | Scan] = []
        for s, sensor in enumerate(self.sensors):
            rng = np.random.default_rng([self.seed, t, s, 3])
            if isinstance(sensor, Camera):
                seen.append(sensor.image(company, self.seed, rng, self.recording.layers))
            else:
                returns = sensor.cast(company, 1.0 / self.recording.rate)
                seen.append(sensor.scan(returns, self.recording.noise, rng))
        return Frame(t, float(self.scene.traffic.time[t]), things, stations_of(self.layout, seen))


def stations_of(layout: Layout, seen: Sequence[Image | Scan]) -> tuple[Station, ...]:
    """The units of a layout with what each of its sensors saw, in their order."""
    return tuple(
        Station(
            number=u + 1,
            name=unit.name,
            pose=np.array([*unit.base, 0.0, 0.0, 0.0]),
            images=tuple(x for x in (seen[s] for s in members) if isinstance(x, Image)),
            scans=tuple(x for x in (seen[s] for s in members) if isinstance(x, Scan)),
        )
        for u, (unit, members) in enumerate(zip(layout.units, layout.members(), strict=True))
    )


def _masts(layout: Layout, poses: np.ndarray) -> np.ndarray:
    """Foot and height of each unit's mast (U, 4): it ends beneath what its own sensors see."""
    heights = [min(poses[s, 2] for s in members) - BELOW for members in layout.members()]
    return np.array(
        [
            (*unit.base, max(height - unit.base[2], 0.5))
            for unit, height in zip(layout.units, heights, strict=True)
        ]
    )


def check_backend(backend: str) -> None:
    """Raise InspeError for a backend that is not in :data:`BACKENDS`."""
    if backend not in BACKENDS:
        known = tuple(BACKENDS)
        raise InspeError(f"backend '{backend}': one of {', '.join(known)}{nearest(backend, known)}")


def server_of(backend: str, server: Server | None) -> Server | None:
    """The server that a backend records with: CARLA's usual one if none is given, or None.

    Raises InspeError where one is given and the backend needs none, or its values are out of range.
    """
    if backend == "carla":
        server = server or Server()
        server.check()
        return server
    if server is not None:
        raise InspeError(f"server {server}: goes with backend carla, and this is {backend}")
    return None


def recorder_of(
    backend: str,
    scene: Scene,
    layout: Layout,
    conditions: Conditions = FAIR,
    recording: Recording | None = None,
    seed: int = 0,
    server: Server | None = None,
) -> AbstractContextManager[Recorder]:
    """A recorder by the name of its backend, in :data:`BACKENDS`. Raises InspeError for another.

    ``server`` is for those that need one.
    """
    check_backend(backend)
    return BACKENDS[backend](scene, layout, conditions, recording, seed, server)


def _embedded(*given: Any) -> AbstractContextManager[Recorder]:
    return nullcontext(EmbeddedRecorder(*given[:-1]))


def _carla(*given: Any) -> AbstractContextManager[Recorder]:
    from inspe_jax.dataset.carla_recorder import CarlaRecorder

    return CarlaRecorder(*given)


BACKENDS: dict[str, Callable[..., AbstractContextManager[Recorder]]] = {
    "embedded": _embedded,
    "carla": _carla,
}
"""What can record."""
