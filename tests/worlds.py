"""Small scenes with known answers, and a segment–triangle oracle, for the tests."""

import json
from collections.abc import Iterable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from shapely.geometry import box, mapping

from inspe_jax.core.geometry import rotation
from inspe_jax.core.parallel import at_precision
from inspe_jax.scene.intersection import Intersection
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.statics import StaticBody, body, octagon, pole, tree, upright_box, wall
from inspe_jax.scene.traffic.frames import TrafficFrames
from inspe_jax.scene.voxels import build_voxels
from inspe_jax.sensing.layout import Layout, Sensor, Unit, make_layout
from inspe_jax.sensing.sensors import CameraSpec, LidarSpec, Spec

MAPS = Path(__file__).resolve().parents[1].parent / "shared" / "maps"
"""Town maps beside the checkout; tests that need them skip where they are absent."""
DEPLOYMENTS = MAPS.parent / "deployments"
"""Calibrations of real deployments, with the poses that they are of; beside them too."""
needs_deployments = pytest.mark.skipif(
    not DEPLOYMENTS.is_dir(), reason="the deployments are not beside this checkout"
)

LIDAR = LidarSpec(
    "test-lidar", tuple(np.radians(np.linspace(-25, 2, 32)).tolist()), 1800, 2 * np.pi, 50.0
)
CAMERA = CameraSpec(
    "test-camera", 800, 600, 400 / np.tan(np.radians(50)), (400.0, 300.0), 0.1, 30.0, 0.9
)

BARREL = CameraSpec(
    "barrel", 1920, 1080, 1150.0, (930.0, 560.0), 0.1, 30.0,
    distortion=(-0.28, 0.09, 1e-3, -2e-3, -0.013),
)  # fmt: skip
CEILING = CameraSpec(
    "ceiling", 1280, 960, 339.7, (634.0, 460.0), 0.1, 30.0,
    fisheye=True, image_circle=np.radians(185.0),
)  # fmt: skip
"""As those of Mcity, but for the circle."""
CIRCULAR = CameraSpec(
    "circular", 1280, 1280, 380.0, (640.0, 640.0), 0.1, 30.0,
    fisheye=True, image_circle=np.radians(150.0), distortion=(-0.03, 0.004, -0.002, 3e-4),
)  # fmt: skip


TINY = dict(radius=10.0, voxel=2.0, frames=2, count=6)
"""The size of :func:`world` where gradients are taken and differences of them."""
SMALL = dict(radius=15.0, voxel=1.0)
"""And where soft scores are, in single precision."""
TALL = dict(radius=10.0, voxel=0.12, frames=2)
"""And where columns have more levels than a word has bits."""
BOXES = 16
"""Up to so many road users are filled up to as many, since each number would be compiled anew."""


def rilsa() -> Path:
    """A signalled four-way with crossings that comes with SUMO; skips where SUMO is absent."""
    sumo = pytest.importorskip("sumo", reason="needs SUMO: extra [sumo]")
    home = Path(sumo.SUMO_HOME)
    return home / "tools" / "sumolib" / "scenario" / "scenarios" / "RiLSA1" / "rilsa1.net.xml"


def write_geojson(path: Path, features: Iterable[Any], to_file: Any, **members: Any) -> Path:
    """Writes shapes and their properties, in the coordinates that ``to_file`` makes of theirs."""
    rows = [
        dict(type="Feature", geometry=mapping(shapely.transform(shape, to_file)), properties=own)
        for shape, own in features
    ]
    path.write_text(json.dumps(dict(type="FeatureCollection", features=rows, **members)))
    return path


def slow_but(names: Iterable[Any], *quick: Any) -> list[Any]:
    """Parameters, marked as slow but for a few, which show what the others show of more."""
    return [name if name in quick else pytest.param(name, marks=pytest.mark.slow) for name in names]


