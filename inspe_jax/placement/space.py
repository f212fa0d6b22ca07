"""The feasible set of one layout on one intersection: the space of a search. It is a product of
places for each unit's foot (convex pieces of ground, and poles), of discs and of intervals;
:meth:`Space.faults` checks layouts on the map instead."""

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from shapely import minimum_bounding_circle
from shapely.geometry import MultiPoint

from inspe_jax.core.errors import InspeError, nearest
from inspe_jax.mounting.brackets import Brackets
from inspe_jax.mounting.site import Site
from inspe_jax.placement.constraints import PLACES, Constraints
from inspe_jax.placement.convex_regions import make_regions
from inspe_jax.placement.coordinates import PLANE, STEPS, Coordinates, Disc, Limits, Range
from inspe_jax.placement.feasibility import TOLERANCE, Fault, differences, faults, on_span
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.layout import UNIT_HEIGHT, UNIT_PLAN, Layout, make_layout

_NEAR = 0.5  # a foot is charted on an area this near rather than on a pole [m]
_APART = 2.5  # between the feet of two random units, where possible [m]
_TRIES = 16  # to find a random foot apart from the others
_CELL = 0.2  # of the raster of lanes [m]
_GROUND_CELL = 1.0  # of the raster of the ground's height [m]


class Space:
    """The feasible set of one layout's units and sensors on one intersection. ``given`` is that
    layout; ``scale`` (N,) is a typical step of each coordinate [m or rad], 0 for those that may not
    change, the others being ``free``; ``index`` is the place of each coordinate in a flat array."""

    def __init__(
        self, scene: Scene, layout: Layout, constraints: Constraints | None = None
    ) -> None:
        """Raises InspeError if a constraint is wrong or a unit has nowhere to stand."""
        self.given, self.constraints = layout, constraints or Constraints()
        self.constraints.check()
        self.center = np.asarray(scene.voxels.center, float)
        self.place = scene.intersection
        if self.constraints.area is not None:
            self.place = replace(self.place, mounting=self.constraints.area)
        bodies, lowest = scene.statics, self.constraints.heights[0]
        radius = float(scene.voxels.radius)
        self.site = Site(self.place, radius, depth=0.0, bodies=bodies, lowest=lowest)
        self._brackets = Brackets.of(self.site.carriers, self.center[:2])
        self._unit = np.array([sensor.unit for sensor in layout.sensors])
        self._feet = np.array([unit.base[:2] for unit in layout.units]) - self.center[:2]
        self._set_limits()
        self._set_places()
        self._set_rasters()
        self.scale = self._scale()
        self.free = np.flatnonzero(self.scale > 0)
        self.index = self.split(np.arange(self.size))

    @property
    def size(self) -> int:
        """Number of coordinates N."""
        return len(self.scale)

    # ── What is allowed ──

    def _set_limits(self) -> None:
        options, sensors = self.constraints, self.given.sensors
        names = [sensor.name for sensor in sensors]
        for name in options.yaw:
            if name not in names:
                raise InspeError(f"yaw of '{name}': no such sensor{nearest(name, names)}")
        units = [unit.name for unit in self.given.units]
        for name in () if isinstance(options.places, str) else options.places:
            if name not in units:
                raise InspeError(f"places of '{name}': no such unit{nearest(name, units)}")
        self._places = [options.places_of(name) for name in units]
        span = on_span(self.given, self.site)
        self._kept = span | (np.array(self._places) == "keep")
        above = Range(*np.where(span[:, None], options.span_heights, options.heights).T)
        yaw = Range(*np.array([options.yaw.get(name, (-np.pi, np.pi)) for name in names]).T)
        # A head keeps as far from the ends of its heights as its sensors may be from it, so they
        # keep to the heights and the unit rule. A unit's only sensor is at its head.
        plan = self._brackets.largest_offset(UNIT_PLAN)
        alone = np.bincount(self._unit, minlength=len(units)) == 1
        spread = np.where(alone, 0.0, np.minimum(UNIT_HEIGHT / 2, above.half))
        arm = np.where(alone, plan, plan / 2)
        self._limits = Limits(
            arm=Disc(arm),
            height=Range(above.low + spread, above.high - spread),
            offset=Disc((plan - arm)[self._unit]),
            rise=Range(-spread[self._unit], spread[self._unit]),
            yaw=yaw,
            pitch=Range(*np.array([options.pitch[sensor.spec.kind] for sensor in sensors]).T),
            lens=Range(*np.array([sensor.spec.lens_limits for sensor in sensors]).T),
            sector=yaw.half < np.pi,
            aimed=np.array([sensor.spec.aimed for sensor in sensors]),
        )

    def _set_places(self) -> None:
        kinds = [PLACES[name] for name in self._places]
        ground = self.site.convex() if any(areas for areas, _ in kinds) else []
        pool = [*ground, *(self.site.poles - self.center[:2])[:, None]]
        self._pole = np.arange(len(pool)) >= len(ground)
        rows = []
        for u, foot in enumerate(self._feet):
            areas, poles = kinds[u]
            unit, away = self.given.units[u].name, float(np.hypot(*foot))
            if self._kept[u] and away > self.site.radius + TOLERANCE:
                raise InspeError(
                    f"unit '{unit}' stands {away:.1f} m from the centre, beyond the radius of "
                    f"{self.site.radius:g} m: it cannot stay there"
                )
            row = [] if self._kept[u] else [*np.flatnonzero(np.where(self._pole, poles, areas))]
            # A given foot that may stay is a place for its unit, also in the rim of an area.
            at = foot + self.center[:2]
            if self._kept[u] or self.site.carries(at, TOLERANCE, areas=areas, poles=poles):
                row.append(len(pool))
                pool.append(foot[None])
            if not row:
                what = {"any": "no mounting area and no pole", "areas": "no mounting area"}
                raise InspeError(
                    f"{self.place.name}: unit '{unit}' has nowhere to stand: "
                    f"{what.get(self._places[u], 'no pole')} off the driving lanes within "
                    f"{self.site.radius:g} m of the centre; use places 'keep', an area of your own "
                    "or a map with sidewalks"
                )
            rows.append(row)
        self._pieces = make_regions(pool)
        self._allowed = np.array([np.isin(np.arange(len(pool)), row) for row in rows])
        self._pole = np.pad(self._pole, (0, len(pool) - len(self._pole)))

    def _set_rasters(self) -> None:
        self._reach = self.site.radius + UNIT_PLAN + 4 * _CELL
        self._lane = self.site.lane_cells(self._reach, _CELL)
        count = int(np.ceil(2 * self._reach / _GROUND_CELL)) + 1
        lines = np.arange(count) * _GROUND_CELL - self._reach
        at = np.stack(np.meshgrid(lines, lines, indexing="ij"), -1).reshape(-1, 2)
        self._ground = (self.place.ground(at + self.center[:2]) - self.center[2]).reshape(count, -1)

    def _scale(self) -> Float[np.ndarray, " N"]:
        # A unit that may stand on only one point does not move.
        wide = (self._allowed & (self._pieces.area > 0)).any(1)
        spots = [len(np.unique(self._pieces.corners[row, 0], axis=0)) for row in self._allowed]
        moves = {"base": wide | (np.array(spots) > 1)}
        moves |= {name: getattr(self._limits, name).half > 0 for name in STEPS if name != "base"}
        axes = {name: 2 if name in PLANE else 1 for name in STEPS}
        return np.concatenate([np.repeat(STEPS[name] * moves[name], axes[name]) for name in STEPS])

    # ── From coordinates to poses ──

    def split(self, x: Float[Any, " N"]) -> Coordinates:
        """The coordinates by name."""
        return Coordinates.split(x, len(self._feet), len(self._unit))

    def poses(self, x: Float[Array, " N"]) -> Float[Array, "S p"]:
        """Poses about the scene's centre, differentiable in x; where a camera zooms, all have their
        lens behind them. The ground at a foot is interpolated between points 1 m apart."""
        c = self.split(x)
        table = jnp.asarray(self._ground, x.dtype)
        t = (c.base + self._reach) / _GROUND_CELL
        corner = jnp.clip(jnp.floor(t), 0, len(table) - 2)
        (fx, fy), (i, j) = jnp.clip(t - corner, 0, 1).T, corner.astype(int).T
        low = (1 - fy) * table[i, j] + fy * table[i, j + 1]
        high = (1 - fy) * table[i + 1, j] + fy * table[i + 1, j + 1]
        found = self._sensors(c, (1 - fx) * low + fx * high, jnp)
        return jnp.column_stack([found, c.lens]) if self.given.zooms else found

    def _sensors(self, c: Coordinates, ground: Float[Any, " U"], xp: Any) -> Float[Any, "S 6"]:
        at = c.base[self._unit] + c.arm[self._unit] + c.offset
        if self._brackets:
            at = self._brackets.positions(at, c.yaw, self._limits.aimed, xp)
        above = c.height[self._unit] + c.rise
        # A sensor over a lane is raised to the clearance. Two sensors of a unit stay within 4 m:
        # Constraints.check ensures that the clearance is at most 4 m above the lowest height.
        cell = xp.floor((at + self._reach) / _CELL).astype(int)
        i, j = xp.clip(cell, 0, len(self._lane) - 1).T
        raised = xp.maximum(above, self.constraints.clearance)
        above = xp.where(xp.asarray(self._lane)[i, j], raised, above)
        roll = xp.asarray(np.asarray(self.given.poses)[:, 3], at.dtype)
        z = ground[self._unit] + above
        return xp.stack([at[:, 0], at[:, 1], z, roll, c.pitch, c.yaw], -1)

    def layout(self, x: Float[Any, " N"]) -> Layout:
        """The layout at feasible coordinates, with world poses and the exact ground. Raises
        InspeError if one is outside the set by more than :data:`TOLERANCE`."""
        x = np.asarray(x, float)
        if x.shape != (self.size,) or not np.isfinite(x).all():
            raise InspeError(f"coordinates: expected {self.size} finite numbers")
        inside = self.project(x, np)
        worst = int(np.abs(inside - x).argmax())
        if abs(inside[worst] - x[worst]) > TOLERANCE:
            raise InspeError(
                f"not feasible: coordinate {worst} is {x[worst]:.3f}; the nearest feasible "
                f"value is {inside[worst]:.3f}; project the coordinates first"
            )
        c = self.split(inside)
        feet = c.base + self.center[:2]
        ground = self.place.ground(feet)
        poses = self._sensors(c, ground - self.center[2], np)
        poses[:, :3] += self.center
        poses[:, 5] = np.arctan2(np.sin(poses[:, 5]), np.cos(poses[:, 5]))
        bases = zip(self.given.units, np.column_stack([feet, ground]).tolist(), strict=True)
        units = [replace(unit, base=(px, py, pz)) for unit, (px, py, pz) in bases]
        lenses = zip(self.given.sensors, inside[self.index.lens], strict=True)
        sensors = [replace(one, spec=one.spec.with_lens(float(lens))) for one, lens in lenses]
        return make_layout(sensors, units, poses, self.given.name)

    # ── Two ways to stay in the set ──

    def project(self, x: Float[Any, " N"], xp: Any = jnp) -> Float[Any, " N"]:
        """The nearest feasible coordinates, by JAX or NumPy. A yaw keeps its full turns."""
        c = self.split(x)
        base = self._pieces.nearest(c.base, self._allowed, xp)[0]
        return self._limits.clip(c, xp)._replace(base=base).flat(xp)

    def chart(
        self, x: Float[Any, " N"], stay: bool = False
    ) -> tuple[Float[np.ndarray, " N"], Int[np.ndarray, " U"]]:
        """Feasible coordinates as coordinates without bounds, and the region (U,) of each unit: a
        pole, or a piece of ground, which is also taken for a pole within 0.5 m of it unless units
        ``stay``. Mid-range both move alike; what is on a bound counts as 1 % inside."""
        c = self.split(np.asarray(x, float))
        far = self._pieces.nearest(c.base, self._allowed)[2]  # (U, K), squared
        wide = np.where(self._pieces.area > 0, far, np.inf)
        place = np.where(wide.min(1) <= _NEAR**2, wide.argmin(1), far.argmin(1))
        if stay:
            poles = np.where(self._pole, far, np.inf)
            place = np.where(poles.min(1) <= TOLERANCE**2, poles.argmin(1), place)
        v = self._limits.from_bounded(c)._replace(base=self._pieces.chart(c.base, place, np))
        return v.flat(), place

    def from_chart(
        self, v: Float[Any, " N"], place: Int[Array | np.ndarray, " U"], xp: Any = jnp
    ) -> Float[Any, " N"]:
        """The inverse of :meth:`chart`: feasible for any v, and by JAX differentiable in it."""
        c = self.split(v)
        base = self._pieces.at(c.base, place, xp)
        return self._limits.to_bounded(c, xp)._replace(base=base).flat(xp)

    # ── Starts, random layouts, candidates ──

    def start(
        self, layout: Layout, added: Collection[str] = ()
    ) -> tuple[Float[np.ndarray, " N"], tuple[str, ...]]:
        """The feasible coordinates nearest to a layout of these sensors, and notes on what moved.
        Sensors keep their heights and move with their unit's foot; units in ``added`` are noted as
        added."""
        ours, theirs = (
            [(s.spec.with_lens(0.0), s.unit) for s in of.sensors] for of in (self.given, layout)
        )
        if ours != theirs:
            raise InspeError(
                f"{layout.name} cannot be the start for {self.given.name}: it has other sensors or "
                "units"
            )
        poses = np.asarray(layout.poses, float)
        feet = np.array([unit.base[:2] for unit in layout.units])
        above = poses[:, 2] - self.place.ground(feet)[self._unit]
        out = poses[:, :2] - feet[self._unit]
        if self._brackets:
            at = poses[:, :2] - self.center[:2]
            points = self._brackets.points(at, poses[:, 5], self._limits.aimed)
            out = points + self.center[:2] - feet[self._unit]
        arm, height = np.zeros_like(feet), np.zeros(len(feet))
        for u, members in enumerate(map(list, layout.members())):
            # The head is the middle of the smallest circle round the foot and its sensors, each
            # without its bracket.
            circle = minimum_bounding_circle(MultiPoint([(0.0, 0.0), *out[members]]))
            one_spot = len(members) == 1 or circle.area == 0
            arm[u] = out[members[0]] if one_spot else circle.centroid.coords[0]
            height[u] = (above[members].min() + above[members].max()) / 2
        arm = self._limits.arm.clip(arm, np)
        height = self._limits.height.clip(height, np)
        wanted = Coordinates(
            feet - self.center[:2],
            arm,
            height,
            out - arm[self._unit],
            above - height[self._unit],
            poses[:, 5],
            poses[:, 4],
            np.array([sensor.spec.lens for sensor in layout.sensors]),
        )
        x = self.project(wanted.flat(), np)
        return x, tuple(differences(layout, self.layout(x), self.site, added))

    def random(self, rng: np.random.Generator, count: int) -> Float[np.ndarray, "M N"]:
        """Random feasible coordinates, one layout in each row: feet 2.5 m apart if there is room,
        spread evenly over the areas, half of them on poles if there are both; see
        :meth:`Limits.draw`."""
        base = np.zeros((count, len(self._feet), 2))
        for u in range(len(self._feet)):
            tries = self._draw_feet(rng, u, _TRIES * count).reshape(_TRIES, count, 2)
            apart = np.hypot(*np.moveaxis(tries[:, :, None] - base[None, :, :u], -1, 0))
            good = (apart > _APART).all(-1)  # (tries, M); the first good one, else the first
            base[:, u] = tries[good.argmax(0), np.arange(count)]
        return np.array([c.flat() for c in self._limits.draw(rng, base, self._unit)])

    def _draw_feet(self, rng: np.random.Generator, u: int, count: int) -> np.ndarray:
        poles = self._pieces.corners[self._allowed[u] & self._pole, 0]
        areas = self._allowed[u] & (self._pieces.area > 0)
        if not len(poles) and not areas.any():
            return np.tile(self._feet[u], (count, 1))
        if not len(poles):
            return self._pieces.draw(rng, areas, count)
        on_pole = poles[rng.integers(len(poles), size=count)]
        if not areas.any():
            return on_pole
        on_area = self._pieces.draw(rng, areas, count)
        return np.where(rng.uniform(size=(count, 1)) < 0.5, on_pole, on_area)

    def feet(self, spacing: float) -> Float[np.ndarray, "F 2"]:
        """Candidate feet [m]: a lattice over the areas, all poles, and given feet that may stay."""
        single = self._pieces.corners[self._pieces.area == 0, 0]
        areas = any(PLACES[name][0] for name in self._places)
        lattice = self.site.lattice(spacing) if areas else np.zeros((0, 2))
        return np.concatenate([lattice, np.unique(single, axis=0)])

    def can_stand(self, feet: Float[np.ndarray, "F 2"]) -> Bool[np.ndarray, "U F"]:
        """Whether each unit may have its foot at each place."""
        everywhere = np.ones((1, len(self._pieces)), bool)
        on = self._pieces.nearest(np.asarray(feet, float), everywhere)[2] <= TOLERANCE**2  # (F, K)
        return np.any(on[None] & self._allowed[:, None], axis=-1)

    def new_poles(self, feet: Float[np.ndarray, "*M U 2"]) -> Bool[np.ndarray, "*M U"]:
        """Whether each unit stands on no pole of the map at these feet, and may move."""
        away = feet[..., None, :] - (self.site.poles - self.center[:2])
        return (np.hypot(*np.moveaxis(away, -1, 0)) > TOLERANCE).all(-1) & ~self._kept

    @property
    def limits(self) -> tuple[Float[np.ndarray, "S 2"], Float[np.ndarray, "S 2"]]:
        """Lowest and highest height above the ground [m] and pitch [rad] of each sensor."""
        height, rise, pitch = self._limits.height, self._limits.rise, self._limits.pitch
        low, high = height.low[self._unit] + rise.low, height.high[self._unit] + rise.high
        return np.stack([low, high], -1), np.stack([pitch.low, pitch.high], -1)

    def faults(self, layout: Layout) -> list[Fault]:
        """The rules of mounting that a layout of these sensors breaks, on the map's polygons."""
        return list(faults(layout, self.given, self.site, self.constraints))

    def violations(self, layout: Layout) -> list[str]:
        """The same rules in words."""
        return [fault.words for fault in self.faults(layout)]
