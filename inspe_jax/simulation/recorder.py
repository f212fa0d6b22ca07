"""What every recorder of a scene shares: what to record, what a recorder is, and its stations."""

import re
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.sensing.layout import Layout
from inspe_jax.simulation.frame import Frame, Image, Scan, Station
from inspe_jax.simulation.lidar_noise import LidarNoise

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
