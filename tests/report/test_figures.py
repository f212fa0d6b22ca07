"""What a figure shows, read back from the figure: places, angles, colours, and room for text."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
import shapely.affinity
from drawn import misplaced, pixels, printed, texts
from matplotlib import colormaps, rc_context
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from worlds import CAMERA, LIDAR, no_traffic, place_sensors, random_layout, street_bodies, world

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.core.sheet import CLASS_COLORS, fit, save_figure
from inspe_jax.report import figures
from inspe_jax.report.bodies import BODY_COLORS, arrow_heads, body_keys, look_of
from inspe_jax.report.figures import REGION_COLORS, plan_view, scene_view
from inspe_jax.report.layers import MapLayer, layers
from inspe_jax.report.outlines import clear_outlines, view_outline
from inspe_jax.report.targets import targets_record, targets_table, targets_view
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import build_scene
from inspe_jax.scene.statics import KINDS, tree, upright_box
from inspe_jax.scoring.evaluate import Contribution, Scores
from inspe_jax.scoring.targets import target_view
from inspe_jax.scoring.viewshed import Viewshed
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import Sensor, Unit, make_layout
from inspe_jax.sensing.sensors import LidarSpec


def scores_of(scene, layout, share=None):
    """Scores as they might be; only seen_share and the four numbers are drawn."""
    share = np.linspace(0, 1, len(scene.voxels.columns)) if share is None else share
    drops = dict(coverage=0.01, occlusion=0.02, information_gain=0.03)
    parts = tuple(Contribution(s.name, drops, 0.019) for s in layout.sensors)
    found = dict(coverage=0.812, occlusion=0.703, information_gain=0.651)
    return Scores(found, 0.7253, {"driveway": 0.8}, parts, share, {})


@pytest.fixture(scope="module")
def scene():
    return world(radius=12, voxel=1.0, frames=2, count=6, center=(12.3, -7.7, 1.0))


@pytest.fixture(scope="module")
def pair():
    """One camera and one LiDAR at one place, away from the centre."""
    return place_sensors((CAMERA, [20, 0, 6, 0, -0.3, 2.0]), (LIDAR, [20, 0, 5, 0, 0, 0.0]))


def color_at(fig, xy):
    """The colour (3,) that is painted at a place of the map."""
    image = pixels(fig)
    column, row = fig.axes[0].transData.transform(xy)
    return image[len(image) - 1 - int(row), int(column)]


def drawn_boxes(fig):
    """(corners (N, 4, 2), face colours) of the road users, told by their four corners."""
    found = []
    for collection in fig.axes[0].collections:
        if isinstance(collection, PolyCollection):
            for path in collection.get_paths():
                if len(path.vertices) == 5:  # closed
                    found.append((path.vertices[:4], tuple(collection.get_facecolor()[0][:3])))
    return found


# ── The heat map ────────────────────────────────────────────────────────────


def test_a_map_shows_the_mean_or_the_most_frequent_kind_of_a_square(scene):
    """Of the columns within 1 m in x and in y; of equally many, the first kind."""
    rng, columns = np.random.default_rng(1), scene.voxels.columns
    near = np.abs(columns[:, None] - columns).max(-1) < 1.1
    values, kinds = rng.uniform(size=len(columns)), rng.integers(0, 2, len(columns)).astype(float)
    means = (near @ values) / near.sum(1)
    most = (near @ kinds) / near.sum(1)
    for layer, wanted in (
        (MapLayer("", values, averaged=True), means),
        (MapLayer("", values), values),
        (MapLayer("", kinds, kinds=(("x", ""), ("y", "")), averaged=True), most > 0.5),
    ):
        shown = figures.layer_raster(scene.voxels, layer)[0]
        where = figures.column_raster(scene.voxels, np.arange(len(columns)))[0]
        there = ~np.isnan(where)
        assert (there == ~np.isnan(shown)).all()
        np.testing.assert_allclose(shown[there], wanted[where[there].astype(int)], atol=1e-9)


def test_one_seen_column_is_painted_where_it_is(scene):
    empty = replace(scene, traffic=no_traffic())
    columns = scene.voxels.columns
    one = int(np.argmin(np.hypot(*(columns - [14.8, -13.2]).T)))  # south-east of the centre
    share = np.zeros(len(columns))
    share[one] = 1.0
    layout = place_sensors((replace(CAMERA, depth=1.0), [10.0, -2.0, 6, 0, -0.3, 2.0]))
    layer = MapLayer("", share)
    fig = plan_view(empty, layout, scores_of(scene, layout, share), layer)
    colors = colormaps["cividis"]
    assert color_at(fig, columns[one]) == pytest.approx(colors(1.0)[:3], abs=0.01)
    for beside in ([1, 0], [-1, 0], [0, 1], [0, -1]):
        assert color_at(fig, columns[one] + beside) == pytest.approx(colors(0.0)[:3], abs=0.01)


# ── What sensors look at ────────────────────────────────────────────────────


@pytest.mark.parametrize(("pitch", "height", "middle"), [
    (-20, 6.0, 400.0), (-75, 5.0, 400.0), (10, 4.0, 400.0), (-30, 20.0, 400.0), (-10, 6.0, 100.0),
    (-10, 6.0, 800.0),
])  # fmt: skip
def test_a_cameras_outline_holds_what_its_picture_shows_near_the_ground(pitch, height, middle):
    """Points at random are projected into the picture: another reading of the same camera, also
    where the middle of its picture is elsewhere."""
    pose, level = np.array([3.0, -4.0, 2.0 + height, 0.0, np.radians(pitch), 2.5]), 2.0
    outline = view_outline(replace(CAMERA, principal=(middle, 300.0)), pose, level)

    def shown(points, slack=0.0):
        x, y, z = rotation(pose[3:], np).T @ (points - pose[:3]).T
        near = (x > 0) & (np.linalg.norm(points - pose[:3], axis=1) < CAMERA.depth)
        across, down = CAMERA.focal * np.array([y, z]) / np.maximum(x, 1e-9)
        across, down = np.abs(middle - CAMERA.width / 2 - across), np.abs(down)
        return near & (across < CAMERA.width / 2 + slack) & (down < CAMERA.height / 2 + slack)

    rng = np.random.default_rng(0)
    points = rng.uniform([-30, -34, level], [36, 26, pose[2] + 6], (40_000, 3))
    points[::2, 2] = level
    seen = points[shown(points)]
    assert len(seen) > 300
    within = shapely.Polygon(outline).buffer(0.05)  # chords cut off 3 cm at most
    assert shapely.within(shapely.points(seen[:, :2]), within).all()
    # And no more: above every corner, a hundredth of the way back, there is a point that it shows.
    heights = np.linspace(level, pose[2] + 31, 4000)
    for corner in outline:
        at = pose[:2] + 0.99 * (corner - pose[:2])
        column = np.column_stack([np.tile(at, (len(heights), 1)), heights])
        assert shown(column, 0.5).any() or np.hypot(*(corner - pose[:2])) < 1e-9


def test_a_lidar_looks_all_round_or_in_a_sector():
    pose = np.array([1.0, 2.0, 5.0, 0.0, 0.0, -2.0])
    circle = view_outline(LIDAR, pose, 0.0)
    assert np.hypot(*(circle - pose[:2]).T) == pytest.approx(50.0)
    assert circle[0] == pytest.approx(circle[-1])
    assert shapely.Polygon(circle).area == pytest.approx(np.pi * 50**2, rel=1e-3)
    sector = LidarSpec("sector", (-0.1, 0.0), 80, np.radians(80), 20.0)
    away = view_outline(sector, pose, 0.0)[1:-1] - pose[:2]  # less the sensor's own place
    assert np.hypot(*away.T) == pytest.approx(20.0)
    turn = (np.arctan2(away[:, 1], away[:, 0]) - pose[5] + np.pi) % (2 * np.pi) - np.pi
    assert np.degrees([turn.min(), turn.max()]) == pytest.approx([-40, 40])


def test_outlines_are_drawn_as_computed(scene, pair):
    fig = plan_view(scene, pair, scores_of(scene, pair))
    lines = [line.get_xydata() for line in fig.axes[0].lines]
    for sensor, pose in zip(pair.sensors, np.asarray(pair.poses), strict=True):
        level = scene.intersection.ground(pose[None, :2])[0]
        wanted = view_outline(sensor.spec, pose, level)
        assert any(xy.shape == wanted.shape and np.allclose(xy, wanted) for xy in lines)


def test_an_outline_ends_at_houses(scene):
    """A house of 5 m below a LiDAR at 6 m hides the ground up to six times as far as its own."""
    house = upright_box("building", np.array([22.3, -7.7]), (2.0, 4.0, 5.0), 0.0)
    tree_ = tree(np.array([12.3, 2.3]), radius=1.0, height=8.0, base=2.0)
    there, pose = scene.with_statics([house, tree_]), np.array([12.3, -7.7, 6.0, 0, 0, 0])
    pose[2] += scene.intersection.ground(pose[None, :2])[0]
    whole = shapely.Polygon(view_outline(LIDAR, pose, pose[2] - 6.0))
    (outer,) = clear_outlines(scene, LIDAR, pose)
    assert shapely.Polygon(outer).equals(whole)
    rings = clear_outlines(there, LIDAR, pose)
    seen = shapely.Polygon(rings[0], rings[1:])
    assert seen.within(whole.buffer(1e-6))
    for x, y, clear in (
        (8.9, 0.0, True), (10.0, 0.0, False), (40.0, 0.0, False), (40.0, 6.0, False),
        (40.0, 12.0, True), (0.0, 14.0, True),
    ):  # fmt: skip
        assert seen.contains(shapely.Point(pose[:2] + [x, y])) == clear


@pytest.mark.parametrize("length", [0, 5, 68, 69, 110, 150, 400])
def test_no_text_is_cut(length):
    """It is smaller, or on lines that are together hardly higher than the one."""
    words = ("a name " * 100)[:length].strip()
    found = fit(words, 68, 10.0)
    lines = found["s"].split("\n")
    assert " ".join(lines) == words
    assert max(map(len, lines)) * found["size"] <= 680 + 1e-9
    assert len(lines) * found["size"] <= 12 + 1e-9
    assert (found["size"] == 10.0) == (length <= 68)


def test_numbers_keep_apart_however_crowded_the_sensors_are():
    rng = np.random.default_rng(1)
    for case in range(30):
        count = rng.integers(2, 20)
        spots = rng.uniform(-10, 10, (rng.integers(1, 5), 2))
        anchors = spots[rng.integers(0, len(spots), count)]
        turn = rng.uniform(-np.pi, np.pi, count) * (case % 2)  # half the cases all wish the same
        wish = np.column_stack([np.cos(turn), np.sin(turn)])
        place = figures.spread_badges(anchors, wish, 3.0)
        apart = np.hypot(*(place[:, None] - place).T) + 9 * np.eye(count)
        assert apart.min() > 2.99
        cross = np.hypot(*(place[:, None] - anchors).reshape(-1, 2).T)
        assert cross.min() > 0.749 * 3
        assert np.hypot(*(place - anchors).T).max() < 4 * 3.0  # and near what they name
    alone = figures.spread_badges(np.array([[5.0, 6.0]]), np.array([[0.0, -1.0]]), 2.0)
    assert alone[0] == pytest.approx([5.0, 4.0], abs=0.01)


def test_the_list_names_unit_device_and_height_above_its_base(scene):
    units = [Unit("north pole", (0.0, 0.0, 101.0)), Unit("no sensors", (9.0, 0.0, 0.0))]
    layout = make_layout([Sensor("a", CAMERA, 0)], units, np.array([[0, 0, 107.25, 0, 0, 0.0]]))
    words = [t for t, _ in texts(plan_view(scene, layout, scores_of(scene, layout)))]
    assert {"north pole", "test-camera, 6.2 m"} <= set(words)
    assert "no sensors" not in words


# ── Road users and regions ──────────────────────────────────────────────────


@pytest.mark.parametrize("frame", [0, 1])
def test_road_users_of_a_frame_are_oriented_rectangles_in_the_colour_of_their_class(scene, frame):
    traffic = scene.traffic
    kind = np.arange(traffic.kind.size).reshape(traffic.kind.shape) % 4
    turned = replace(traffic, kind=kind.astype(np.int8), yaw=traffic.yaw + 0.5)
    found = drawn_boxes(scene_view(replace(scene, traffic=turned), frame=frame))
    users = np.flatnonzero(traffic.valid[frame])
    assert len(found) == len(users)
    for k in users:
        (x, y), half = turned.center[frame, k, :2], turned.size[frame, k, :2] / 2
        level = shapely.box(x - half[0], y - half[1], x + half[0], y + half[1])
        lying = shapely.affinity.rotate(level, turned.yaw[frame, k], use_radians=True)
        away = [shapely.hausdorff_distance(shapely.Polygon(corners), lying) for corners, _ in found]
        assert min(away) < 1e-5
        assert found[np.argmin(away)][1] == to_rgb(CLASS_COLORS[kind[frame, k]])


@pytest.mark.parametrize("frame", [-1, 2])
def test_a_frame_that_is_not_there_is_refused(scene, pair, frame):
    for draw in (
        lambda: scene_view(scene, frame=frame),
        lambda: plan_view(scene, pair, scores_of(scene, pair), frame=frame),
    ):
        with pytest.raises(InspeError, match=f"frame {frame} is out of range: .* frames 0 to 1"):
            draw()


def test_regions_are_painted_by_precedence_within_the_circle_and_around_holes(scene):
    middle = shapely.Point(12.3, -7.7)
    ring = middle.buffer(30).difference(middle.buffer(4))
    crosswalk = shapely.box(12.3 - 30, -7.7 + 6, 12.3 + 30, -7.7 + 8)
    place = replace(
        scene.intersection,
        regions={Region.SIDEWALK: middle.buffer(30).difference(middle.buffer(9)),
                 Region.DRIVEWAY: ring, Region.CROSSWALK: crosswalk},
        mounting=shapely.MultiPolygon(),
    )  # fmt: skip
    fig = scene_view(replace(scene, intersection=place, traffic=no_traffic()))

    def painted(x, y):
        return pytest.approx(color_at(fig, (12.3 + x, -7.7 + y)), abs=0.01)

    assert to_rgb("white") == painted(0, 0)  # the hole
    assert to_rgb(REGION_COLORS[Region.DRIVEWAY]) == painted(0, -6)
    assert to_rgb(REGION_COLORS[Region.DRIVEWAY]) == painted(-10, 0)  # over the sidewalk
    assert to_rgb(REGION_COLORS[Region.CROSSWALK]) == painted(3, 7)
    assert to_rgb("white") == painted(-12.3, 3)  # beyond the circle


# ── The sheet ───────────────────────────────────────────────────────────────


@pytest.fixture(scope="module")
def sheets():
    """Both views of a full scene: 12 sensors that crowd, long names, notes and odd characters."""
    full = build_scene(built_in("four_way"), radius=40, voxel=2.0, frames=2, density="low")
    notes = ("a note with $odd$ _characters_ that runs on and on " * 5, "another note")
    name = "a crossing of two $roads$ with a name that is far too long to fit into one line" * 2
    full = replace(full, intersection=replace(full.intersection, notes=notes, name=name))
    layout = random_layout(full, [CAMERA] * 8 + [LIDAR] * 4, seed=3)
    units = [replace(u, name=f"{u.name} with a $name$ longer than the panel") for u in layout.units]
    poses = np.array(layout.poses)
    poses[:6, :2] = poses[0, :2]
    layout = replace(layout, units=tuple(units), poses=poses)
    return [scene_view(full), plan_view(full, layout, scores_of(full, layout))]


def test_a_sheet_is_180_mm_wide_and_says_the_scores_and_no_text_touches_another(sheets):
    for fig in sheets:
        assert len(texts(fig)) > 20
        assert misplaced(fig) == []
        assert fig.get_size_inches()[0] * 25.4 == pytest.approx(180)
    words = " ".join(t for t, _ in texts(sheets[1]))
    for number in ("C 0.812", "O 0.703", "IG 0.651", "0.725"):
        assert number in words


def test_many_sensors_make_the_sheet_higher_and_those_beyond_the_circle_the_map_wider(scene):
    layout = random_layout(scene, [CAMERA] * 40, seed=0)
    poses = np.array(layout.poses)
    poses[7, 0] = 52.3
    layout = replace(layout, poses=poses)
    fig = plan_view(scene, layout, scores_of(scene, layout))
    assert fig.axes[0].get_xlim()[1] > 52.3
    assert fig.get_size_inches()[1] > 10
    assert sum("test-camera" in t for t, _ in texts(fig)) == 40
    assert min(box.y0 for _, box in texts(fig)) >= 0


def test_no_traffic_no_routes_and_no_poles_can_be_drawn(scene, pair):
    empty = replace(scene, traffic=no_traffic())
    assert not drawn_boxes(scene_view(empty))
    assert "road user" not in [t for t, _ in texts(plan_view(empty, pair, scores_of(scene, pair)))]


def test_arrow_heads_point_along_the_lanes():
    full = build_scene(built_in("roundabout"), radius=40, voxel=2.0, density="none")
    heads = arrow_heads(full)
    assert len(heads) > 8
    along = [r.waypoints[:, :2] for r in full.intersection.routes if r.user == "vehicle"]
    for at, ahead in heads:
        assert np.hypot(*(at - full.voxels.center[:2])) < 40
        steps = [
            (p[k + 1] - p[k]) / np.hypot(*(p[k + 1] - p[k]))
            for p in along
            for k in [int(np.hypot(*(p - at).T).argmin())]
            if k + 1 < len(p) and np.hypot(*(p[k] - at)) < 0.01
        ]
        assert max(step @ ahead for step in steps) == pytest.approx(1.0)


# ── Files ───────────────────────────────────────────────────────────────────


def test_a_figure_is_written_by_its_suffix_the_same_each_time(scene, pair, tmp_path):
    drawn = [plan_view(scene, pair, scores_of(scene, pair)) for _ in range(2)]
    for suffix, magic in ((".PNG", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")):
        path, written = tmp_path / f"a{suffix}", []
        for figure in drawn:
            save_figure(figure, path)
            written.append(path.read_bytes())
        assert written[0].startswith(magic)
        assert written[0] == written[1]
        assert b"CreationDate" not in written[0]  # it tells seconds: too slow to differ above


def test_the_readers_own_settings_change_nothing(scene, tmp_path):
    save_figure(scene_view(scene), tmp_path / "plain.png")
    with rc_context({"font.size": 30, "axes.facecolor": "black", "savefig.bbox": "tight"}):
        save_figure(scene_view(scene), tmp_path / "odd.png")
    assert (tmp_path / "plain.png").read_bytes() == (tmp_path / "odd.png").read_bytes()


# ── Static bodies, and what a road user gets ─────────────────────────────────


@pytest.fixture(scope="module")
def street():
    scene = world(count=0, slope=0.03, center=(40.0, -20.0, 3.0))
    return scene.with_statics(street_bodies(scene.intersection))


def test_a_map_has_the_outline_of_every_body(street):
    (ax, *_) = scene_view(street).axes
    drawn = [
        path.vertices[:-1]
        for collection in ax.collections
        if isinstance(collection, PolyCollection) and collection.zorder == 3.5
        for path in collection.get_paths()
    ]
    assert len(drawn) == len(street.statics)
    for one in street.statics:
        assert any(
            len(found) == len(one.outline) and np.allclose(found, one.outline) for found in drawn
        )


def test_the_legend_has_the_kinds_in_the_circle_each_once(street):
    far = upright_box("hedge", street.voxels.center[:2] + 400.0, (2, 2, 2))
    others = tuple(one for one in street.statics if one.kind != "hedge")
    scene = street.with_statics([*others, far])
    found = ", ".join(key.get_label() for key in body_keys(scene)).split(", ")
    assert sorted(found) == sorted({one.kind for one in others})
    assert set(BODY_COLORS) == set(KINDS)
    assert look_of("tree")["fc"] == "none"  # the ground beneath is seen
    rim = upright_box("building", street.voxels.center[:2] + [25.0, 0.0], (30, 10, 6))
    (key,) = body_keys(street.with_statics([rim]))  # its middle is outside the circle
    assert key.get_label() == "building"


def test_layers_have_no_value_within_a_body(street):
    """Nor does a voxel within one count as not seen."""
    grid = street.voxels
    inside = np.asarray(street.inside_statics)
    whole = inside.all(1)
    part = inside.any(1) & ~whole
    assert whole.any()
    assert part.any()
    free = ~inside.ravel()
    everything = Viewshed(sensors=3 * free, seen=5 * free, occupied=0 * free, frame_count=5)
    found = layers(street, everything)
    for name, value in (("seen", 1.0), ("redundancy", 3.0), ("blind", 0.0)):
        values = found[name].values
        assert np.isnan(values[whole]).all()
        np.testing.assert_allclose(values[~whole], value, err_msg=name)
    assert len(values) == len(grid.columns)


def test_radars_are_no_lidars():
    """Radars have no returns: alone they have the map of chances; beside a LiDAR its map is of the
    LiDAR."""
    scene, pose = world(radius=12, voxel=1.0, frames=3, count=5), [-10.0, 0.0, 6.0, 0.0, -0.3, 0.0]
    radar = device("continental-ars408-near").spec
    alone, both = place_sensors((radar, pose)), place_sensors((radar, pose), (LIDAR, pose))
    for layout, lidar in ((alone, False), (both, True)):
        view = target_view(scene, layout, "car")
        record = targets_record(scene, layout, view)
        assert ("lidar_returns" in record) == lidar
        assert "pixels_per_metre" not in record
        assert ("LiDAR returns" in printed(targets_table(record))) == lidar
        figure = targets_view(scene, layout, view)
        assert len(figure.axes) == 1 + lidar
        assert any("LiDAR returns" in words for words, _ in texts(figure)) == lidar
        assert record["detectability"]["all"] > 0


def test_lines_of_the_legend_are_no_longer_than_its_panel_is_wide():
    scene, pose = world(radius=12, voxel=1.0, frames=1, count=5), [-10.0, 0.0, 6.0, 0.0, -0.3, 0.0]
    specs = [device(name).spec for name in ("axis-q1951-e", "flir-fc-644-o")]
    labels = [
        key.get_label()
        for key in figures.plan_keys(scene, place_sensors(*[(s, pose) for s in specs]))
    ]
    assert labels[0] == "thermal camera, view to\n46.1, 99 m"
