"""What all sensors of an embedded recorder share."""

from dataclasses import replace

import numpy as np

from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.simulation.embedded.headlights import GroundMap
from inspe_jax.simulation.embedded.road_users import FrameActors, boxes_of, parked_vehicles
from inspe_jax.simulation.embedded.shading import Shading
from inspe_jax.simulation.embedded.static_world import build_static_world
from inspe_jax.simulation.recorder import Recording

BELOW = 2.5
"""A mast ends this far below the lowest sensor of its unit [m], so that no sensor sees it."""


class Surroundings:
    """The world around a layout's sensors, with a mast for each unit but ``mastless``, its light,
    and what is recorded; ``ground`` is where headlights are followed, None by day."""

    def __init__(
        self,
        scene: Scene,
        layout: Layout,
        conditions: Conditions,
        recording: Recording | None = None,
        appearance_seed: int = 0,
        *,
        mastless: int | None = None,
    ) -> None:
        self.recording, self.appearance_seed = recording or Recording(), appearance_seed
        self.recording.check()
        self.traffic = scene.traffic
        parked, statics = parked_vehicles(scene)
        boxes = boxes_of(parked, appearance_seed)
        self.parked = tuple(replace(box, parked=True) for box in boxes)
        place, up = (scene.intersection, scene.voxels.radius), np.asarray(layout.poses, float)[:, 2]
        masts = [
            (*unit.base, max(up[list(members)].min() - BELOW - unit.base[2], 0.5))
            for u, (unit, members) in enumerate(zip(layout.units, layout.members(), strict=True))
            if members and u != mastless
        ]  # foot (x, y, z) and height [m]
        standing = np.array(masts, float).reshape(-1, 4)
        self.static_world = build_static_world(*place, standing, statics)
        self.caster = self.static_world.caster  # which needs Embree, and says so now
        self.shading = Shading(conditions, self.static_world)
        light = self.shading.light
        self.ground = GroundMap(*place, light) if light.lamps > 0 else None

    def actors(self, t: int) -> FrameActors:
        """The road users of frame t."""
        boxes = boxes_of(self.traffic.at(t), self.appearance_seed) + self.parked
        return FrameActors(boxes, self.static_world.center)
