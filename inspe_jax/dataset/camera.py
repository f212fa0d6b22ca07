"""A camera in the triangles: a ray through every pixel, shaded by sun, sky and street lamps.

What stands still is met and shaded once for each camera. In each frame only those pixels are looked
at anew that a road user or its shadow may fall on.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.dataset.embree import Caster
from inspe_jax.dataset.light import LAMP, developed, haze, light_of
from inspe_jax.dataset.movers import Company, Movers, paints
from inspe_jax.dataset.projection import corners
from inspe_jax.dataset.record import Image, Thing
from inspe_jax.dataset.shapes import PARTS
from inspe_jax.dataset.statics import (
    BUILDING,
    CROWN,
    GROUND,
    KERB,
    POLE,
    ROOF,
    TRUNK,
    Statics,
)
from inspe_jax.dataset.surface import GRASS, PAINT, noise
from inspe_jax.geometry import rotation
from inspe_jax.scene.regions import Region
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.sensors import CameraSpec

FAR = 1000.0
"""Cameras see so far [m], but for haze; how far they perceive is the scores' business."""
SHADOWED = 150.0
"""Shadows of road users are looked for so far from the centre [m]."""
SKY = 11
SEMANTIC = {"car": 14, "truck": 15, "cyclist": 19, "pedestrian": 12}
"""CARLA's labels (0.9.14 and later) of the classes."""
_OF_MATERIAL = {KERB: 2, BUILDING: 3, ROOF: 3, TRUNK: 9, CROWN: 9, POLE: 6}
_OF_LABEL = {
    Region.DRIVEWAY: 1,
    Region.JUNCTION: 1,
    Region.CROSSWALK: 1,
    Region.SIDEWALK: 2,
    Region.SHOULDER: 25,
    GRASS: 10,
    PAINT: 24,
}
_GLOSS = np.zeros(len(PARTS))
for _part, _share in (("body", 0.04), ("window", 0.09), ("cargo", 0.02), ("lamp", 0.06)):
    _GLOSS[PARTS.index(_part)] = _share
_GLOW = {"lamp": np.array([1.0, 0.95, 0.85]), "lamp rear": np.array([0.5, 0.02, 0.02])}


class Ground(NamedTuple):
    """What lies behind every pixel when nobody is there: R pixels, row by row."""

    distance: Float[np.ndarray, " R"]
    point: Float[np.ndarray, "R 3"]
    direct: Float[np.ndarray, "R 3"]
    other: Float[np.ndarray, "R 3"]
    semantic: Int[np.ndarray, " R"]


class Cells:
    """Points (R, 3) sorted by the square metre that each is over, those in the sun alone."""

    def __init__(self, point: np.ndarray, lit: np.ndarray, reach: float) -> None:
        self.reach, self.size = reach, int(2 * reach)
        pixels = np.flatnonzero(lit & (np.abs(point[:, :2]) < reach).all(1))
        cell = np.floor(point[pixels, :2] + reach).astype(int)
        number = cell[:, 1] * self.size + cell[:, 0]
        order = np.argsort(number, kind="stable")
        self.pixels = pixels[order]
        self.start = np.searchsorted(number[order], np.arange(self.size**2 + 1))

    def within(self, low: np.ndarray, high: np.ndarray) -> Int[np.ndarray, " P"]:
        """Those over the squares that a rectangle touches."""
        x0, y0 = np.clip(np.floor(low + self.reach), 0, self.size - 1).astype(int)
        x1, y1 = np.clip(np.floor(high + self.reach), 0, self.size - 1).astype(int)
        rows = np.arange(y0, y1 + 1) * self.size
        runs = zip(self.start[rows + x0], self.start[rows + x1 + 1], strict=True)
        return np.concatenate([self.pixels[a:b] for a, b in runs])


