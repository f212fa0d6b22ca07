"""What all sensors of an embedded recorder share."""

from dataclasses import dataclass, replace

import numpy as np

from inspe_jax.scene.scene import Scene
from inspe_jax.scene.traffic.frames import TrafficFrames
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.simulation.embedded.embree import Caster, check_embree
from inspe_jax.simulation.embedded.headlights import GroundMap
from inspe_jax.simulation.embedded.road_users import FrameActors, boxes_of
from inspe_jax.simulation.embedded.shading import Shading
from inspe_jax.simulation.embedded.static_world import StaticWorld, build_static_world
from inspe_jax.simulation.frame import RoadUserBox
from inspe_jax.simulation.parked import parked_vehicles
from inspe_jax.simulation.recorder import Recording

BELOW = 2.5
"""A mast ends this far below the lowest sensor of its unit [m], so that no sensor sees it."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The world around the sensors, its light, and what is to be recorded.

    ``static_caster`` casts rays into the triangles of ``static_world``. ``appearance_seed`` is that
    of the road users' shapes and colours: of the ``traffic``'s, and of those that are ``parked`` in
    all frames. ``ground`` is where their headlights are followed, None by day.
    """

    static_world: StaticWorld
    static_caster: Caster
    shading: Shading
    recording: Recording
    appearance_seed: int
    traffic: TrafficFrames
    parked: tuple[RoadUserBox, ...]
    ground: GroundMap | None = None

    def actors(self, t: int) -> FrameActors:
        """The road users of frame t."""
        boxes = boxes_of(self.traffic.at(t), self.appearance_seed) + self.parked
        return FrameActors(boxes, self.static_world.center)


def surroundings_of(
    scene: Scene,
    layout: Layout,
    conditions: Conditions,
    recording: Recording | None = None,
    appearance_seed: int = 0,
    *,
    mastless: int | None = None,
) -> Surroundings:
    """The surroundings of a layout's sensors in a scene: with a mast for each unit, except for the
    unit ``mastless``.

    Raises InspeError where the recording is not valid, or Embree is missing.
    """
    recording = recording or Recording()
    recording.check()
    check_embree()
    parked, statics = parked_vehicles(scene)
    place = scene.intersection, scene.voxels.radius
    static_world = build_static_world(*place, _masts(layout, mastless), statics)
    shading = Shading(conditions, static_world.poles - static_world.center)
    return Surroundings(
        static_world,
        Caster(static_world.triangles),
        shading,
        recording,
        appearance_seed,
        scene.traffic,
        tuple(replace(box, parked=True) for box in boxes_of(parked, appearance_seed)),
        GroundMap(*place, shading.light) if shading.light.lamps > 0 else None,
    )


def _masts(layout: Layout, mastless: int | None) -> np.ndarray:
    """Foot (x, y, z) and height of the mast of each unit that carries sensors, (M, 4) [m]."""
    poses = np.asarray(layout.poses, float)
    masts = [
        (*unit.base, max(poses[list(members), 2].min() - BELOW - unit.base[2], 0.5))
        for u, (unit, members) in enumerate(zip(layout.units, layout.members(), strict=True))
        if members and u != mastless
    ]
    return np.array(masts, float).reshape(-1, 4)
