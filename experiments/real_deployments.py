"""Claim: scores order real deployments as what was measured there does. In part: see the README.

Roadside sensors that hang, or were simulated by others, from ``real_deployments.yaml``: imported,
scored, drawn from above and through each camera. Beside what others measured:

- S110 (TUMTraf-V2X), on an approximate crossing: mAP of cameras, of a LiDAR, and of both.
- Mcity, on open ground: where a roadside system, most likely a LiDAR, found cars and pedestrians.
  Curves of detection are fitted to half of the passes and tested on the other half.
- SensorSpacing: AP of four detectors over 69 spacings of three LiDARs, in CARLA towns.
- InSPE's first author: cameras 30.6° down, and the same level; then the paper's cameras at ten
  intersections. As the one before, this needs the town maps (common.py says where they are).

``--data`` is a folder with what the project may not hold: ``sensor_spacing/{ap,places}.csv`` and
``v2x_real_infra2.yaml``; without it, what needs them is left out, and named. ``--keep`` gets each
picture in its own size. A stopped run goes on where it was.

Not here: Mcity's cameras, which are fisheyes; Ulm-Lehr, ISC, DAIR-V2X and CARMA, whose poses lack a
place or an azimuth. SensorSpacing's own traffic and houses are not known: ours drives within 100 m.
"""

import csv
import gzip
import json
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import islice, product
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import yaml
from common import MAPS, append_rows, arguments, output, read_rows, say, write_settings
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial import cKDTree
from scipy.stats import rankdata, sem, spearmanr
from scipy.stats import t as student

import inspe_jax
from inspe_jax import Layout, Region, Scene, Sensor, Unit
from inspe_jax.report.figures import draw_plan, reach_of
from inspe_jax.report.layers import seen_layer
from inspe_jax.scene.intersection import Intersection, Route
from inspe_jax.scene.lines import resampled
from inspe_jax.scene.maps.registry import list_junctions, read_map
from inspe_jax.scene.procedural.built_ins import crossing
from inspe_jax.scene.traffic.frames import CLASSES, Snapshot, pack_frames
from inspe_jax.scoring.detection import DetectionCurve, detection_curves
from inspe_jax.sensing.catalogue import spec_of
from inspe_jax.sensing.conditions import with_specs
from inspe_jax.sensing.layout import make_layout
from inspe_jax.simulation.embedded.recorder import EmbeddedRecorder
from inspe_jax.simulation.recorder import Recording

HERE = Path(__file__).resolve().parent
SCORES = ("information_gain", "surrogate", "detectability")
FURTHER = ("detectability", "localisation")
SCORED = ("coverage", "occlusion", *SCORES, "localisation")
SETS = {"cameras": ("camera",), "LiDARs": ("lidar",), "both": ("camera", "lidar")}
PITCHES = (0.0, -10.0, -20.0, -30.0, -40.0)  # of all cameras of a layout [degrees]
DOWN = -30.6  # mean pitch of the authors' cameras [degrees]
FIELD = 80.0  # where the field of camera south2 is taken to end [m]
MAST, DEVICE = 4.0, "ouster-os1-64"
"""Of the LiDAR at Mcity, which are unknown: of 4, 6 and 8 m, the height [m] whose blind cone fits
pedestrians."""
ENDS = np.arange(40.0, 80.0, 0.5)  # where a system may end [m]
BINS = np.arange(0, 101, 4.0)  # of distance, in the figure [m]
PLACES = ("S110", "A9", "InSPE")
PREDICTORS = ("share", "step", "D", "D fitted", "D fitted, range")
CARLA_LIDAR = dict(kind="lidar", channels=64, elevation_range_deg=[-25, 15], range_m=100.0)

Row = dict[str, Any]
Make = Callable[[str, int], tuple[Scene, Layout]]


@cache
def deployments() -> dict[str, Any]:
    """What ``real_deployments.yaml`` has."""
    return yaml.safe_load((HERE / "real_deployments.yaml").read_text(encoding="utf-8"))


