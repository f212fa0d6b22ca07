"""Wet roads: darker, and with a film of water that mirrors the sky and the surroundings.

Water that fills the pores lets less light out again (Lekner and Dorf, "Why some things are darker
when wet", Applied Optics 27, 1988). The film over it reflects as water does (Fresnel, in the form
of Schlick 1994). On most of the road the grains of the asphalt roughen it; in puddles it is smooth.
The lamps themselves are not mirrored.
"""

import numpy as np
from jaxtyping import Bool, Float

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


def paved(static_world: StaticWorld, point: Float[np.ndarray, "R 3"]) -> Bool[np.ndarray, " R"]:
    """Whether the ground at points of it is paved, and so wet in rain."""
    label: np.ndarray = static_world.surface.label(point[:, :2] + static_world.center[:2])
    return label != GRASS


def reflected(
    static_world: StaticWorld,
    caster: Caster,
    shading: Shading,
    point: Float[np.ndarray, "R 3"],
    normal: Float[np.ndarray, "R 3"],
    to: Float[np.ndarray, "R 3"],
) -> Float[np.ndarray, "R 3"]:
    """What the film on paved ground reflects of sky and surroundings along rays ``to`` points."""
    world = point[:, :2] + static_world.center[:2]
    level = 0.7 * noise(world / 1.8) + 0.3 * noise(world / 0.5)
    low, high = LEVEL
    part = np.clip((level - low) / (high - low), 0, 1)
    puddle = part * part * (3 - 2 * part)
    film = np.float32(shading.wet) * (COVER + (1 - COVER) * puddle)
    slope = ROUGH + (SMOOTH - ROUGH) * puddle
    along = -np.einsum("rk,rk->r", to, normal)
    # Seen at a grazing angle, those facets of a rough film are seen that lean towards the eye.
    steep = np.sqrt(along**2 + slope**2)
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
    return (film * reflectance)[:, None] * light
