"""The ground in a camera's picture that headlights light."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int, UInt8

from inspe_jax.simulation.embedded.headlights import (
    COLOUR,
    PEAK,
    REAR,
    GroundMap,
    beams_of,
    dipped,
)
from inspe_jax.simulation.embedded.road_users import FrameActors
from inspe_jax.simulation.embedded.shading import Shading
from inspe_jax.simulation.embedded.static_look import OF_LABEL
from inspe_jax.simulation.embedded.static_world import StaticWorld
from inspe_jax.simulation.embedded.sunlit import PlanPoints
from inspe_jax.simulation.embedded.wet_road import Wetness, glints, wetness_on

STREAK = 0.25, 3.0, 1.2
"""The reflection of a lamp in a wet road is looked for on this share of the way from below the lamp
to below the camera, at least so far [m], and so far to either side [m]. It fades over its far half.
"""

FURTHEST = 40.0
"""Lamps that are further from a camera in plan are not mirrored [m]."""
DIM = 2e-4
"""Reflections that are left out: they change a picture by less than one of 256 steps."""


class LitGround:
    """Those of R pixels that show ground on the map of headlights, and how it looks.

    ``point`` is what each pixel shows, relative to the centre, and ``distance`` how far it is [m];
    ``semantic`` is CARLA's label of it.
    """

    def __init__(
        self,
        ground: GroundMap,
        static_world: StaticWorld,
        shading: Shading,
        point: Float[np.ndarray, "R 3"],
        distance: Float[np.ndarray, " R"],
        semantic: UInt8[np.ndarray, " R"],
    ) -> None:
        self.ground, self.shading = ground, shading
        level = np.isin(semantic, [*OF_LABEL.values()])
        cell = ground.cells(point)
        self.pixels = np.flatnonzero(level & (cell >= 0))
        self.cell = cell[self.pixels]
        self.point = point[self.pixels]
        self.wet: Wetness = wetness_on(static_world, self.point, shading.wet)
        world = self.point[:, :2] + static_world.center[:2]
        albedo = static_world.surface.albedo(world) * (1 - self.wet.darker)[:, None]
        lamps = np.float32(shading.light.lamps)
        self.clear = np.exp(-np.float32(shading.haze) * distance[self.pixels])
        if shading.wet > 0:
            self.plan = PlanPoints(self.point, np.ones(len(self.pixels), bool), ground.reach)
        self.look = (albedo * (lamps * COLOUR * self.clear[:, None])).astype(np.float32)

    def added(
        self, actors: FrameActors, origin: Float[np.ndarray, "3"]
    ) -> tuple[Int[np.ndarray, " P"], Float[np.ndarray, "P 3"]]:
        """The pixels that headlights and tail lamps make brighter, each once, and by how much.

        ``origin`` is the camera's place, relative to the centre [m].
        """
        light = actors.once(self.ground.fine).take(self.cell)
        own = np.flatnonzero(light)
        colour = light[own, None] * self.look.take(own, axis=0)
        if self.shading.wet == 0:
            return self.pixels[own], colour
        whole = np.zeros((len(self.pixels), 3), np.float32)
        whole[own] = colour
        touched = light > 0
        for near, shine in self._mirrored(actors, origin):
            whole[near] += shine
            touched[near] = True
        own = np.flatnonzero(touched)
        return self.pixels[own], whole[own]

    def _mirrored(
        self, actors: FrameActors, origin: Float[np.ndarray, "3"]
    ) -> Iterator[tuple[Int[np.ndarray, " N"], Float[np.ndarray, "N 3"]]]:
        """For each lamp, which of the L pixels of ground mirror it, and its light there."""
        beams, (_, caster) = actors.once(beams_of), actors.at(0.0)
        share, least, aside = STREAK
        for k, (front, rear) in enumerate(zip(beams.front, beams.rear, strict=True)):
            for lamp in (front, rear):
                way = origin[:2] - lamp[:2]
                far = float(np.hypot(*way))
                ahead = float(beams.ahead[k] @ way) > 0
                if ahead != (lamp is front) or far < 1 or far > FURTHEST:
                    continue  # it shines away from the camera
                unit, normal = way / far, np.array([0, 0, 1], np.float32)
                long = max(share * far, least)
                ends = lamp[:2], lamp[:2] + long * unit
                near = self.plan.within(np.min(ends, 0) - 0.5, np.max(ends, 0) + 0.5)
                offset = self.point[near, :2] - lamp[:2]
                along, across = offset @ unit, offset @ np.array([-unit[1], unit[0]], np.float32)
                inside = (along < long) & (np.abs(across) < aside)
                near, fade = near[inside], np.minimum(1, 2 - 2 * along[inside] / long)
                point = self.point[near]
                to = point - origin
                to /= np.linalg.norm(to, axis=1, keepdims=True)
                up = np.broadcast_to(normal, point.shape)
                shine = glints(self.wet.at(near), point, up, to, lamp)
                bright = REAR[None]
                if lamp is front:
                    leaving = point - lamp
                    squared = np.einsum("rk,rk->r", leaving, leaving)
                    beam = dipped(leaving, squared, beams.ahead[k]) * np.maximum(squared, 1)
                    bright = np.float32(PEAK) * beam[:, None] * COLOUR
                lamps = np.float32(self.shading.light.lamps) * self.clear[near] * fade
                colour = (lamps * shine)[:, None] * bright
                some = np.flatnonzero(colour[:, 0] > DIM)
                start = point[some] + np.array([0, 0, 0.05], np.float32)
                free = some[~caster.meets(start, lamp - start, 0.95)]
                yield near[free], colour[free]