def hung(own: Row, profile: str = "paper", to: Sequence[float] | None = None) -> Layout:
    """The layout of a deployment's sensors, with the rays of a profile's camera."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "calibration.json")
        path.write_text(json.dumps({k: own[k] for k in ("frame", "sensors") if k in own}))
        at = None if to is None else [*to, 0.0, 0.0]
        return inspe_jax.layouts_from(path, transform=at, camera=f"{profile}-camera").layout


def only(layout: Layout, kinds: Sequence[str], but: str = "") -> Layout:
    """The sensors of some kinds, without that of a name."""
    named = enumerate(layout.sensors)
    own = [s for s, one in named if one.spec.kind in kinds and one.name != but]
    sensors = tuple(layout.sensors[s] for s in own)
    return replace(layout, poses=np.asarray(layout.poses)[own], sensors=sensors)


def pitched(layout: Layout, pitch_deg: float) -> Layout:
    """The layout with all cameras at one pitch."""
    poses = np.array(layout.poses)
    poses[[one.spec.kind == "camera" for one in layout.sensors], 4] = np.radians(pitch_deg)
    return layout.with_poses(poses)


def shallow(layout: Layout) -> Layout:
    """The layout with cameras that see as far as the paper's."""
    depth: Any = inspe_jax.device("paper-camera").spec.grid.reach
    return with_specs(
        layout,
        lambda x: x.with_performance(x.reliability, depth) if x.kind == "camera" else x,
    )


def field_of(scene: Scene, layout: Layout, name: str) -> Scene:
    """What of a scene is in plan in the field of a camera, up to :data:`FIELD`."""
    s = [sensor.name for sensor in layout.sensors].index(name)
    spec: Any = layout.sensors[s].spec
    grid, pose = scene.voxels, np.asarray(layout.poses)[s]
    to = (grid.columns - pose[:2]) @ [1, 1j] * np.exp(-1j * pose[5])
    keep = (abs(np.angle(to)) < np.arctan(spec.width / 2 / spec.focals[0])) & (abs(to) < FIELD)
    cut = {key: getattr(grid, key)[keep] for key in ("columns", "ground", "region")}
    return replace(scene, voxels=replace(grid, **cut))


def ground(name: str, area: Any, routes: Sequence[Route] = ()) -> Intersection:
    """Level ground where all of an area is driveway."""
    none, zero, nowhere = np.zeros((0, 3)), np.zeros((1, 3)), shapely.MultiPolygon()
    areas = {Region.DRIVEWAY: area}
    return Intersection(name, "made", zero[0], areas, (), (*routes,), nowhere, none, zero)


def open_ground(name: str, radius: float, voxel: float = 0.5) -> Scene:
    """A scene of level ground without traffic."""
    place = ground(f"{name}, open ground", shapely.Point(0, 0).buffer(2 * radius))
    size: Row = dict(profile="ideal", radius=radius, voxel=voxel)
    return inspe_jax.build_scene(place, density=0, frames=1, **size)


def kept(path: Path, key: Row, make: Callable[[], list[Row]]) -> list[Row]:
    """The rows of a CSV with these values: made and added where there are none."""

    def found() -> list[Row]:
        return [r for r in read_rows(path) if all(r[k] == str(v) for k, v in key.items())]

    if not found():
        append_rows(path, [key | row for row in make()])
    return found()


# ── Layouts on scenes ───────────────────────────────────────────────────────


def s110(profile: str, seed: int, quick: bool = False) -> tuple[Scene, Layout]:
    """The crossing of S110, about, and its sensors; those of TUMTraf-V2X, so one LiDAR."""
    own = deployments()["s110"]
    place = crossing("S110, about", own["arms"], (3, 2, 2, 2), 12.0)
    size: Row = dict(voxel=2.0, frames=2, density=10) if quick else dict(frames=50)
    scene = inspe_jax.build_scene(place, profile=profile, radius=70.0, seed=seed, **size)
    return scene, only(hung(own, profile), SETS["both"], "LiDAR north")


def a9(profile: str, seed: int) -> tuple[Scene, Layout]:
    """Four lanes each way along a line, and the cameras on the gantries of the A9."""
    own = deployments()["a9"]
    turn, routes = np.exp(1j * np.radians(own["road_yaw_deg"])), []
    for off in (-15.25, -11.5, -7.75, -4.0, 4.0, 7.75, 11.5, 15.25):
        ends = (np.array([-220, 220]) * np.sign(off) - 1j * off) * turn
        line = resampled(np.column_stack([ends.real, ends.imag]))
        routes.append(Route(np.column_stack([line, np.zeros(len(line))]), 3.75))
    area = shapely.union_all([shapely.LineString(r.waypoints[:, :2]).buffer(2.5) for r in routes])
    size: Row = dict(profile=profile, radius=200.0, voxel=1.0, frames=20, density=60)
    return inspe_jax.build_scene(ground("A9, about", area, routes), seed=seed, **size), hung(own)


