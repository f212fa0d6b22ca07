"""Whether a layout can be mounted: checked on the map, without the geometry of the search."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float

from inspe_jax.mounting.site import Site
from inspe_jax.placement.constraints import PLACES, Constraints
from inspe_jax.placement.coordinates import nearest_turn
from inspe_jax.scene.placed_bodies import body_at
from inspe_jax.sensing.layout import UNIT_HEIGHT, UNIT_PLAN, Layout, Sensor, Unit

TOLERANCE = 1e-3
"""Rounding may add this to a distance [m] or an angle [rad]."""
SPAN = 1.5
"""A unit this near to the centre [m] that is not on a mounting area hangs on a span wire."""


def on_span(layout: Layout, site: Site) -> Bool[np.ndarray, " U"]:
    """Whether each unit hangs on a span wire over the middle of the junction."""
    feet = [np.array(unit.base[:2]) for unit in layout.units]
    return np.array(
        [
            bool(np.hypot(*(foot - site.center)) <= SPAN) and not site.carries(foot, TOLERANCE)
            for foot in feet
        ]
    )


@dataclass(frozen=True)
class Fault:
    """A broken rule of mounting: the sensors that break it, and the rule in words."""

    sensors: tuple[int, ...]
    words: str


def faults(layout: Layout, given: Layout, site: Site, constraints: Constraints) -> Iterator[Fault]:
    """The rules, to :data:`TOLERANCE`, that a layout of the sensors of ``given`` breaks."""
    poses, hung = np.asarray(layout.poses, float), _about_feet(layout, site)
    span = on_span(given, site)
    names = [f"'{sensor.name}'" for sensor in layout.sensors]
    for u, members in enumerate(layout.members()):
        unit, before = layout.units[u], np.array(given.units[u].base[:2])
        kept = bool(span[u]) or constraints.places_of(unit.name) == "keep"
        for wrong in _foot(unit, before, kept, site, constraints):
            yield Fault(members, f"unit '{unit.name}': its foot {wrong}")
        heights = constraints.span_heights if span[u] else constraints.heights
        for s in members:
            over = site.over_lane(poses[s, :2])
            for wrong in _sensor(layout.sensors[s], hung[s], over, constraints, heights):
                yield Fault((s,), f"sensor {names[s]} {wrong}")
            inside = body_at(site.bodies, site.place, poses[s, :3])
            if inside is not None:
                yield Fault((s,), f"sensor {names[s]} is inside a body, the {inside.words}")
        for a, b in combinations(members, 2):
            dx, dy, dz, *_ = np.abs(poses[a] - poses[b])
            for apart, limit, how in (
                (np.hypot(dx, dy), UNIT_PLAN, "in plan"),
                (dz, UNIT_HEIGHT, "in height"),
            ):
                if apart > limit + TOLERANCE:
                    pair = f"{names[a]} and {names[b]} are {apart:.2f} m apart {how}"
                    words = f"unit '{unit.name}': sensors {pair}, at most {limit:g} m"
                    yield Fault((a, b), words)


def _foot(
    unit: Unit, before: np.ndarray, kept: bool, site: Site, constraints: Constraints
) -> Iterator[str]:
    foot = np.array(unit.base[:2])
    moved, away = (float(np.hypot(*(foot - other))) for other in (before, site.center))
    if kept:
        if moved > TOLERANCE:
            yield f"is {moved:.2f} m from where it must stay"
        return
    if away > site.radius + TOLERANCE:
        yield f"is {away:.2f} m from the centre, at most {site.radius:g} m"
    near = site.body_near(foot, within=TOLERANCE)
    if near is not None:
        how = f"within {UNIT_PLAN:g} m of" if near.height > site.lowest else "inside"
        yield f"({foot[0]:.2f}, {foot[1]:.2f}) is {how} a body, the {near.words}"
        return
    areas, poles = PLACES[constraints.places_of(unit.name)]
    if not site.carries(foot, TOLERANCE, areas=areas, poles=poles):
        what = " and no ".join(["mounting area"] * areas + ["pole"] * poles)
        yield f"({foot[0]:.2f}, {foot[1]:.2f}) stands on no {what}"


def _sensor(
    sensor: Sensor,
    hung: Float[np.ndarray, "6"],
    over_lane: bool,
    constraints: Constraints,
    heights: tuple[float, float],
) -> Iterator[str]:
    """The rules that one sensor breaks; ``hung`` is its pose relative to its unit's foot."""
    reach, above = float(np.hypot(*hung[:2])), float(hung[2])
    if reach > UNIT_PLAN + TOLERANCE:
        yield f"is {reach:.2f} m from its unit's foot in plan, at most {UNIT_PLAN:g} m"
    low, high = heights
    if not low - TOLERANCE <= above <= high + TOLERANCE:
        yield f"is {above:.2f} m above the ground, not {low:g} to {high:g} m"
    if over_lane and above < constraints.clearance - TOLERANCE:
        yield f"is {above:.2f} m above a lane, at least {constraints.clearance:g} m"
    whole = (-np.pi, np.pi)
    for name, angle, (low, high) in (
        ("pitch", hung[4], constraints.pitch[sensor.spec.kind]),
        ("yaw", hung[5], constraints.yaw.get(sensor.name, whole)),
    ):
        if (angle - low + TOLERANCE) % (2 * np.pi) > high - low + 2 * TOLERANCE:
            allowed = f"{np.degrees(low):g}° to {np.degrees(high):g}°"
            yield f"has a {name} of {np.degrees(angle):.1f}°, not {allowed}"


