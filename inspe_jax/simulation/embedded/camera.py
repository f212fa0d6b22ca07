"""A camera in a world of triangles, lit by sun, sky and lamps; each frame, changes are rendered."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image as Pillow
from PIL import ImageDraw
from scipy.ndimage import minimum_filter

from inspe_jax.core.geometry import rotation
from inspe_jax.sensing.sensors import CameraSpec
from inspe_jax.simulation.embedded.embree import R3, Caster, RayHits
from inspe_jax.simulation.embedded.headlights import COLOUR, GroundMap, on_road_users
from inspe_jax.simulation.embedded.light import metered_gain, parts, tone_map
from inspe_jax.simulation.embedded.road_users import FrameActors, paints
from inspe_jax.simulation.embedded.shading import DARKER, FAR, Shading
from inspe_jax.simulation.embedded.shapes import PARTS
from inspe_jax.simulation.embedded.static_bodies import Material
from inspe_jax.simulation.embedded.static_world import GROUND_LABELS
from inspe_jax.simulation.embedded.surroundings import Surroundings
from inspe_jax.simulation.frame import Boxes, Image, Pose6
from inspe_jax.simulation.projection import Corners, corners, outlines

SHADOWED = 150.0
"""Shadows of road users are rendered up to this distance from the centre, along x and y [m]."""
LONGEST = 200.0  # longest shadow of anything [m]
NEAR = 0.1  # so far beside the sphere about a road user it may still be seen [m]
ASIDE = 10.0
"""No road user reaches further from its centre in plan [m]: road trains are 18.75 m long."""
SKY = 11
SEMANTIC = {"car": 14, "truck": 15, "cyclist": 19, "pedestrian": 12}
"""CARLA's semantic labels (0.9.14 and later) of the classes, as all other labels here."""
OF_SHAPE = {"bus": 16, "motorcycle": 18}
"""The labels of shapes that CARLA tells apart, by the first word of the name."""
_GLOSS = np.zeros(len(PARTS), np.float32)
for _part, _reflectance in (("body", 0.04), ("window", 0.09), ("cargo", 0.02), ("lamp", 0.06)):
    _GLOSS[PARTS.index(_part)] = _reflectance
_GLOW = np.zeros((len(PARTS), 3), np.float32)
_GLOW[PARTS.index("lamp")] = [1.0, 0.95, 0.85]
_GLOW[PARTS.index("lamp rear")] = [0.5, 0.02, 0.02]


class Background(NamedTuple):
    """The static world in each of R pixels: ``point`` from the centre [m], ``ambient`` the colour
    without sunlight and haze, ``colour`` that in the picture, linear, and CARLA's label."""

    distance: Float[np.ndarray, " R"]
    point: R3
    in_sun: Bool[np.ndarray, " R"]
    ambient: R3
    colour: R3
    semantic: UInt8[np.ndarray, " R"]


class ChangedPixels(NamedTuple):
    """Pixels that differ from the static world's picture; ``box`` is −1 where it is in a shadow."""

    pixels: Int[np.ndarray, " P"]
    colour: Float[np.ndarray, "P 3"]
    distance: Float[np.ndarray, " P"]
    box: Int[np.ndarray, " P"]


class SunlitPoints:
    """Those of R points that are in the sun, by square metre of the plan, out to ``reach`` [m]."""

    def __init__(self, point: np.ndarray, lit: np.ndarray, reach: float) -> None:
        self.reach, self.size = reach, int(2 * reach)
        x, y = np.abs(point[:, :2].T)
        pixels = np.flatnonzero(lit & (x < reach) & (y < reach))
        cell = np.floor(point[pixels, :2] + reach).astype(int)
        cell = np.minimum(cell, self.size - 1)  # float32 sums may round up to the rim
        number = cell[:, 1] * self.size + cell[:, 0]
        order = np.argsort(number, kind="stable")
        self.pixels = pixels[order]
        self.start = np.searchsorted(number[order], np.arange(self.size**2 + 1))
        lowest = np.full(self.size**2, np.inf, np.float32)
        np.minimum.at(lowest, number, point[pixels, 2])
        square = lowest.reshape(self.size, self.size)
        around = 2 * (int(ASIDE) + 1) + 1  # one metre more, which is the step in ``ends``
        self._lowest = minimum_filter(square, around, mode="constant", cval=np.inf)

    def within(self, low: np.ndarray, high: np.ndarray) -> Int[np.ndarray, " P"]:
        """Pixels of the points in the squares that the rectangle ``low`` to ``high`` touches."""
        x0, y0 = np.clip(np.floor(low + self.reach), 0, self.size - 1).astype(int)
        x1, y1 = np.clip(np.floor(high + self.reach), 0, self.size - 1).astype(int)
        rows = np.arange(y0, y1 + 1) * self.size
        runs = zip(self.start[rows + x0], self.start[rows + x1 + 1], strict=True)
        return np.concatenate([self.pixels[a:b] for a, b in runs])

    def ends(self, top: R3, along: Float[np.ndarray, "3"]) -> Float[np.ndarray, " R"]:
        """How far in plan shadows of ``top`` reach [m]: until no sunlit point is below them."""
        far = np.arange(0, LONGEST)
        unit = along / np.hypot(*along[:2])
        at = top[:, None] + far[:, None] * unit
        x, y = np.moveaxis(np.floor(at[..., :2] + self.reach).astype(int), -1, 0)
        here = (np.minimum(x, y) >= -ASIDE) & (np.maximum(x, y) < self.size + ASIDE)
        x, y = np.clip((x, y), 0, self.size - 1)
        beneath = here & (self._lowest[y, x] < at[..., 2])
        return np.where(beneath, far + 1, 0).max(-1)