def crossing(
    slope: float = 0.0, center: tuple[float, float, float] = (0, 0, 0), width: float = 14.0
) -> Intersection:
    """Two straight roads with sidewalks; the ground rises by ``slope`` along x."""
    x, y, z = center
    roads = shapely.union(
        box(x - 120, y - width / 2, x + 120, y + width / 2),
        box(x - width / 2, y - 120, x + width / 2, y + 120),
    )
    sidewalk = roads.buffer(4, join_style="mitre").difference(roads)
    at = np.stack(np.meshgrid(*[np.arange(-130, 131, 5.0)] * 2, indexing="ij"), -1).reshape(-1, 2)
    return Intersection(
        name="test crossing",
        source="tests",
        center=np.array(center, float),
        regions={
            Region.DRIVEWAY: roads,
            Region.JUNCTION: box(x - width / 2, y - width / 2, x + width / 2, y + width / 2),
            Region.SIDEWALK: sidewalk,
        },
        arms=(),
        routes=(),
        mounting=sidewalk,
        poles=np.zeros((0, 3)),
        ground_points=np.column_stack([at + [x, y], z + slope * at[:, 0]]),
    )


def still(frames: int, count: int) -> dict[str, Any]:
    """What boxes that never move have beside their places; entry b is the same all along."""
    return dict(
        track=np.tile(np.arange(count), (frames, 1)),
        velocity=np.zeros((frames, count, 3)),
        time=np.arange(frames, dtype=float),
    )