def differences(
    before: Layout, after: Layout, site: Site, added: Collection[str] = ()
) -> Iterator[str]:
    """What differs, in words, between a layout and the same made feasible; ``added`` units are
    new."""
    for old, new in zip(before.units, after.units, strict=True):
        foot = np.array(new.base[:2])
        away = float(np.hypot(*(foot - old.base[:2])))
        if away > TOLERANCE:
            on_pole = site.carries(foot, TOLERANCE, areas=False)
            where = "pole" if on_pole else "mounting area"
            if old.name in added:
                near = f"the nearest {where}, {away:.2f} m from the point asked for"
                yield f"unit '{old.name}' added at {near}"
            else:
                yield f"unit '{old.name}' moved {away:.2f} m to the nearest {where}"
    hung = (_about_feet(layout, site) for layout in (before, after))
    for sensor, was, now in zip(before.sensors, *hung, strict=True):
        name, aside = f"sensor '{sensor.name}'", float(np.hypot(*(now[:2] - was[:2])))
        if aside > TOLERANCE:
            nearer = np.hypot(*now[:2]) < np.hypot(*was[:2])
            way = "nearer to its unit's foot" if nearer else "to hang beside its pole"
            yield f"{name} moved {aside:.2f} m {way}"
        if abs(now[2] - was[2]) > TOLERANCE:
            way = "lowered" if now[2] < was[2] else "raised"
            yield f"{name} {way} from {was[2]:.2f} to {now[2]:.2f} m above the ground"
        for k, angle in ((4, "pitch"), (5, "yaw")):
            if abs(nearest_turn(now[k] - was[k], 0.0, np)) > TOLERANCE:
                turn = " to ".join(f"{degrees:.1f}°" for degrees in np.degrees([was[k], now[k]]))
                yield f"{name}: {angle} turned from {turn}"


def _about_feet(layout: Layout, site: Site) -> Float[np.ndarray, "S 6"]:
    """Poses relative to the ground at the feet of their units."""
    feet = np.array([unit.base[:2] for unit in layout.units])
    base = np.column_stack([feet, site.place.ground(feet), np.zeros((len(feet), 3))])
    return np.asarray(layout.poses, float) - base[[sensor.unit for sensor in layout.sensors]]
