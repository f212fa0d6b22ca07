"""The colours of surfaces, lit by sun, sky and street lamps, and seen through the air. Wet roads
are darker (Lekner and Dorf 1988), and reflect as water does (Schlick 1994)."""

import numpy as np
from jaxtyping import Float

from inspe_jax.sensing.conditions import Conditions
from inspe_jax.simulation.embedded.embree import R3
from inspe_jax.simulation.embedded.light import LAMP, LIGHTS, haze, parts, wetness
from inspe_jax.simulation.embedded.static_world import StaticWorld
from inspe_jax.simulation.embedded.surface import noise

LAMP_ABOVE = 1.5  # height of street lamps above the tops of the poles [m]
FAR = 1000.0
"""Range of cameras in clear air [m]. How far they can detect road users matters to scores only."""

DARKER = 0.45
"""Share of the albedo that a soaked road loses: rough asphalt, by Lekner and Dorf's model."""
HEAD_ON = 0.02  # reflectance of water along the normal (refractive index 1.33)
ROUGH, SMOOTH = 0.12, 0.04
"""Root-mean-square slope of the film, on the grains of asphalt and in puddles."""
COVER = 0.12  # share of the film that shines between the grains; in puddles all of it does
LEVEL = (0.6, 0.76)
"""Where the noise of a road's unevenness begins to hold water, and where it holds a puddle."""


class Shading:
    """The light in a static world, linear, in single precision; points are from its centre [m]."""

    def __init__(self, conditions: Conditions, static_world: StaticWorld) -> None:
        self.static_world = static_world
        self.light, self.haze = LIGHTS[conditions.light], haze(conditions)
        self.wet = wetness(conditions)
        self.to_sun = self.light.to_sun.astype(np.float32)
        self.sun, self.ambient, self.sky_colour = (
            np.array(colour, np.float32)
            for colour in (self.light.sun, self.light.ambient, self.light.sky)
        )
        poles = static_world.poles - static_world.center
        self.lamps = (poles + [0.0, 0.0, LAMP_ABOVE]).astype(np.float32)
        self.lamp_colour = np.float32(self.light.lamps) * np.array(LAMP, np.float32)

    def sunlight(self, normal: R3, albedo: R3) -> R3:
        """Sunlight that surfaces reflect if nothing is in its way (Lambert)."""
        facing = np.maximum(normal @ self.to_sun, 0)
        direct: np.ndarray = albedo * facing[:, None] * self.sun
        return direct

    def ambient_light(self, point: R3, normal: R3, albedo: R3) -> R3:
        """All other light that surfaces reflect: from the sky and from street lamps."""
        light = (0.65 + 0.35 * normal[:, 2:]) * self.ambient
        if self.light.lamps > 0 and len(self.lamps):
            light += self._lamplight(point, normal)[:, None] * self.lamp_colour
        return albedo * light

    def _lamplight(self, point: R3, normal: R3) -> Float[np.ndarray, " R"]:
        """Σ n·d / (|d|² + 1)^(3/2) over the vectors d to the lamps [m]: far away cos θ / r²."""
        found = np.empty(len(point), np.float32)
        own = (self.lamps**2).sum(1) + 1
        for at in parts(len(point)):
            p, n = point[at], normal[at]
            squared = p @ (-2 * self.lamps.T)  # changed in place: most of the time is memory's
            squared += np.einsum("rk,rk->r", p, p)[:, None]
            squared += own
            np.maximum(squared, 1, out=squared)
            light = n @ self.lamps.T
            light -= np.einsum("rk,rk->r", p, n)[:, None]
            np.maximum(light, 0, out=light)
            light /= squared
            light /= np.sqrt(squared, out=squared)
            found[at] = light.sum(1)
        return found

    def sky(self, directions: R3) -> R3:
        """Colour of the sky: paler towards the horizon, with a glow around the sun."""
        up = np.sqrt(np.clip(directions[:, 2:], 0, 1))
        colour = self.sky_colour * (1.25 - 0.55 * up)
        if self.light.has_sun:
            toward = np.clip(directions @ self.to_sun, 0, 1)[:, None]
            colour += self.sun * (0.3 * toward**8 + 2.0 * toward**400)
        return colour

    def mirrored(self, head_on: Float[np.ndarray, " R"], to: R3, normal: R3) -> R3:
        """Light of the sky that lacquer and glass mirror, more at grazing angles (Schlick 1994)."""
        along = np.einsum("rk,rk->r", to, normal)
        grazing = head_on * (1 + (1 / 0.04 - 1) * (1 + np.minimum(along, 0)) ** 5)
        up = to[:, 2] - 2 * along * normal[:, 2]
        return (grazing * np.clip(0.25 + 1.5 * up, 0.1, 1))[:, None] * self.sky_colour

    def reflected(self, point: R3, normal: R3, to: R3) -> R3:
        """What the film on paved ground reflects of sky and surroundings at the ends of ``to``."""
        world = point[:, :2] + self.static_world.center[:2]
        level = 0.7 * noise(world / 1.8) + 0.3 * noise(world / 0.5)
        low, high = LEVEL
        part = np.clip((level - low) / (high - low), 0, 1)
        puddle = part * part * (3 - 2 * part)
        film = np.float32(self.wet) * (COVER + (1 - COVER) * puddle)
        slope = ROUGH + (SMOOTH - ROUGH) * puddle
        along = -np.einsum("rk,rk->r", to, normal)
        # Seen at a grazing angle, those facets of a rough film are seen that lean towards the eye.
        steep = np.sqrt(along**2 + slope**2)
        onward = to + (along + steep)[:, None] * normal
        onward /= np.linalg.norm(onward, axis=1, keepdims=True)
        hits = self.static_world.caster.cast(point + np.float32(0.02) * normal, onward, FAR)
        there = point + onward * np.where(hits.face >= 0, hits.distance, 0)[:, None]
        albedo, _ = self.static_world.look(hits.face, there, hits.normal)
        light = self.ambient_light(there, hits.normal, albedo)
        light += 0.5 * self.sunlight(hits.normal, albedo)  # half of what there is: no shadows here
        clear = hits.face < 0
        light[clear] = self.sky(onward[clear])
        reflectance = HEAD_ON + (1 - HEAD_ON) * (1 - np.clip(steep, 0, 1)) ** 5
        return (film * reflectance)[:, None] * light

    def through_air(self, colour: R3, distance: Float[np.ndarray, " R"]) -> R3:
        """Colours as they appear from a distance [m], which may be infinite (Koschmieder 1924)."""
        if not self.haze:
            return colour
        clear = np.exp(-np.float32(self.haze) * np.minimum(distance, FAR))[:, None]
        veil = self.ambient * 0.9 + 0.15 * self.sun
        return colour * clear + veil * (1 - clear)