def random_traffic(
    place: Intersection, frames: int, count: int, radius: float, seed: int
) -> TrafficFrames:
    """Boxes anywhere at any heading, some of them padding, standing on the ground."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-radius, radius, (frames, count, 2)) + place.center[:2]
    size = rng.uniform([2, 0.6, 1.4], [9, 2.5, 3.5], (frames, count, 3))
    z = place.ground(xy.reshape(-1, 2)).reshape(frames, count) + size[..., 2] / 2
    return _filled_up(
        np.concatenate([xy, z[..., None]], -1),
        rng.uniform(-np.pi, np.pi, (frames, count)),
        size,
        rng.uniform(size=(frames, count)) < 0.9,
    )


def _filled_up(
    center: np.ndarray, yaw: np.ndarray, size: np.ndarray, valid: np.ndarray
) -> TrafficFrames:
    """Cars at (T, B) places; what is added to them is nowhere and not valid."""
    frames, count = valid.shape
    more = max(BOXES - count, 0)

    def fill(x: np.ndarray, value: float = 0) -> np.ndarray:
        by = [(0, 0), (0, more)] + [(0, 0)] * (x.ndim - 2)
        return np.pad(x, by, constant_values=value)

    return TrafficFrames(
        center=fill(center),
        yaw=fill(yaw),
        size=fill(size, 1),
        valid=fill(valid),
        kind=np.zeros((frames, count + more), np.int8),
        **still(frames, count + more),
    )


def no_traffic() -> TrafficFrames:
    """One frame of an empty road."""
    nobody, vectors = np.zeros((1, 0)), np.zeros((1, 0, 3))
    kind = nobody.astype(np.int8)
    return TrafficFrames(vectors, nobody, vectors, nobody.astype(bool), kind, **still(1, 0))


def emptied(scene: Scene) -> Scene:
    """A scene in whose frames there is nobody; programs that serve the scene serve it too."""
    traffic = scene.traffic
    return replace(scene, traffic=replace(traffic, valid=np.zeros_like(traffic.valid)))


def world(
    *,
    radius: float = 20.0,
    voxel: float = 0.5,
    spacing: float | None = None,
    frames: int = 4,
    count: int = 12,
    seed: int = 0,
    slope: float = 0.0,
    center: tuple[float, float, float] = (0, 0, 0),
) -> Scene:
    """A test crossing with random traffic."""
    place = crossing(slope, center)
    traffic = random_traffic(place, frames, count, radius, seed) if count else no_traffic()
    voxels = build_voxels(place, radius=radius, voxel=voxel, spacing=spacing)
    return Scene(voxels, traffic, place)


def street_bodies(place: Intersection) -> list[StaticBody]:
    """Bodies of every kind about the centre of :func:`crossing`, some at odd angles."""
    at = place.center[:2]
    ell = np.array([[0, 0], [9, 0], [9, 3], [4, 3], [4, 7], [0, 7]], float)
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    return [
        body("building", ell @ turn.T + at + [9.0, 8.5], 6.0),
        body("building", octagon(at + [-13.0, -12.0], 3.0), 4.5, base=2.2),
        *wall(np.array([[-18.0, 8.6], [-11.0, 8.6], [-9.5, 12.0]]) + at, 1.7, width=0.25),
        *wall(np.array([[9.0, -8.5], [16.0, -9.5]]) + at, 1.1, width=0.8, kind="hedge"),
        tree(at + [9.1, -9.6], radius=1.8, height=7.0, base=2.5),
        tree(at + [-8.6, 10.4], radius=2.2, height=6.0, base=1.8, trunk=0.25, transmittance=0.4),
        tree(at + [-9.0, -8.0], radius=1.5, height=5.0, base=2.0, transmittance=0.8),
        pole(at + [7.4, 7.6], radius=0.1, height=6.0),
        upright_box("furniture", at + [-8.4, 4.0], (3.0, 1.2, 2.5), np.pi / 2),
        upright_box("parked vehicle", at + [5.5, -12.0], (4.6, 1.8, 1.5), 1.55),
    ]


def with_boxes(
    scene: Scene, *boxes: tuple[float, float, float, float, float, float], frames: int = 1
) -> Scene:
    """One frame of given boxes, each (x, y, yaw, length, width, height), on the ground; or the same
    several times."""
    b = np.array(boxes, float).reshape(-1, 6)
    z = scene.intersection.ground(b[:, :2]) + b[:, 5] / 2
    center = np.column_stack([b[:, :2], z])
    one = center[None], b[None, :, 2], b[None, :, 3:], np.ones((1, len(b)), bool)
    traffic = _filled_up(*(np.repeat(x, frames, 0) for x in one))
    return replace(scene, traffic=traffic)


def place_sensors(*sensors: tuple[Spec, list[float]]) -> Layout:
    """Each sensor on a unit of its own: (spec, [x, y, z, roll, pitch, yaw]) in metres, radians."""
    units = [Unit(f"u{i}", (p[0], p[1], 0.0)) for i, (_, p) in enumerate(sensors)]
    members = [Sensor(f"s{i}", spec, i) for i, (spec, _) in enumerate(sensors)]
    return make_layout(members, units, np.array([p for _, p in sensors], float))


def random_layout(
    scene: Scene, specs: list[Spec], seed: int, heights: tuple[float, float] = (1.0, 8.0)
) -> Layout:
    """Sensors anywhere near the centre, at ``heights`` above the ground there."""
    rng = np.random.default_rng(seed)
    n = len(specs)
    xy = rng.uniform(-15, 15, (n, 2)) + scene.voxels.center[:2]
    z = scene.intersection.ground(xy) + rng.uniform(*heights, n)
    angles = rng.uniform([-0.1, -0.6, -np.pi], [0.1, 0.1, np.pi], (n, 3))
    poses = np.column_stack([xy, z, angles])
    return place_sensors(*zip(specs, poses.tolist(), strict=True))


# Two triangles a face; corners 0–3 are the bottom's, 4–7 the top's.
_FACES = np.array(
    [[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6], [0, 4, 5], [0, 5, 1]]
    + [[1, 5, 6], [1, 6, 2], [2, 6, 7], [2, 7, 3], [3, 7, 4], [3, 4, 0]]
)


def triangles(scene: Scene, frame: int, depth: float = 50.0) -> np.ndarray:
    """The vehicles of a frame and the static bodies as triangles (N, 3, 3), carried ``depth``
    metres into the ground; and the terrain, if the scene has one."""
    t, found = scene.traffic, [body_triangles(scene, depth)]
    if (terrain := scene.terrain) is not None:
        found.append(terrain.points[terrain.faces])
    for b in np.flatnonzero(t.valid[frame]):
        (length, width, height), (x, y, z) = t.size[frame, b], t.center[frame, b]
        foot, size = (x, y, z - height / 2 - depth), (length, width, height + depth)
        found.append(box_triangles(foot, size, t.yaw[frame, b]))
    return np.concatenate(found)


def body_triangles(scene: Scene, depth: float = 50.0) -> np.ndarray:
    """The static bodies as triangles (N, 3, 3): whole outlines, not the pieces of scores."""
    found = [np.zeros((0, 3, 3))]
    for one in scene.statics:
        ground = float(scene.intersection.ground(one.middle[None])[0])
        bottom = one.base if one.base > 0 else -depth
        solids = [(one.outline, bottom, one.height)]
        if one.trunk > 0:
            solids.append((octagon(one.middle, one.trunk), -depth, one.base))
        for outline, low, high in solids:
            a, b = outline, np.roll(outline, -1, 0)
            a0, b0, a1, b1 = (
                np.column_stack([p, np.full(len(p), ground + z)])
                for p, z in ((a, low), (b, low), (a, high), (b, high))
            )
            found += [np.stack([a0, b0, b1], 1), np.stack([a0, b1, a1], 1)]
            cut = shapely.constrained_delaunay_triangles(shapely.Polygon(outline)).geoms
            flat = np.array([t.exterior.coords[:3] for t in cut])
            for z in (low, high):
                level = np.full((*flat.shape[:2], 1), ground + z)
                found.append(np.concatenate([flat, level], 2))
    return np.concatenate(found)


def box_triangles(foot: Any, size: Any, yaw: float) -> np.ndarray:
    """One upright box on its foot as triangles (12, 3, 3)."""
    flat = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.asarray(size[:2]) / 2
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    corners = flat @ turn.T
    solid = [np.column_stack([corners, np.full(4, z)]) for z in (0.0, size[2])]
    return (np.concatenate(solid) + np.asarray(foot))[_FACES]


def rays_on_box(
    spec: Spec, pose: Any, foot: Any, size: Any, edges: Any = (0.0, np.inf), headings: int = 6
) -> np.ndarray:
    """Rays of a grid that meet an upright box on its foot, by the height at which they do, the mean
    over headings: every ray against the box's slabs."""
    turn = rotation(np.asarray(pose[3:], float), np)
    to = np.asarray(foot) + [0, 0, size[2] / 2] - np.asarray(pose[:3])
    ratio = np.linalg.norm(size) / 2 / np.linalg.norm(to)
    body = _directions(spec)
    toward = body @ (turn.T @ to) / np.linalg.norm(to)
    rays = body[toward > (np.sqrt(1 - ratio**2) - 1e-6 if ratio < 1 else -1)] @ turn.T
    found = []
    for yaw in (np.arange(headings) + 0.3) * np.pi / headings:
        axes = rotation(np.array([0.0, 0.0, yaw]), np).T
        start, along = axes @ -to, rays @ axes.T
        with np.errstate(divide="ignore"):
            ends = (np.array([-1, 1])[:, None, None] * np.asarray(size) / 2 - start) / along
        first, last = ends.min(0).max(1), ends.max(0).min(1)
        met = (first < last) & (last > 0) & (first < spec.grid.reach)
        found.append(np.histogram((pose[2] + first * rays[:, 2] - foot[2])[met], edges)[0])
    return np.mean(found, 0)