def on_map(entry: Row, profile: str, seed: int) -> tuple[Scene, Layout]:
    """A place of a town map: junction 68 of Town07 with the authors' sensors, or another."""
    own = deployments()["inspe"]
    where = {key: entry[key] for key in ("junction", "center") if key in entry}
    place = read_map(MAPS / entry["map"], radius=50.0, **where)
    return inspe_jax.build_scene(place, profile=profile, seed=seed), hung(own, to=own["origin"])


def v2x_real(folder: Path) -> tuple[Scene, Layout]:
    """The pole of V2X-Real on open ground, among the labelled objects of its one frame."""
    own = yaml.safe_load((folder / "v2x_real_infra2.yaml").read_text("utf-8"))["objects"]
    keys = ("x_m", "y_m", "yaw_deg", "length_m", "width_m", "height_m")
    x, y, yaw, *size = np.array([[box[key] for key in keys] for box in own]).T
    kind = [dict(Car=0, Pedestrian=3, BicycleRider=2).get(box["type"], 1) for box in own]
    at = np.column_stack([x, y, size[2] / 2])
    users = np.radians(yaw), np.column_stack(size), np.array(kind), np.arange(len(x)), 0 * at
    scene = open_ground("V2X-Real", 50.0)
    scene = replace(scene, traffic=pack_frames([Snapshot(at, *users)], 1.0))
    return scene, hung(deployments()["v2x_real"], "ideal")


def variants(name: str, scene: Scene, layout: Layout) -> Iterator[tuple[str, str, Layout]]:
    """What is compared at a place: sensors, how their cameras are, and the layout."""
    if name not in PLACES:  # one of the ten intersections
        for made, pitch in product(("Cam-c", "Cam-d1", "Cam-d2"), (0.0, DOWN)):
            own = inspe_jax.strategy(scene, made, camera_pitch_deg=pitch)
            yield made, f"at {pitch:g}°", own
        return
    for kinds in ("cameras",) if name == "A9" else SETS:
        own = only(layout, SETS[kinds])
        yield kinds, "as hung", own
        if name != "InSPE":
            yield kinds, "depth of the paper's", shallow(own)
        elif kinds != "LiDARs":
            yield from ((kinds, f"at {pitch:g}°", pitched(own, pitch)) for pitch in PITCHES)


def scored(name: str, make: Make, profile: str, seed: int, most: int | None = None) -> list[Row]:
    """Scores of what is compared at a place; of no more layouts than ``most``."""
    scene, layout = make(profile, seed)
    rows = []
    for sensors, cameras, own in islice(variants(name, scene, layout), most):
        at = field_of(scene, layout, "south2") if name == "S110" else scene
        found = inspe_jax.evaluate(at, own, metrics=FURTHER)
        values = {key: round(found.value(key), 4) for key in SCORED}
        rows.append(dict(sensors=sensors, cameras=cameras) | values)
    return rows


