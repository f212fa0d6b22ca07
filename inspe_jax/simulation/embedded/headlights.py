"""What vehicles' lamps light, on the ground and on road users: one dipped beam each, with a
cut-off, that falls with the square of the distance; the ground's is a map, made once a frame."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from inspe_jax.scene.intersection import Intersection
from inspe_jax.simulation.embedded.embree import R3
from inspe_jax.simulation.embedded.light import CANDELA, Light
from inspe_jax.simulation.embedded.road_users import FrameActors

PEAK = 15_000 * CANDELA
"""Brightness of both dipped beams at 1 m: 7,500 cd each (UN Regulation 112: 5,100 to 44,100 cd)."""
COLOUR = np.array([1.0, 0.95, 0.86], np.float32)
CUT_OFF, GLARE = 0.01, 0.01
"""Slope of the cut-off (UN Regulation 48: 1 to 1.5 %) and the share of light that is above it."""
BLUR = 0.008  # half the slope over which the cut-off fades: lamps differ in height and aim
ASIDE, BELOW = np.radians(20.0), np.radians(4.0)
"""Where the beam is 1/e of its maximum: to either side, and below the cut-off [rad]."""
HEIGHT = 0.4, 0.5, 0.95
"""Height of the lamps: share of the vehicle's, at least and at most [m] (UN Regulation 48)."""
REACH = 35.0
"""Beams are followed to this distance [m]; further ahead the sky lights the ground more."""
FAINT = 0.25
"""Light that is left out, as a share of the sky's. It is subtracted, so that there is no edge."""
CLEAR = 1.5  # light of a beam that changes the look of a road user, as a share of the sky's
MOST = 2  # a road user is lit by so many beams at most: in a queue, others are behind those nearby
STEP = 0.5  # spacing of the map [m]
FINE = 4  # cells of the fine map to a step: 12.5 cm
BEYOND = 40.0  # the map reaches this far beyond the region of interest [m]
WORTH = 0.2  # a further beam counts if it is at least so bright as a share of the brightest


class Beams(NamedTuple):
    """Headlights of K vehicles: their middle, from the centre [m], and a unit vector in plan."""

    front: Float[np.ndarray, "K 3"]
    ahead: Float[np.ndarray, "K 2"]


def dipped(to: R3, ahead: Float[np.ndarray, "*R 2"]) -> Float[np.ndarray, " R"]:
    """Light of dipped beams, over :data:`PEAK`, at the ends of vectors ``to`` from their fronts."""
    x, y = ahead[..., 0], ahead[..., 1]
    along, across = to[:, 0] * x + to[:, 1] * y, to[:, 1] * x - to[:, 0] * y
    onward = np.maximum(along, np.float32(1e-3))
    side = across / onward * np.float32(1 / np.tan(ASIDE))
    slope = -to[:, 2] / onward - np.float32(CUT_OFF)
    lower = np.maximum(slope, 0) * np.float32(1 / BELOW)
    beam = np.exp(-np.minimum(side * side + lower, np.float32(80)))
    edge = np.clip(0.5 + slope * np.float32(0.5 / BLUR), GLARE, 1)
    beam *= edge * (along > 0)
    light: np.ndarray = beam / np.maximum(np.einsum("rk,rk->r", to, to), 1)
    return light


def beams_of(actors: FrameActors) -> Beams:
    """The lamps of those road users that have a motor and are not parked."""
    moving = [b for b in actors.boxes if not b.parked]
    own = [b for b in moving if b.kind in ("car", "truck") or b.name.startswith("motorc")]
    at = np.array([b.center for b in own], float).reshape(-1, 3) - actors.center
    size = np.array([b.size for b in own], float).reshape(-1, 3)
    yaw = np.array([b.yaw for b in own], float)
    ahead = np.column_stack([np.cos(yaw), np.sin(yaw)])
    share, least, most = HEIGHT
    up = np.clip(share * size[:, 2], least, most) - size[:, 2] / 2
    out = np.column_stack([(size[:, :1] / 2 + 0.05) * ahead, up])
    return Beams((at + out).astype(np.float32), ahead.astype(np.float32))


