"""What all backends share: settings, the protocol of a recorder, the server, a LiDAR's noise."""

import re
import socket
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import numpy as np
from jaxtyping import Bool, Float

from inspe_jax.core.errors import InspeError, check_known
from inspe_jax.core.records import check_values
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.signals import ATTENUATION, LidarNoise
from inspe_jax.simulation.frame import Boxes, Frame, Image, Scan, Station

LAYERS = ("depth", "instance", "semantic")  # what a camera can record in addition to its pictures
TURN = 0.1
"""How long a LiDAR's turn takes, if nothing else is said [s]: usual devices turn at 10 Hz."""
MOST_PIXELS = 8192  # the largest width and height of a picture

Row = TypeVar("Row")


@dataclass(frozen=True)
class Recording:
    """Settings of a recording: ``rate`` [Hz], ``layers`` of :data:`LAYERS`, ``noise`` and ``turn``
    [s] of LiDARs (0: all rays at once), and ``image_size`` (width, height), if not the cameras'
    own.

    The digest of a scenario contains the names of this class, of :class:`LidarNoise`, and of their
    fields. If these changed, runs that were stopped could not go on.
    """

    rate: float = 10.0
    layers: tuple[str, ...] = ()
    noise: LidarNoise = field(default_factory=LidarNoise)
    turn: float = TURN
    image_size: tuple[int, int] | None = None

    def check(self) -> None:
        """Raise InspeError where a value is out of range."""
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise InspeError(f"rate {self.rate} Hz is out of range: above 0")
        check_values(self.image_size or 1, "image_size (width, height)", 1, MOST_PIXELS)
        check_values(self.turn, "turn [s]", 0, 1)
        for name in self.layers:
            check_known(name, LAYERS, "layer")


@dataclass(frozen=True)
class Server:
    """The address of a CARLA server, and how long it may take to answer [s]."""

    host: str = "127.0.0.1"
    port: int = 2000
    timeout: float = 20.0

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"

    @classmethod
    def of(cls, text: str) -> "Server":
        """The server at "HOST", "HOST:PORT" or "PORT". Raises InspeError for any other text.

        >>> dataset.Server.of("10.0.0.7:2500")
        Server(host='10.0.0.7', port=2500, timeout=20.0)
        """
        found = re.fullmatch(r"(?P<alone>\d+)|(?P<host>[^\s:]+)(:(?P<port>\d+))?", text.strip())
        if found is None:
            raise InspeError(f"server '{text}': HOST, HOST:PORT or PORT, as {cls()}")
        server = cls(found["host"] or cls.host, int(found["alone"] or found["port"] or cls.port))
        server.check()
        return server

    def check(self) -> None:
        """Raise InspeError where a value is out of range."""
        if not 0 < self.port < 65535:  # CARLA uses the next port as well
            raise InspeError(f"port {self.port} is out of range: 1 to 65534")
        if not (np.isfinite(self.timeout) and self.timeout > 0):
            raise InspeError(f"timeout {self.timeout} s is out of range: above 0")

    def reach(self) -> None:
        """Raise InspeError if no server answers at the address."""
        try:
            socket.create_connection((self.host, self.port), timeout=3.0).close()
        except (OSError, UnicodeError) as error:  # the latter for names that are not valid
            what = getattr(error, "strerror", None) or error
            raise InspeError(
                f"no CARLA server at {self} ({what}): start one with CarlaUE4.sh "
                f"-carla-rpc-port={self.port}, or give its address: --server HOST:PORT"
            ) from error


class Recorder(Protocol):
    """A recorder of a scene's traffic; ``notes`` say what it cannot record as the layout has it."""

    notes: tuple[str, ...]

    def frame(self, t: int) -> Frame:
        """Frame t of the scene's traffic, as every station recorded it."""


def frame_of(
    scene: Scene, layout: Layout, t: int, boxes: Boxes, recorded: Sequence[Image | Scan]
) -> Frame:
    """Frame t of a scene's traffic, with a station for each unit of the layout; ``recorded`` has an
    image or scan for each sensor, in the layout's order."""
    stations = tuple(
        Station(
            number=u + 1,
            name=unit.name,
            pose=np.array([*unit.base, 0.0, 0.0, 0.0]),
            images=tuple(x for x in (recorded[s] for s in members) if isinstance(x, Image)),
            scans=tuple(x for x in (recorded[s] for s in members) if isinstance(x, Scan)),
        )
        for u, (unit, members) in enumerate(zip(layout.units, layout.members(), strict=True))
    )
    return Frame(t, float(scene.traffic.time[t]), boxes, stations)


def noise_source(seed: int, t: int, s: int) -> np.random.Generator:
    """The random numbers for the noise of sensor s in frame t."""
    return np.random.default_rng([seed, t, s, 3])


def row_of(kinds: Mapping[str, Row], spec: Any, backend: str) -> Row:
    """The row of a backend's table of sensor kinds for a spec. Raises InspeError if it has none."""
    if spec.kind not in kinds:
        raise InspeError(
            f"{spec.name}: backend {backend} cannot simulate a sensor of kind '{spec.kind}', only "
            f"{' and '.join(kinds)}"
        )
    return kinds[spec.kind]


def apply_noise(
    direction: Float[np.ndarray, "R 3"],
    distance: Float[np.ndarray, " R"],
    noise: LidarNoise,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "N 4"], Bool[np.ndarray, " R"]]:
    """Points (x, y, z [m] and intensity 0…1) of those of R rays that come back, and which these
    are; losses are as in CARLA. ``distance`` [m] is infinite where nothing was hit."""
    lost = rng.random((2, len(direction)))
    error = rng.standard_normal(len(direction)) * noise.range
    back = np.isfinite(distance) & (lost[0] >= noise.lost)
    back &= lost[1] >= noise.weak_lost(distance)
    far = np.clip(distance[back] + error[back], 0.0, None)
    points = np.column_stack([direction[back] * far[:, None], np.exp(-ATTENUATION * far)])
    return points.astype(np.float32), back
