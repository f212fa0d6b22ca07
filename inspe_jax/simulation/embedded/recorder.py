"""The embedded recorder: simulates the sensors of a layout in a world of triangles."""

from dataclasses import replace

import numpy as np

from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.simulation.embedded.embree import Caster
from inspe_jax.simulation.embedded.headlights import GroundMap
from inspe_jax.simulation.embedded.road_users import FrameActors, boxes_at, boxes_of
from inspe_jax.simulation.embedded.sensors import simulated_sensor
from inspe_jax.simulation.embedded.shading import Shading
from inspe_jax.simulation.embedded.static_world import build_static_world
from inspe_jax.simulation.embedded.surroundings import Surroundings
from inspe_jax.simulation.frame import Frame
from inspe_jax.simulation.parked import parked_vehicles
from inspe_jax.simulation.recorder import Recording, stations_of

BELOW = 2.5
"""A mast ends this far below the lowest sensor of its unit [m], so that no sensor sees it."""


class EmbeddedRecorder:
    """Records a scene's traffic with ray casting; it needs Embree, but no simulator.

    Raises InspeError where Embree is missing, the recording is not valid, or a sensor is of a kind
    that this recorder does not know.

    ``seed`` is that of the sensors' noise; ``appearance_seed`` that of the road users' shapes and
    colours, which so may be the same under other layouts and in other light.
    """

    notes: tuple[str, ...] = ()

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        conditions: Conditions = FAIR,
        recording: Recording | None = None,
        seed: int = 0,
        appearance_seed: int = 0,
    ) -> None:
        self.recording = recording or Recording()
        self.recording.check()
        self.scene, self.seed, self.appearance_seed = scene, seed, appearance_seed
        layout = conditions.layout(layout)
        poses = np.asarray(layout.poses, float)
        self.layout = layout
        parked, statics = parked_vehicles(scene)
        self.parked = tuple(replace(b, parked=True) for b in boxes_of(parked, appearance_seed))
        self.static_world = build_static_world(
            scene.intersection, scene.voxels.radius, _masts(layout, poses), statics
        )
        self.static_caster = Caster(self.static_world.triangles)
        shading = Shading(conditions, self.static_world.poles - self.static_world.center)
        place = scene.intersection, scene.voxels.radius
        ground = GroundMap(*place, shading.light) if shading.light.lamps > 0 else None
        surroundings = Surroundings(
            self.static_world, self.static_caster, shading, self.recording, appearance_seed, ground
        )
        self.sensors = [
            simulated_sensor(sensor.spec, pose, surroundings)
            for sensor, pose in zip(layout.sensors, poses, strict=True)
        ]

    def frame(self, t: int) -> Frame:
        """Frame t of the scene's traffic, as every station recorded it."""
        boxes = boxes_at(self.scene.traffic, t, self.appearance_seed) + self.parked
        actors = FrameActors(boxes, self.static_world.center)
        recorded = [
            sensor.record(actors, np.random.default_rng([self.seed, t, s, 3]))
            for s, sensor in enumerate(self.sensors)
        ]
        stations = stations_of(self.layout, recorded)
        return Frame(t, float(self.scene.traffic.time[t]), boxes, stations)


def _masts(layout: Layout, poses: np.ndarray) -> np.ndarray:
    """Foot (x, y, z) and height of each unit's mast, (U, 4) [m]."""
    heights = [min(poses[s, 2] for s in members) - BELOW for members in layout.members()]
    return np.array(
        [
            (*unit.base, max(height - unit.base[2], 0.5))
            for unit, height in zip(layout.units, heights, strict=True)
        ]
    )