class GroundMap:
    """Points of the ground on a square grid around the centre, with :data:`STEP` between them."""

    def __init__(self, intersection: Intersection, radius: float, light: Light) -> None:
        self.faint = FAINT * light.sky_over_lamps
        # On level ground a lamp at height h gives at most PEAK · h / r³.
        self.follow = min(REACH, (PEAK * HEIGHT[2] / self.faint) ** (1 / 3))
        self.reach = float(np.ceil(radius + BEYOND))
        line = np.arange(-self.reach, self.reach + STEP / 2, STEP)
        self.size = len(line)
        x, y = np.meshgrid(line, line)
        xy = np.column_stack([x.ravel(), y.ravel()])
        up = intersection.ground(xy + intersection.center[:2]) - intersection.center[2]
        self.points = np.column_stack([xy, up]).astype(np.float32)

    def cells(self, point: R3) -> Int[np.ndarray, " R"]:
        """The cell of the fine map that each point lies in; −1 off the map."""
        place = (point[:, :2] + np.float32(self.reach)) * np.float32(FINE / STEP)
        cell = np.floor(place).astype(np.int32)
        many = (self.size - 1) * FINE
        inside = ((cell >= 0) & (cell < many)).all(1)
        return np.where(inside, cell[:, 1] * many + cell[:, 0], -1)

    def fine(self, actors: FrameActors) -> Float[np.ndarray, " F"]:
        """The light of beams on the ground in the cells of the fine map: linear between points."""
        light = self.lit(actors).reshape(self.size, self.size)
        part = ((np.arange(FINE, dtype=np.float32) + 0.5) / FINE)[None, :, None]
        for _ in range(2):  # along y, then along x
            light = light[:-1, None] + part * (light[1:] - light[:-1])[:, None]
            light = np.ascontiguousarray(light.reshape(-1, light.shape[-1]).T)
        return light.ravel()

    def lit(self, actors: FrameActors) -> Float[np.ndarray, " N"]:
        """The light that beams throw on the ground at each point of the grid, lamps being 1."""
        beams = actors.once(beams_of)
        light = np.zeros(len(self.points), np.float32)
        number = np.arange(len(self.points)).reshape(self.size, self.size)
        _, caster = actors.at(0.0)
        for k, front in enumerate(beams.front):
            if np.abs(front[:2]).max() > self.reach:
                continue
            # The wedge of ±45° ahead: more to the side the beam is fainter than 1/1000.
            turn = np.sqrt(0.5) * np.array([[1.0, -1.0], [1.0, 1.0]])
            tips = [beams.ahead[k], turn @ beams.ahead[k], turn.T @ beams.ahead[k], np.zeros(2)]
            ends = front[:2] + self.follow * np.array(tips)
            low, high = ends.min(0), ends.max(0)
            x0, y0 = np.clip(((low + self.reach) / STEP).astype(int), 0, self.size)
            x1, y1 = np.clip(((high + self.reach) / STEP).astype(int) + 1, 0, self.size)
            at = number[y0:y1, x0:x1].ravel()
            to = self.points[at] - front
            # The ground is taken as level here: cos θ is the height of the lamp over the distance.
            facing = np.maximum(-to[:, 2], 0) / np.sqrt(np.einsum("rk,rk->r", to, to))
            found = np.float32(PEAK) * dipped(to, beams.ahead[k]) * facing
            found -= np.float32(self.faint)
            some = np.flatnonzero(found > 0)
            start = self.points[at[some]] + np.array([0, 0, 0.05], np.float32)
            way = front - start
            far = np.linalg.norm(way, axis=1)
            free = some[~caster.meets(start, way / far[:, None], far)]
            light[at[free]] += found[free]
        return light


def on_road_users(
    actors: FrameActors, point: R3, normal: R3, box: Int[np.ndarray, " R"], light: Light
) -> Float[np.ndarray, " R"]:
    """The light that beams throw on road users at R points, as if nothing stood between them."""
    beams, total = actors.once(beams_of), np.zeros(len(point), np.float32)
    many, count = len(actors.boxes), len(beams.front)
    middle = np.array([b.center for b in actors.boxes]).reshape(-1, 3) - actors.center
    to = (middle.astype(np.float32)[:, None] - beams.front).reshape(-1, 3)
    to[:, 2] = -0.1  # lower than the cut-off: some of a road user always is
    ahead = np.broadcast_to(beams.ahead, (many, count, 2)).reshape(-1, 2)
    there = PEAK * dipped(to, ahead).reshape(many, count)
    for k in np.argsort(-there, axis=1)[:, :MOST].T:  # the brightest beam at each, then the next
        bright = there[np.arange(many), k]
        lit = (bright > WORTH * there.max(1)) & (bright > CLEAR * light.sky_over_lamps)
        own = np.flatnonzero(lit[box])
        way = point[own] - beams.front[k[box[own]]]
        facing = -np.einsum("rk,rk->r", way, normal[own])
        some = np.flatnonzero(facing > 0)
        own, way, facing = own[some], way[some], facing[some]
        facing /= np.sqrt(np.maximum(np.einsum("rk,rk->r", way, way), 1e-4))
        total[own] += np.float32(PEAK) * dipped(way, beams.ahead[k[box[own]]]) * facing
    return total