def drawn(cases: dict[str, tuple[Scene, Layout]], keep: Path | None, quick: bool) -> Figure:
    """Each deployment from above and through each of its cameras."""
    recording = Recording(image_size=(192, 120) if quick else None)
    figure = Figure(figsize=(16, 2.7 * len(cases)), layout="constrained")
    axes = figure.subplots(len(cases), 5, squeeze=False, width_ratios=[1.1, *[1.4] * 4])
    for row, (name, (scene, layout)) in zip(axes, cases.items(), strict=True):
        weights = None if scene.traffic.frame_count > 1 else (0.5, 0.5, 0.0)
        seen = inspe_jax.evaluate(scene, layout, weights=weights).seen_share
        draw_plan(row[0], scene, layout, seen_layer(seen, scene), reach_of(scene, layout), side=2.6)
        row[0].set_title(name, fontsize=9)
        recorder = EmbeddedRecorder(scene, layout, recording=recording)
        frame = recorder.frame(scene.traffic.frame_count // 2)
        pictures = [image.rgb for station in frame.stations for image in station.images]
        order = [layout.sensors[s] for members in layout.members() for s in members]
        cameras = [sensor.name for sensor in order if sensor.spec.kind == "camera"]
        for ax in row[1:]:
            ax.axis("off")
        for ax, own, picture in zip(row[1:], cameras, pictures, strict=False):
            ax.imshow(picture)
            ax.set_title(own, fontsize=9)
            if keep:
                Image.fromarray(np.asarray(picture)).save(keep / f"{name} {own}.png")
    return figure


# ── Mcity ───────────────────────────────────────────────────────────────────


class Mcity:
    """The instants of Mcity: where, whether found, and what a LiDAR at the origin has on them."""

    def __init__(self, quick: bool) -> None:
        with gzip.open(HERE / "mcity_found.csv.gz", "rt", encoding="utf-8") as f:
            rows = [*csv.DictReader(f)]
        place, car = np.array(deployments()["mcity"]["origin"]), [r["class"] == "car" for r in rows]
        numbers = np.array(
            [[float(r[k]) for k in ("time", "east", "north", "found")] for r in rows]
        )
        self.time, self.at, self.found = numbers[:, 0], numbers[:, 1:3], numbers[:, 3]
        self.one, self.car = np.array([row["pass"] for row in rows]), np.array(car)
        self.away = np.hypot(*(self.at - place).T)
        self.coming = np.append(False, (np.diff(self.away) < 0) & (self.one[1:] == self.one[:-1]))
        self.blind = self.car & (self.at[:, 0] > 36) & (self.at[:, 1] > -2)
        scene = open_ground("Mcity", 125.0, 2.0 if quick else 1.0)
        unit, pose = Unit("mast", (*place, 0.0)), np.array([[*place, MAST, 0, 0, 0]])
        layout = make_layout([Sensor("LiDAR", inspe_jax.device(DEVICE).spec, 0)], [unit], pose)
        column = cKDTree(scene.voxels.columns).query(self.at)[1]
        views = [inspe_jax.target_view(scene, layout, name) for name in ("car", "pedestrian")]
        kind = 1 - self.car
        self.returns = np.stack([view.returns[0] for view in views])[kind, column]
        self.usual = np.stack([view.found[0] for view in views])[kind, column]
        self.behind = np.zeros(len(rows), bool)  # another car with RTK
        trial = np.char.partition(self.one, "/")[:, 0]
        for k in np.flatnonzero(self.car):
            others = self.car & (trial == trial[k]) & (abs(self.time - self.time[k]) < 0.06)
            to, own = (self.at[others] - place) @ [1, 1j], (self.at[k] - place) @ [1, 1j]
            along = to * np.exp(-1j * np.angle(own))
            between = (along.real > 0) & (along.real < abs(own) - 3) & (abs(along.imag) < 1.2)
            self.behind[k] = between.any()

    def curve(self, use: np.ndarray) -> DetectionCurve:
        """The curve that is fitted to instants of cars."""
        rows = zip(self.returns[use], self.found[use], strict=True)
        boxes = [dict(sensor="lidar", road_user="car", number=n, found=f) for n, f in rows]
        return inspe_jax.fit_detection(boxes)["lidar", "car"]

    def predicted(self, use: np.ndarray, seed: int) -> dict[str, np.ndarray]:
        """The chance to be found by each predictor, fitted on the other half of the passes."""
        names = np.unique(self.one[use])
        first = np.random.default_rng(seed).permutation(names)[: len(names) // 2]
        found = {name: np.full(len(use), np.nan) for name in PREDICTORS} | dict(D=self.usual)
        for half in (np.isin(self.one, first), ~np.isin(self.one, first)):
            fit, test = use & ~half, use & half

            def step(end: float, fit: np.ndarray = fit) -> np.ndarray:
                near = self.away < end
                inner, outer = (self.found[fit & at].mean() for at in (near, ~near))
                return np.where(near, inner, outer)

            end = min(ENDS, key=lambda end: ((step(end) - self.found)[fit] ** 2).sum())
            near, curves = self.away < end, (self.curve(fit), self.curve(fit & (self.away < end)))
            whole, inside = (np.asarray(curve.chance(self.returns)) for curve in curves)
            share = np.full(len(use), self.found[fit].mean())
            fitted = share, step(end), self.usual, whole, np.where(near, inside, 0.0)
            for name, values in zip(PREDICTORS, fitted, strict=True):
                found[name][test] = values[test]
        return found

    def rows(self, chance: dict[str, np.ndarray]) -> list[Row]:
        """For each pass and part of the way: instants, share found, predictions, Brier scores."""
        cars, (x, y) = self.car & ~self.blind, self.at.T
        near, edge = self.away < 55, (self.away >= 55) & (self.away < 62)
        arm = np.select([x > abs(y), y > abs(x), -x > abs(y)], ["east", "north", "west"], "south")
        parts = {"cars to 55 m": cars & near}
        parts |= {f"cars to 55 m, {a} arm": cars & near & (arm == a) for a in np.unique(arm)}
        parts["cars to 55 m, behind another"] = cars & near & self.behind
        parts["cars 55 to 62 m, coming"] = cars & edge & self.coming
        parts["cars 55 to 62 m, leaving"] = cars & edge & ~self.coming
        parts["cars beyond 62 m"] = cars & ~near & ~edge
        parts["cars, east arm westbound, to 62 m"] = self.blind & (near | edge)
        parts |= {
            f"pedestrians {a} to {b} m": ~self.car & (self.away >= a) & (self.away < b)
            for a, b in ((0, 5), (5, 10), (10, 40))
        }
        rows: list[Row] = []
        for part, at in (parts | {"cars, all but there": cars}).items():
            for name in np.unique(self.one[at]):
                own = at & (self.one == name)
                row: Row = {"part": part, "pass": name, "instants": int(own.sum())}
                row["found"] = round(float(self.found[own].mean()), 4)
                for predictor, p in chance.items():
                    row[predictor] = round(float(p[own].mean()), 4)
                    miss = ((p - self.found)[own] ** 2).mean()
                    row[f"Brier, {predictor}"] = round(float(miss), 4)
                rows.append(row)
        return rows


# ── SensorSpacing ───────────────────────────────────────────────────────────


def spaced(place: Row, seed: int) -> list[Row]:
    """Scores of three LiDARs in a row at a place, 1 to 69 m apart: cars on roads, behind bodies."""
    path, xy = MAPS / f"{place['town']}.xodr", np.array([place["map_x"], place["map_y"]], float)
    for away, junction in sorted((math.dist(j.center[:2], xy), j.id) for j in list_junctions(path)):
        whole = read_map(path, junction=junction, radius=100.0 + away)
        at = replace(whole, center=whole.on_ground(xy[None])[0])
        if at.center[2] < 2.0:  # else it is of the road above
            break
    size: Row = dict(radius=100.0, density=60, statics="map" if at.bodies else "none")
    scene = inspe_jax.build_scene(at, seed=seed, **size)
    there = scene.traffic.valid & (scene.traffic.kind != CLASSES.index("truck"))
    driven = inspe_jax.Objective(regions=("driveway", "junction")).within(scene)
    scene = replace(driven, traffic=replace(scene.traffic, valid=there))
    spec = spec_of(CARLA_LIDAR | dict(azimuth_step_deg=360 / 390), "carla", "SensorSpacing")
    row = np.array([place["row_x"], place["row_y"], 0, 0, 0, 0], float)
    middle = np.array([*xy, 2.0, 0, 0, np.radians(float(place["map_yaw_deg"]))])
    poses = middle + np.arange(1, 70)[:, None, None] * np.array([[-1.0], [0], [1]]) * row
    units = [Unit(f"{k}", tuple(foot)) for k, foot in enumerate(at.on_ground(poses[-1]))]
    layout = make_layout([Sensor(f"LiDAR {k}", spec, k) for k in range(3)], units, poses[-1])
    how: Row = dict(metrics=FURTHER[:1], detection=detection_curves().for_road_users(["car"]))
    found = inspe_jax.evaluate_many(scene, layout, poses, **how)
    values = {name: np.round(np.asarray(found.value(name), float), 5) for name in SCORED[:-1]}
    return [dict(spacing=1 + i) | {k: v[i] for k, v in values.items()} for i in range(69)]


def compared(scores: list[Row], ap: list[Row], vehicles: float) -> list[Row]:
    """How each score, and the spacing itself, goes with AP over the spacings of one place.

    Spearman's correlation; the same given the spacing; and how much less AP the spacing that a
    score prefers has than the best one: for the number of sensors, which prefers none, the mean.
    """
    by: dict[str, list[float]] = {}
    for row in ap:
        if row["flag"] in ("", "shifted?"):
            by.setdefault(row["spacing_m"], []).append(100 * float(row["ap50"]))
    scores = [row | dict(sensors=3) for row in scores if row["spacing"] in by]
    found = np.array([np.mean(by[row["spacing"]]) for row in scores])
    spacing, rows = rankdata([int(row["spacing"]) for row in scores]), []

    def beyond(x: np.ndarray) -> np.ndarray:
        """Ranks less their line over the spacing."""
        return rankdata(x) - np.polyval(np.polyfit(spacing, rankdata(x), 1), spacing)

    for name in ("sensors", "spacing", *SCORED[:-1]):
        x, least = np.array([float(row[name]) for row in scores]), found.max() - found.mean()
        row = dict(place=scores[0]["place"], vehicles=vehicles, mean_ap=round(found.mean(), 2))
        row |= dict(score=name, mean=round(x.mean(), 4), correlation=np.nan, given_spacing=np.nan)
        row["lost"] = round(found.max() - found[x.argmax()] if np.ptp(x) else least, 2)
        if np.ptp(x):
            row["correlation"] = round(spearmanr(x, found)[0], 4)
        if name in SCORED:  # one in the spacing's own order tells nothing beyond it
            own, other = beyond(x), beyond(found)
            given = np.corrcoef(own, other)[0, 1] if np.ptp(own) > 1e-6 else 0.0
            row["given_spacing"] = round(given, 4)
        rows.append(row)
    return rows


# ── All ─────────────────────────────────────────────────────────────────────


def table_of(path: Path) -> list[Row]:
    """The rows of a CSV below lines that begin with #."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return [*csv.DictReader(line for line in lines if not line.startswith("#"))]


def spread(values: Sequence[float]) -> tuple[float, float]:
    """A mean, and half of its interval of 95 % by Student's t; 0 of fewer than three."""
    few = len(values) < 3
    half = 0.0 if few else sem(values) * student.ppf(0.975, len(values) - 1)
    return (float(np.mean(values)) if len(values) else np.nan), float(half)


def charts(rows: list[Row], mcity: Mcity, chance: Row, spacing: list[Row]) -> Figure:
    """A panel for each comparison, with intervals; what was left out stays empty."""
    figure = Figure(figsize=(13, 9), layout="constrained")
    axes = figure.subplots(2, 2).ravel()
    names = dict(zip(SCORES, ("IG", "$P_{sm}$", "D"), strict=True))

    def line(k: int, x: Any, values: Iterable[Sequence[float]], look: str, **how: Any) -> None:
        means = np.array([spread(of) for of in values])
        axes[k].errorbar(x, means[:, 0], means[:, 1], fmt=look, capsize=3, **how)

    def of(name: str, **having: str) -> list[float]:
        return [float(row[name]) for row in rows if having.items() <= row.items()]

    published = [row["map_3d"] / 100 for row in deployments()["s110"]["published"].values()]
    axes[0].plot(published, "ks-", label="mAP, as published")
    use, number = mcity.car & ~mcity.blind, np.digitize(mcity.away, BINS) - 1
    for name in ("found", *PREDICTORS[1:]):
        values = mcity.found if name == "found" else chance[name]
        near = (use & (number == k) for k in range(len(BINS) - 1))
        each = [
            [values[at & (mcity.one == p)].mean() for p in np.unique(mcity.one[at])] for at in near
        ]
        if name != "found":
            each = [[np.mean(one)] if one else [] for one in each]
        line(1, BINS[:-1] + 2, each, "ks" if name == "found" else "-", label=name)
    for k, (name, symbol) in enumerate(names.items()):
        for cameras, look in (("as hung", "o-"), ("depth of the paper's", "o:")):
            own = dict(deployment="S110", profile="paper", cameras=cameras)
            label = f"{symbol}, {cameras}"
            line(
                0, range(3), [of(name, sensors=s, **own) for s in SETS], f"C{k}{look}", label=label
            )
        own = dict(deployment="InSPE", sensors="cameras")
        means = [of(name, cameras=f"at {pitch:g}°", **own) for pitch in PITCHES]
        line(3, PITCHES, means, f"C{k}o-", label=symbol)
        line(3, [DOWN], [of(name, cameras="as hung", **own)], f"C{k}*", ms=12)
    for k, name in enumerate(("spacing", *SCORES)):
        found = [row["correlation"] for row in spacing if row["score"] == name]
        axes[2].plot(k + np.linspace(-0.2, 0.2, len(found)), found, f"C{k}o")
    axes[0].set(title="S110, field of camera south2", ylim=(0, 1))
    axes[0].set(xticks=range(3), xticklabels=["4 cameras", "1 LiDAR", "both"])
    axes[1].set(title="Mcity: share of cars found, mean of passes", ylim=(-0.05, 1.05))
    axes[1].set(xlabel="distance from the LiDAR [m]")
    axes[2].set(title="SensorSpacing: correlation with AP, a point a place", ylim=(-1.05, 1.05))
    axes[2].set(xticks=range(4), xticklabels=["spacing itself", *names.values()])
    axes[3].set(title="InSPE's authors: their cameras, star: as hung", xlabel="pitch [°]")
    for k, ax in enumerate(axes):
        ax.grid(alpha=0.3)
        if k != 2:
            ax.legend(fontsize=8)
    return figure


def main() -> None:
    """Score, compare, draw and write."""
    help_ = "folder with what the project may not hold"
    given = arguments(__doc__, "seed", "keep", data=dict(type=Path, metavar="FOLDER", help=help_))
    stem, quick, seed = output(given, "real_deployments"), given.quick, given.seed
    parts = ("", "_mcity", "_spacing", "_spacing_scores")
    total, by_pass, by_place, kept_scores = (stem.with_name(f"{stem.name}{p}.csv") for p in parts)
    for path in (by_pass, by_place, *([total] if quick else [])):
        path.unlink(missing_ok=True)
    maps, data = MAPS.is_dir() and not quick, None if quick else given.data
    jobs: list[tuple[str, str, int, Make]] = [("S110", "paper", 1, partial(s110, quick=quick))]
    if not quick:
        jobs = [("S110", of, 10, s110) for of in ("paper", "ideal")] + [("A9", "paper", 1, a9)]
    if maps:
        entries = yaml.safe_load((HERE / "intersections.yaml").read_text(encoding="utf-8"))
        jobs.append(("InSPE", "paper", 10, partial(on_map, deployments()["inspe"])))
        jobs += [(entry["name"], "paper", 1, partial(on_map, entry)) for entry in entries]
    cases: dict[str, tuple[Scene, Layout]] = {}
    for name, profile, count, make in jobs:
        for own in range(seed, seed + count):
            key: Row = dict(deployment=name, profile=profile, seed=own)
            kept(total, key, partial(scored, name, make, profile, own, 2 if quick else None))
        if name in PLACES and name not in cases:
            scene, layout = make(profile, seed)
            cases[name] = scene, layout
    mcity = Mcity(quick)
    chance = mcity.predicted(mcity.car & ~mcity.blind, seed)
    append_rows(by_pass, mcity.rows(chance))
    spacing: list[Row] = []
    if data and maps:
        cases["V2X-Real"] = v2x_real(data)
        ap = table_of(data / "sensor_spacing" / "ap.csv")
        for place in table_of(data / "sensor_spacing" / "places.csv"):
            if not (MAPS / f"{place['town']}.xodr").is_file():
                continue
            key = dict(place=place["place"], seed=seed)
            scores = kept(kept_scores, key, partial(spaced, place, seed))
            found = [row for row in ap if row["place"] == place["place"]]
            spacing += compared(scores, found, float(place["vehicles"]))
        append_rows(by_place, spacing)
    else:
        say("left out: V2X-Real and SensorSpacing, which need --data and the town maps")
    if not maps:
        say("left out: InSPE's layout and the ten intersections, which need the town maps")
    if given.keep:
        given.keep.mkdir(parents=True, exist_ok=True)
    drawn(cases, given.keep, quick).savefig(stem.with_name(f"{stem.name}_views.png"), dpi=80)
    charts(read_rows(total), mcity, chance, spacing).savefig(stem.with_suffix(".png"), dpi=110)
    write_settings(stem.with_suffix(".json"), dict(seed=seed, mast=MAST, device=DEVICE))


if __name__ == "__main__":
    main()