@cache
def _directions(spec: Spec) -> np.ndarray:
    return spec.grid.directions()


def embree_line_of_sight(scene: Scene, layout: Layout, frame: int) -> np.ndarray:
    """Line of sight (S, V) by Embree: no triangle between each sensor and each voxel's centre."""
    # No wheel on every platform; then this oracle is left out.
    core = pytest.importorskip("embreex.rtcore_scene")
    mesh = pytest.importorskip("embreex.mesh_construction")
    engine, shift = core.EmbreeScene(), scene.voxels.center
    mesh.TriangleMesh(engine, (triangles(scene, frame) - shift).astype(np.float32))
    clear = []
    for pose in np.asarray(layout.poses):
        to = scene.voxels.centers - pose[:3]
        distance = np.linalg.norm(to, axis=1)
        hit = engine.run(
            np.repeat((pose[:3] - shift)[None], len(to), 0).astype(np.float32),
            (to / distance[:, None]).astype(np.float32),
            dists=distance.astype(np.float32),
        )
        clear.append(hit < 0)
    return np.stack(clear)


def solid_voxels(scene, frame):
    """The voxels (V,) whose centre is in a vehicle, by turning each into the vehicle's frame."""
    t, centers = scene.traffic, scene.voxels.centers
    solid = np.zeros(len(centers), bool)
    for b in np.flatnonzero(t.valid[frame]):
        c, yaw, size = t.center[frame, b], t.yaw[frame, b], t.size[frame, b]
        d = centers[:, :2] - c[:2]
        x, y = d @ [np.cos(yaw), np.sin(yaw)], d @ [-np.sin(yaw), np.cos(yaw)]
        stands = (np.abs(x) < size[0] / 2) & (np.abs(y) < size[1] / 2)
        solid |= stands & (centers[:, 2] < c[2] + size[2] / 2)
    return solid


double_precision = partial(at_precision, True)
"""Floats of 64 bits within."""
