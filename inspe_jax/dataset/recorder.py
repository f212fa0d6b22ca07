"""What the sensors of a layout record of a scene, frame by frame.

Made-up pictures and points for the time being: what moves is the scene's.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from inspe_jax.dataset.record import Frame, Image, Scan, Station, Thing
from inspe_jax.errors import InspeError
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.traffic import CLASSES
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout


@dataclass(frozen=True)
class Recording:
    """What to record beside the scene: all that is needed to make it again.

    ``rate`` in frames a second [Hz]; ``layers`` of depth, instance and semantic; ``image_scale``
    of the cameras' own resolution.
    """

    rate: float = 10.0
    layers: tuple[str, ...] = ()
    image_scale: float = 1.0


class Recorder(Protocol):
    """What gives frames, each the same whenever it is asked for."""

    def frame(self, t: int) -> Frame:
        """Frame ``t`` of the scene's traffic."""


@dataclass(frozen=True)
class _MadeUp:
    scene: Scene
    layout: Layout
    recording: Recording
    seed: int

    def frame(self, t: int) -> Frame:
        rng = np.random.default_rng([self.seed, t])
        traffic = self.scene.traffic
        things = tuple(
            Thing(
                track=int(traffic.track[t, b]),
                kind=CLASSES[traffic.kind[t, b]],
                name=CLASSES[traffic.kind[t, b]],
                center=traffic.center[t, b],
                yaw=float(traffic.yaw[t, b]),
                size=traffic.size[t, b],
                velocity=traffic.velocity[t, b],
            )
            for b in np.flatnonzero(traffic.valid[t])
        )
        return Frame(t, t / self.recording.rate, things, tuple(self._stations(rng)))

    def _stations(self, rng: np.random.Generator) -> Iterator[Station]:
        poses = np.asarray(self.layout.poses, float)
        for u, (unit, members) in enumerate(
            zip(self.layout.units, self.layout.members(), strict=True)
        ):
            cameras = [s for s in members if self.layout.sensors[s].spec.kind == "camera"]
            lidars = [s for s in members if s not in cameras]
            points = rng.uniform([-20, -20, -7, 0], [20, 20, -1, 1], (50, 4))
            yield Station(
                number=u + 1,
                name=unit.name,
                pose=np.array([*unit.base, 0, 0, 0]),
                images=tuple(self._image(poses[s], rng) for s in cameras),
                scans=tuple(Scan(poses[s], points.astype(np.float32)) for s in lidars),
            )

    def _image(self, pose: np.ndarray, rng: np.random.Generator) -> Image:
        layers: dict[str, Any] = {
            "depth": np.full((6, 8), 10, np.float32),
            "instance": np.zeros((6, 8), np.int32),
            "semantic": np.zeros((6, 8), np.uint8),
        }
        return Image(
            pose=pose,
            intrinsic=np.array([[5.0, 0, 4], [0, 5.0, 3], [0, 0, 1]]),
            rgb=rng.integers(0, 256, (6, 8, 3)).astype(np.uint8),
            **{key: layers[key] for key in self.recording.layers},
        )


def recorder_of(
    backend: str,
    scene: Scene,
    layout: Layout,
    conditions: Conditions,
    recording: Recording,
    seed: int,
) -> AbstractContextManager[Recorder]:
    """A recorder of a layout on a scene. Raises InspeError where the backend cannot be had."""
    if backend != "embedded":
        raise InspeError(f"backend '{backend}' cannot be had yet")

    @contextmanager
    def opened() -> Iterator[Recorder]:
        yield _MadeUp(scene, layout, recording, seed)

    return opened()
