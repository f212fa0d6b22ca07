"""Wet roads: darker, and with a film of water that mirrors the sky and the surroundings.

Water that fills the pores lets less light out again (Lekner and Dorf, "Why some things are darker
when wet", Applied Optics 27, 1988). The film over it reflects as water does (Fresnel, in the form
of Schlick 1994). On most of the road the grains of the asphalt roughen it; in puddles it is smooth.
The lamps themselves are not mirrored.
"""

from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.simulation.embedded import materials
from inspe_jax.simulation.embedded.embree import Caster
from inspe_jax.simulation.embedded.shading import FAR, Shading
from inspe_jax.simulation.embedded.static_look import static_look
from inspe_jax.simulation.embedded.static_world import StaticWorld
from inspe_jax.simulation.embedded.surface import GRASS, noise

DARKER = 0.45
"""Share of the albedo that a soaked road loses: rough asphalt, by Lekner and Dorf's model."""
HEAD_ON = 0.02
"""Reflectance of water along the normal (refractive index 1.33)."""
ROUGH, SMOOTH = 0.12, 0.04
"""Root-mean-square slope of the film, on the grains of asphalt and in puddles."""
COVER = 0.12
"""Share of the film that shines between the grains; in puddles all of it does."""
LEVEL = (0.6, 0.76)
"""Where the noise of a road's unevenness begins to hold water, and where it holds a puddle."""


class Wetness(NamedTuple):
    """Of R points: the share of the albedo that is lost, how much of the film shines (0 … 1), and
    the slope of the film. All are 0 where the ground is not paved."""

    darker: Float[np.ndarray, " R"]
    film: Float[np.ndarray, " R"]
    slope: Float[np.ndarray, " R"]

    def at(self, index: Int[np.ndarray, " P"]) -> Self:
        """Those of some points."""
        return type(self)(*(part[index] for part in self))


def wetness_at(
    static_world: StaticWorld,
    face: Int[np.ndarray, " R"],
    point: Float[np.ndarray, "R 3"],
    wet: float,
) -> Wetness:
    """How wet the static world is at points on its faces (−1: none) when roads are ``wet``, of 1.

    Paved ground is wet; all else stays as it is.
    """
    whole = Wetness(*(np.zeros(len(face), np.float32) for _ in Wetness._fields))
    if wet > 0:
        ground = np.flatnonzero((face >= 0) & (static_world.material[face] == materials.GROUND))
        for into, own in zip(whole, wetness_on(static_world, point[ground], wet), strict=True):
            into[ground] = own
    return whole


def wetness_on(static_world: StaticWorld, point: Float[np.ndarray, "R 3"], wet: float) -> Wetness:
    """How wet the ground is at points of it, relative to the centre [m]."""
    world = point[:, :2] + static_world.center[:2]
    paved = (static_world.surface.label(world) != GRASS).astype(np.float32)
    level = 0.7 * noise(world / 1.8) + 0.3 * noise(world / 0.5)
    low, high = LEVEL
    part = np.clip((level - low) / (high - low), 0, 1)
    puddle = part * part * (3 - 2 * part)
    film = COVER + (1 - COVER) * puddle
    slope = ROUGH + (SMOOTH - ROUGH) * puddle
    return Wetness(DARKER * wet * paved, wet * paved * film, paved * slope)


def reflected(
    static_world: StaticWorld,
    caster: Caster,
    shading: Shading,
    wet: Wetness,
    point: Float[np.ndarray, "R 3"],
    normal: Float[np.ndarray, "R 3"],
    to: Float[np.ndarray, "R 3"],
) -> Float[np.ndarray, "R 3"]:
    """What the film reflects of sky and surroundings along rays ``to`` the points."""
    along = -np.einsum("rk,rk->r", to, normal)
    # Seen at a grazing angle, those facets of a rough film are seen that lean towards the eye.
    steep = np.sqrt(along**2 + wet.slope**2)
    onward = to + (along + steep)[:, None] * normal
    onward /= np.linalg.norm(onward, axis=1, keepdims=True)
    hits = caster.cast(point + np.float32(0.02) * normal, onward, FAR)
    there = point + onward * np.where(hits.face >= 0, hits.distance, 0)[:, None]
    albedo, _ = static_look(static_world, hits.face, there, hits.normal)
    light = shading.ambient_light(there, hits.normal, albedo)
    light += 0.5 * shading.sunlight(hits.normal, albedo)  # half of what there is: no shadows here
    clear = hits.face < 0
    light[clear] = shading.sky(onward[clear])
    reflectance = HEAD_ON + (1 - HEAD_ON) * (1 - np.clip(steep, 0, 1)) ** 5
    return (wet.film * reflectance)[:, None] * light
