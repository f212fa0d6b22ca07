"""What the sensors of a layout record in a world of triangles, frame by frame."""

import numpy as np

from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec
from inspe_jax.simulation.embedded.camera import Camera
from inspe_jax.simulation.embedded.embree import Caster
from inspe_jax.simulation.embedded.lidar import Lidar
from inspe_jax.simulation.embedded.road_users import FrameActors, boxes_at
from inspe_jax.simulation.embedded.shading import Shading
from inspe_jax.simulation.embedded.static_world import build_static_world
from inspe_jax.simulation.frame import Frame, Image, Scan
from inspe_jax.simulation.recorder import Recording, recordable, stations_of

BELOW = 2.5
"""A mast ends so far beneath its unit's lowest sensor [m], out of the sensors' sight."""


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
        specs = [recordable(sensor.spec) for sensor in layout.sensors]
        poses = np.asarray(layout.poses, float)
        self.layout = layout
        self.statics = build_static_world(
            scene.intersection, scene.voxels.radius, _masts(layout, poses)
        )
        self.still = Caster(self.statics.triangles)
        shading = Shading(conditions, self.statics.poles - self.statics.center)
        scale = self.recording.image_scale
        self.sensors: list[Camera | Lidar] = [
            Camera(spec, pose, self.statics, self.still, shading, scale)
            if isinstance(spec, CameraSpec)
            else Lidar(spec, pose, self.statics, self.still)
            for spec, pose in zip(specs, poses, strict=True)
        ]

    def frame(self, t: int) -> Frame:
        """Frame t, as every station recorded it."""
        things = boxes_at(self.scene.traffic, t, self.seed)
        company = FrameActors(things, self.statics.center)
        seen: list[Image | Scan] = []
        for s, sensor in enumerate(self.sensors):
            rng = np.random.default_rng([self.seed, t, s, 3])
            if isinstance(sensor, Camera):
                seen.append(sensor.image(company, self.seed, rng, self.recording.layers))
            else:
                returns = sensor.cast(company, 1.0 / self.recording.rate)
                seen.append(sensor.scan(returns, self.recording.noise, rng))
        return Frame(t, float(self.scene.traffic.time[t]), things, stations_of(self.layout, seen))


def _masts(layout: Layout, poses: np.ndarray) -> np.ndarray:
    """Foot and height of each unit's mast (U, 4): it ends beneath what its own sensors see."""
    heights = [min(poses[s, 2] for s in members) - BELOW for members in layout.members()]
    return np.array(
        [
            (*unit.base, max(height - unit.base[2], 0.5))
            for unit, height in zip(layout.units, heights, strict=True)
        ]
    )