class Camera:
    """One camera at its place, in one light."""

    def __init__(
        self,
        spec: CameraSpec,
        pose: Float[np.ndarray, "6"],
        statics: Statics,
        still: Caster,
        conditions: Conditions,
        scale: float = 1.0,
    ) -> None:
        self.pose, self.statics, self.still_caster = np.asarray(pose, float), statics, still
        self.light, self.haze = light_of(conditions), haze(conditions)
        self.height, self.width = (max(1, round(n * scale)) for n in (spec.height, spec.width))
        across, down = self.width / spec.width, self.height / spec.height
        self.intrinsic = np.array(
            [
                [spec.focal * across, 0.0, spec.principal[0] * across],
                [0.0, spec.focal * down, spec.principal[1] * down],
                [0.0, 0.0, 1.0],
            ]
        )
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        (fx, _, cx), (_, fy, cy), _ = self.intrinsic
        body = np.stack([np.ones_like(u), (cx - u) / fx, (cy - v) / fy], -1).reshape(-1, 3)
        self.ahead = 1.0 / np.linalg.norm(body, axis=1)  # depth along the axis for 1 m of ray
        self.turn = rotation(self.pose[3:], np)
        self.directions = ((body * self.ahead[:, None]) @ self.turn.T).astype(np.float32)
        self.origin = self.pose[:3] - statics.center
        self.ground = self._behind()
        self.sunny = Cells(self.ground.point, self.ground.direct.max(1) > 0, SHADOWED)

    # ── What stands still ───────────────────────────────────────────────────

    def _behind(self) -> Ground:
        hits = self.still_caster.cast(self.origin, self.directions, FAR)
        met = hits.face >= 0
        point = self.origin + self.directions * np.where(met, hits.distance, 0.0)[:, None]
        albedo, semantic = _still_look(self.statics, hits.face, point, hits.normal)
        direct, other = self._lit(point, hits.normal, albedo)
        sky = self._sky()
        direct[~met], other[~met] = 0.0, sky[~met]
        shaded = np.flatnonzero(met & (direct.max(1) > 0))
        direct[shaded[self._dark(self.still_caster, point[shaded], hits.normal[shaded])]] = 0.0
        return Ground(
            hits.distance,
            point.astype(np.float32),
            direct.astype(np.float32),
            other.astype(np.float32),
            np.where(met, semantic, SKY),
        )

    def _sky(self) -> Float[np.ndarray, "R 3"]:
        """Paler towards the horizon; a glow about the sun."""
        up = np.clip(self.directions[:, 2], 0, 1)[:, None] ** 0.5
        colour = np.array(self.light.sky) * (1.25 - 0.55 * up)
        if self.light.has_sun:
            toward = np.clip(self.directions @ self.light.to_sun, 0, 1)[:, None]
            colour = colour + np.array(self.light.sun) * (0.3 * toward**8 + 2.0 * toward**400)
        return colour

    # ── Shading ─────────────────────────────────────────────────────────────

    def _lit(
        self, point: np.ndarray, normal: np.ndarray, albedo: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(light of the sun if nothing is in its way, all other light) that points send back."""
        light = self.light
        direct = albedo * np.array(light.sun)
        direct = direct * np.clip(normal @ light.to_sun, 0, None)[:, None]
        if not light.has_sun:
            direct[:] = 0.0
        other = albedo * np.array(light.ambient) * (0.65 + 0.35 * normal[:, 2:])
        if light.lamps > 0:
            for lamp in _lamps(self.statics):
                to = lamp - point
                squared = (to**2).sum(1) + 1.0
                facing = np.clip((to * normal).sum(1) / np.sqrt(squared), 0, None)
                other = other + albedo * (light.lamps * facing / squared)[:, None] * LAMP
        return direct, other

    def _dark(
        self, caster: Caster, point: np.ndarray, normal: np.ndarray
    ) -> Bool[np.ndarray, " R"]:
        """Whether something stands between points and the sun."""
        if not len(point):
            return np.zeros(0, bool)
        sun = np.broadcast_to(self.light.to_sun, point.shape)
        return caster.meets(point + 0.02 * normal, sun, 200.0)

    # ── A frame ─────────────────────────────────────────────────────────────

    def image(
        self,
        company: Company,
        seed: int,
        rng: np.random.Generator,
        layers: tuple[str, ...] = (),
    ) -> Image:
        """The picture of one frame; the middle of the exposure is the frame's time."""
        things = company.things
        moments = self.light.moments if things else 1
        painted = paints(things, seed)
        total = np.zeros((len(self.directions), 3), np.float32)
        for k in range(moments):
            after = ((k + 0.5) / moments - 0.5) * self.light.exposure
            total += self._moment(company, painted, after)[0]
        shape = (self.height, self.width)
        rgb = developed((total / moments).reshape(*shape, 3), self.light, rng)
        extra = {}
        if layers:
            _, distance, thing = self._moment(company, painted, 0.0)
            track = np.array([t.track + 1 for t in things] + [0])
            label = np.array([SEMANTIC[t.kind] for t in things] + [0])
            semantic = np.where(thing >= 0, label[thing], self.ground.semantic)
            depth = (distance * self.ahead).astype(np.float32)
            whole = {
                "depth": depth,
                "instance": track[thing].astype(np.int32),
                "semantic": semantic.astype(np.uint8),
            }
            extra = {name: whole[name].reshape(shape) for name in layers}
        return Image(self.pose, self.intrinsic, rgb, **extra)

    def _moment(
        self, company: Company, painted: np.ndarray, after: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(colour, distance, thing) of every pixel at one moment."""
        behind, things = self.ground, company.things
        colour, distance = behind.direct + behind.other, behind.distance.copy()
        thing = np.full(len(distance), -1)
        if things:
            movers, caster = company.at(after)
            pixels = self._may_see(things, after)
            hits = caster.cast(
                self.origin, self.directions[pixels], np.minimum(distance[pixels], FAR)
            )
            met = hits.face >= 0
            if self.light.has_sun:
                self._cast_shadows(caster, things, after, colour)
            at = pixels[met]
            colour[at] = self._mover_look(caster, movers, painted, hits, met, at)
            distance[at], thing[at] = hits.distance[met], movers.thing[hits.face[met]]
        if self.haze > 0:
            clear = np.exp(-self.haze * np.where(np.isfinite(distance), distance, FAR))[:, None]
            veil = np.array(self.light.ambient) * 0.9 + 0.15 * np.array(self.light.sun)
            colour = colour * clear + veil * (1 - clear)
        return colour, distance, thing

    def _mover_look(  # type: ignore[no-untyped-def]
        self, caster: Caster, movers: Movers, painted: np.ndarray, hits, met, at: np.ndarray
    ) -> np.ndarray:
        face = hits.face[met]
        point = self.origin + self.directions[at] * hits.distance[met][:, None]
        normal = hits.normal[met]
        part = movers.part[face]
        albedo = painted[movers.thing[face], part]
        direct, other = self._lit(point, normal, albedo)
        if self.light.has_sun:
            dark = self._dark(caster, point, normal) | self._dark(self.still_caster, point, normal)
            direct[dark] = 0.0
        colour = direct + other
        colour = colour + self._gloss(part, self.directions[at], normal)
        if self.light.lamps > 0:
            for name, glow in _GLOW.items():
                colour = colour + (part == PARTS.index(name))[:, None] * glow * self.light.lamps
        return colour

    def _gloss(self, part: np.ndarray, to: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """What lacquer and glass mirror of the sky, more at a grazing angle (Schlick 1994)."""
        along = np.einsum("rk,rk->r", to, normal)
        share = _GLOSS[part] * (1 + (1 / 0.04 - 1) * (1 + np.minimum(along, 0)) ** 5)
        up = to[:, 2] - 2 * along * normal[:, 2]
        return (share * np.clip(0.25 + 1.5 * up, 0.1, 1))[:, None] * np.array(self.light.sky)

    def _cast_shadows(
        self, caster: Caster, things: tuple[Thing, ...], after: float, colour: np.ndarray
    ) -> None:
        """Take the sun from what lies in the shadow of a road user."""
        behind, sun = self.ground, self.light.to_sun
        near = np.zeros(len(colour), bool)
        for thing in things:
            at = thing.center + after * thing.velocity - self.statics.center
            reach = np.hypot(*thing.size[:2]) / 2
            long = min(thing.size[2] / max(np.tan(self.light.elevation), 0.05), 60.0)
            end = at[:2] - sun[:2] / np.hypot(*sun[:2]) * long
            low, high = np.minimum(at[:2], end) - reach, np.maximum(at[:2], end) + reach
            near[self.sunny.within(low, high)] = True
        pixels = np.flatnonzero(near)
        up = np.broadcast_to([0.0, 0.0, 1.0], (len(pixels), 3))
        dark = pixels[self._dark(caster, behind.point[pixels], up)]
        colour[dark] = behind.other[dark]

    def _may_see(self, things: tuple[Thing, ...], after: float) -> Int[np.ndarray, " P"]:
        """The pixels within the frames about the things' boxes; all where one is at the lens."""
        wanted = np.zeros((self.height, self.width), bool)
        (fx, _, cx), (_, fy, cy), _ = self.intrinsic
        for thing, at in zip(things, corners(things), strict=True):
            at = at + after * thing.velocity
            body = (at - self.pose[:3]) @ self.turn
            if (body[:, 0] <= 0.05).all():
                continue
            if (body[:, 0] <= 0.05).any():
                wanted[:] = True
                break
            u, v = cx - fx * body[:, 1] / body[:, 0], cy - fy * body[:, 2] / body[:, 0]
            left, right = np.clip([u.min() - 1, u.max() + 2], 0, self.width).astype(int)
            top, bottom = np.clip([v.min() - 1, v.max() + 2], 0, self.height).astype(int)
            wanted[top:bottom, left:right] = True
        return np.flatnonzero(wanted)


def _lamps(statics: Statics) -> Float[np.ndarray, "P 3"]:
    """Where street lamps hang: 1.5 m above the poles."""
    return statics.poles - statics.center + [0.0, 0.0, 1.5]


def _still_look(
    statics: Statics, face: np.ndarray, point: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(linear albedo, CARLA's label) of what stands still, by where it is met."""
    material = np.where(face >= 0, statics.material[face], -1)
    body = np.where(face >= 0, statics.body[face], 0)
    albedo, semantic = np.zeros((len(face), 3)), np.zeros(len(face), int)
    for kind, label in _OF_MATERIAL.items():
        semantic[material == kind] = label
    ground = material == GROUND
    world = point[:, :2] + statics.center[:2]
    albedo[ground] = statics.surface.albedo(world[ground])
    labels = np.array([_OF_LABEL[k] for k in (*Region, GRASS, PAINT)])
    semantic[ground] = labels[statics.surface.label(world[ground])]
    albedo[material == KERB] = 0.34
    albedo[material == ROOF] = [0.16, 0.12, 0.11]
    albedo[material == TRUNK] = [0.11, 0.075, 0.05]
    albedo[material == POLE] = [0.28, 0.29, 0.30]
    crown = material == CROWN
    leaf = 0.6 + 0.8 * noise(point[crown][:, :2] * 2.5 + point[crown][:, 2:] * 1.7)
    tint = 0.8 + 0.4 * (body[crown] * 0.618 % 1.0)
    albedo[crown] = np.array([0.065, 0.11, 0.035]) * (leaf * tint)[:, None]
    wall = material == BUILDING
    albedo[wall] = _facade(point[wall], normal[wall], body[wall])
    return albedo, semantic


_WALLS = np.array(
    [
        [0.42, 0.36, 0.30],
        [0.34, 0.17, 0.12],
        [0.50, 0.48, 0.44],
        [0.30, 0.31, 0.33],
        [0.46, 0.38, 0.24],
    ]
)


def _facade(point: np.ndarray, normal: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Plaster or brick with rows of windows, 3 m by 3 m."""
    along = point[:, 1] * normal[:, 0] - point[:, 0] * normal[:, 1]
    across, up = along % 2.8, (point[:, 2] + 0.4) % 3.0
    pane = (across > 0.8) & (across < 2.1) & (up > 1.0) & (up < 2.4)
    frame = (across > 0.7) & (across < 2.2) & (up > 0.9) & (up < 2.5)
    colour = (
        _WALLS[body % len(_WALLS)]
        * (0.9 + 0.2 * noise(np.column_stack([along, point[:, 2]]) * 1.3))[:, None]
    )
    colour = np.where(frame[:, None], 0.55, colour)
    return np.where(pane[:, None], [0.05, 0.06, 0.075], colour)