class LitGround:
    """Those pixels that show ground on the map of headlights, and how it looks."""

    def __init__(self, ground: GroundMap, shading: Shading, shown: Background) -> None:
        level, cell = np.isin(shown.semantic, GROUND_LABELS), ground.cells(shown.point)
        self.ground, self.pixels = ground, np.flatnonzero(level & (cell >= 0))
        self.cell, point = cell[self.pixels], shown.point[self.pixels]
        static_world = shading.static_world
        darker = np.float32(DARKER * shading.wet) * static_world.paved(point)
        world = point[:, :2] + static_world.center[:2]
        albedo = static_world.surface.albedo(world) * (1 - darker)[:, None]
        clear = np.exp(-np.float32(shading.haze) * shown.distance[self.pixels])
        lamps = np.float32(shading.light.lamps)
        self.look = (albedo * (lamps * COLOUR * clear[:, None])).astype(np.float32)

    def added(self, actors: FrameActors) -> tuple[Int[np.ndarray, " P"], Float[np.ndarray, "P 3"]]:
        """The pixels that headlights make brighter, each once, and by how much."""
        light = actors.once(self.ground.fine).take(self.cell)
        own = np.flatnonzero(light)
        return self.pixels[own], light[own, None] * self.look.take(own, axis=0)


class Camera:
    """One camera at its place, in one light."""

    def __init__(self, spec: CameraSpec, pose: Pose6, surroundings: Surroundings) -> None:
        self.pose, self.static_world = np.asarray(pose, float), surroundings.static_world
        self.recording, self.appearance_seed = surroundings.recording, surroundings.appearance_seed
        self.shading, self.light = surroundings.shading, surroundings.shading.light
        self.width, self.height = self.recording.image_size or (spec.width, spec.height)
        (cx, cy), (fx, fy) = spec.principal, spec.focals
        scale = np.diag([self.width / spec.width, self.height / spec.height, 1.0])
        self.intrinsic = scale @ np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        (fx, _, cx), (_, fy, cy), _ = self.intrinsic
        self.bends, at = spec.bends, np.column_stack([u.ravel(), v.ravel()])
        lens = spec.optics._replace(fx=fx, fy=fy, cx=cx, cy=cy)
        body = lens.rays(at)
        self.dark = np.flatnonzero(lens.beyond_circle(at)) if self.bends else np.zeros(0, int)
        self.ahead = body[:, 0]  # depth along the axis for 1 m of ray
        turned = body @ rotation(self.pose[3:], np).T
        self.directions = np.ascontiguousarray(turned, np.float32)
        self.origin = (self.pose[:3] - self.static_world.center).astype(np.float32)
        hits = self.static_world.caster.cast(self.origin, self.directions, FAR)
        slices = parts(len(self.directions))
        found = [self._background_part(part, *(x[part] for x in hits)) for part in slices]
        whole = (np.concatenate(field) for field in zip(*found, strict=True))
        self.background = Background(hits.distance, *whole)
        colour = self.background.colour
        lit = np.delete(colour, self.dark, 0) if len(self.dark) else colour
        self.gain = metered_gain(lit, self.light)
        for field in self.background:
            field[self.dark] = 0
        self.background.distance[self.dark] = np.inf
        self.lit_ground = None
        if surroundings.ground is not None:
            self.lit_ground = LitGround(surroundings.ground, self.shading, self.background)
        self.sunlit = SunlitPoints(self.background.point, self.background.in_sun, SHADOWED)

    def _background_part(
        self, pixels: slice, distance: np.ndarray, face: np.ndarray, normal: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        shading, hit = self.shading, face >= 0
        point = self.origin + self.directions[pixels] * np.where(hit, distance, 0)[:, None]
        albedo, semantic = self.static_world.look(face, point, normal)
        wet = np.zeros(0, int)
        if shading.wet > 0:
            wet = np.flatnonzero(hit & (self.static_world.material[face] == Material.GROUND))
            wet = wet[self.static_world.paved(point[wet])]
        albedo[wet] *= 1 - np.float32(DARKER * shading.wet)
        ambient = shading.ambient_light(point, normal, albedo)
        ambient[wet] += shading.reflected(point[wet], normal[wet], self.directions[pixels][wet])
        ambient[~hit] = shading.sky(self.directions[pixels][~hit])
        direct = shading.sunlight(normal, albedo)
        in_sun = direct[:, 0] > 0
        shaded = np.flatnonzero(in_sun)
        shaded = shaded[self._in_shadow(self.static_world.caster, point[shaded], normal[shaded])]
        direct[shaded], in_sun[shaded] = 0, False
        colour = shading.through_air(direct + ambient, distance)
        return point, in_sun, ambient, colour, np.where(hit, semantic, SKY).astype(np.uint8)

    def _in_shadow(self, caster: Caster, point: R3, normal: R3) -> Bool[np.ndarray, " R"]:
        return caster.meets(point + np.float32(0.02) * normal, self.shading.to_sun, LONGEST)

    def record(self, actors: FrameActors, rng: np.random.Generator) -> Image:
        """The picture of one frame; the middle of the exposure is the frame's time."""
        moments = self.light.moments
        still = self.background.colour  # without road users, but with what their lamps light
        if self.lit_ground is not None:
            at, added = self.lit_ground.added(actors)
            still = still.copy()
            still[at] += added
        total, middle = still.copy(), self._changes_at(actors, 0.0)
        for k in range(moments):
            after = ((k + 0.5) / moments - 0.5) * self.light.exposure
            seen = middle if after == 0 else self._changes_at(actors, after)
            colour, own = seen.colour.copy(), still[seen.pixels]
            shadow = np.flatnonzero(seen.box < 0)  # headlights reach into it
            colour[shadow] += own[shadow] - self.background.colour[seen.pixels[shadow]]
            total[seen.pixels] += (colour - own) / moments
        shape = (self.height, self.width)
        rgb = tone_map(total.reshape(*shape, 3), self.gain, rng)
        whole = self._layers(middle, actors.boxes) if self.recording.layers else {}
        layers = {name: whole[name].reshape(shape) for name in self.recording.layers}
        pixels = np.bincount(middle.box[middle.box >= 0], minlength=len(actors.boxes))
        share = self._visible_share(pixels, actors)
        return Image(self.pose, self.intrinsic, rgb, **layers, pixels=pixels, share=share)

    def _visible_share(
        self, pixels: Int[np.ndarray, " B"], actors: FrameActors
    ) -> Float[np.ndarray, " B"]:
        """What share ``pixels`` are of those that show each road user where it stands alone."""
        share, box_corners = np.zeros(len(pixels)), corners(actors.boxes)
        for k in np.flatnonzero(pixels):
            near = self._pixels_near(box_corners[k : k + 1])
            hits = actors.alone(int(k)).cast(self.origin, self.directions[near], FAR)
            share[k] = pixels[k] / max((hits.face >= 0).sum(), pixels[k])
        return share

    def _layers(self, seen: ChangedPixels, boxes: Boxes) -> dict[str, np.ndarray]:
        distance, semantic = self.background.distance.copy(), self.background.semantic.copy()
        instance = np.zeros(len(distance), np.int32)
        hit = seen.box >= 0
        at, box = seen.pixels[hit], seen.box[hit]
        distance[at] = seen.distance[hit]
        instance[at] = np.array([t.track + 1 for t in boxes], int)[box]
        labels = [OF_SHAPE.get(t.name.split(".")[0], SEMANTIC[t.kind]) for t in boxes]
        semantic[at] = np.array(labels, int)[box]
        return {
            "depth": (distance * self.ahead).astype(np.float32),
            "instance": instance,
            "semantic": semantic,
        }

    def _changes_at(self, actors: FrameActors, after: float) -> ChangedPixels:
        """The pixels that road users change, ``after`` seconds from the frame's time."""
        road_users, caster = actors.at(after)
        pixels = self._pixels_near(corners(actors.boxes) + after * actors.velocity[:, None])
        reach = np.minimum(self.background.distance[pixels], FAR)
        hits = caster.cast(self.origin, self.directions[pixels], reach)
        at, hits = pixels[hits.face >= 0], RayHits(*(x[hits.face >= 0] for x in hits))
        shadow = self._shadows(caster, actors.boxes, after)
        shadow = np.setdiff1d(shadow, at, assume_unique=True)
        distance = np.concatenate([hits.distance, self.background.distance[shadow]])
        look = self._road_user_colours(actors, after, at, hits)
        colour = np.concatenate([look, self.background.ambient[shadow]])
        return ChangedPixels(
            np.concatenate([at, shadow]),
            self.shading.through_air(colour, distance),
            distance,
            np.concatenate([road_users.box[hits.face], np.full(len(shadow), -1)]),
        )

    def _road_user_colours(
        self, actors: FrameActors, after: float, at: Int[np.ndarray, " P"], hits: RayHits
    ) -> Float[np.ndarray, "P 3"]:
        """Linear colours of road users at the pixels ``at``, whose rays hit them."""
        (road_users, caster), shading, normal = actors.at(after), self.shading, hits.normal
        box, part = road_users.box[hits.face], road_users.part[hits.face]
        point = self.origin + self.directions[at] * hits.distance[:, None]
        albedo = paints(actors.boxes, self.appearance_seed)[box, part]
        colour = shading.ambient_light(point, normal, albedo)
        if self.light.has_sun:
            direct = shading.sunlight(normal, albedo)
            lit = np.flatnonzero(direct[:, 0] > 0)
            for one in (caster, self.static_world.caster):
                lit = lit[~self._in_shadow(one, point[lit], normal[lit])]
            colour[lit] += direct[lit]
        colour += shading.mirrored(_GLOSS[part], self.directions[at], normal)
        if self.light.lamps > 0:
            lamps = np.float32(self.light.lamps)
            lit = on_road_users(actors, point, normal, box, self.light)
            own = np.flatnonzero(lit)
            colour[own] += albedo[own] * (lit[own, None] * (lamps * COLOUR))
            on = lamps * ~np.array([b.parked for b in actors.boxes], bool)
            colour += _GLOW[part] * on[box, None]
        return colour

    def _shadows(self, caster: Caster, boxes: Boxes, after: float) -> Int[np.ndarray, " P"]:
        """The pixels of the static world in the shadow of a road user, and in the sun otherwise."""
        if not (self.light.has_sun and boxes):
            return np.zeros(0, int)
        near = np.zeros(len(self.directions), bool)
        at = np.array([t.center + after * t.velocity for t in boxes]) - self.static_world.center
        size = np.array([t.size for t in boxes])
        away = -self.light.to_sun
        long = self.sunlit.ends(at + [0, 0, 0.5] * size, away)
        end = at[:, :2] + long[:, None] * away[:2] / np.hypot(*away[:2])
        reach = np.hypot(size[:, :1], size[:, 1:2]) / 2
        low, high = np.minimum(at[:, :2], end) - reach, np.maximum(at[:, :2], end) + reach
        for rectangle in zip(low, high, strict=True):
            near[self.sunlit.within(*rectangle)] = True
        pixels = np.flatnonzero(near)
        up = np.array([0, 0, 1], np.float32)
        return pixels[self._in_shadow(caster, self.background.point[pixels], up)]

    def _pixels_near(self, box_corners: Corners) -> Int[np.ndarray, " P"]:
        """The pixels in and close around the outlines of boxes, or the spheres about them."""
        if self.bends:
            return self._pixels_at_spheres(box_corners)
        wanted = Pillow.new("1", (self.width, self.height))
        pen = ImageDraw.Draw(wanted)
        for outline in outlines(self, box_corners, self.width, self.height, margin=2.0):
            pen.polygon(outline.ravel().tolist(), fill=1)
        return np.flatnonzero(np.asarray(wanted))

    def _pixels_at_spheres(self, box_corners: Corners) -> Int[np.ndarray, " P"]:
        middle = box_corners.mean(1)
        radius = np.linalg.norm(box_corners - middle[:, None], axis=-1).max(1)
        to = (middle - self.pose[:3]).astype(np.float32)
        away = np.linalg.norm(to, axis=1)
        beside = np.sqrt(np.maximum(away**2 - (radius + NEAR) ** 2, 0.0))  # the tangent's length
        near = np.zeros(len(self.directions), bool)
        for way, least in zip(to, np.where(away > radius + NEAR, beside, -np.inf), strict=True):
            near |= self.directions @ way >= least
        near[self.dark] = False
        return np.flatnonzero(near)
