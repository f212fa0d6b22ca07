"""Tables keep every number whole at any width; the record is the scores, to the last bit."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from drawn import printed, row
from worlds import CAMERA, LIDAR, place_sensors, world

from inspe_jax.core.errors import InspeError
from inspe_jax.core.tables import table_of
from inspe_jax.report import scene_tables
from inspe_jax.report.tables import RADARS, scores_record, scores_table, sweep_table
from inspe_jax.scene.maps.road_map import JunctionInfo
from inspe_jax.scene.profiles import profiles
from inspe_jax.scoring.evaluate import Contribution, Scores
from inspe_jax.sensing.catalogue import devices
from inspe_jax.sensing.layout import Sensor, Unit, make_layout

METRICS = ("coverage", "occlusion", "information_gain", "surrogate")


def named(*values):
    return dict(zip(METRICS[:3], values, strict=True))


SCORES = Scores(
    metrics=dict(coverage=0.8123456789012345, occlusion=0.1 + 0.2, information_gain=1 / 3),
    surrogate=0.7004999,
    region_coverage={"driveway": 0.901, "crosswalk": 0.456},
    contributions=(
        Contribution("cam a", named(0.0123 + 1e-9, 0.0456, 0.0789), 0.01 / 1.01),
        Contribution("[red]top[/red]", named(-0.0001, 0.2222, 0.0), 0.1111),
    ),
    seen_share=np.zeros(3),
    settings={"weights": named(0.3, 0.5, 0.2), "occlusion_reference": "roi", "at": np.float32(0.5)},
    parts={
        "core": named(0.91, 0.92, 0.93) | {"surrogate": 0.94},
        "outside": named(0.21, 0.22, 0.23) | {"surrogate": 0.24},
    },
)


@pytest.fixture(scope="module")
def scene():
    made = world(radius=12, voxel=1.0, frames=3, count=5)
    return replace(made, settings=(("radius", "12"), ("seed", "0")))


@pytest.fixture(scope="module")
def layout():
    units = [Unit("mast", (-10.0, 0.0, 0.0)), Unit("pole [1]", (10.0, 0.0, 100.0))]
    members = [Sensor("cam a", CAMERA, 0), Sensor("[red]top[/red]", LIDAR, 1)]
    turn = np.radians([[0.0, -15.5, 270.0], [0.0, 0.0, -180.0]])
    poses = np.column_stack([[[-10.0, 0.5, 6.0], [10.0, 0.0, 104.5]], turn])
    return make_layout(members, units, poses, "a layout")


# ── Scores ──────────────────────────────────────────────────────────────────


def test_the_record_is_the_scores_exactly(scene, layout):
    record = scores_record(SCORES, scene, layout)
    assert json.loads(json.dumps(record)) == record
    assert set(record) == {
        *METRICS, "region_coverage", "parts", "contributions", "blind_spots", "settings", "scene",
        "layout", "versions",
    }  # fmt: skip
    assert record["settings"] == SCORES.settings | {"at": 0.5}
    about = dict(name="test crossing", source="tests", settings={"radius": "12", "seed": "0"})
    assert (record["scene"], record["layout"]) == (about, "a layout")
    assert set(record["versions"]) == {"inspe_jax", "jax", "numpy"}
    for name in METRICS:
        assert record[name] == getattr(SCORES, name)
    assert record["region_coverage"] == SCORES.region_coverage
    assert record["parts"] == SCORES.parts
    assert [(c["sensor"], c["unit"], c["device"]) for c in record["contributions"]] == [
        ("cam a", "mast", "test-camera"),
        ("[red]top[/red]", "pole [1]", "test-lidar"),
    ]
    for part, given in zip(record["contributions"], SCORES.contributions, strict=True):
        assert [part[name] for name in METRICS] == [getattr(given, name) for name in METRICS]


@pytest.mark.parametrize("make", [lambda s, w, la: scores_table(s, la), scores_record])
def test_scores_of_another_layout_are_refused(scene, make):
    other = place_sensors((CAMERA, [5, 5, 6, 0, 0, 0]), (LIDAR, [-5, 5, 5, 0, 0, 0]))
    with pytest.raises(InspeError, match=r"another layout: of sensors cam a, .* expected s0, s1"):
        make(SCORES, scene, other)


@pytest.mark.parametrize("width", [80, 160])
def test_scores_for_people_are_whole(layout, width):
    text = printed(scores_table(SCORES, layout), width)
    assert row(text, "coverage", "C")[2:6] == ["0.3", "0.812", "0.910", "0.210"]
    assert row(text, "occlusion", "O")[2:4] == ["0.5", "0.300"]
    assert row(text, "information", "gain", "IG")[3:5] == ["0.2", "0.333"]
    assert "0.700" in row(text, "surrogate", "P_sm")
    words = " ".join(text.split())
    assert "driveway 0.22 0.901" in words
    assert "crosswalk 0.23 0.456" in words
    assert row(text, "1", "cam", "a")[-4:] == ["+0.0123", "+0.0456", "+0.0789", "+0.0099"]
    assert "-0.0001  +0.2222  +0.0000  +0.1111" in text
    assert "[red]top" in text  # names are not markup


def test_scores_say_that_coverage_is_only_where_a_radar_looks(layout):
    assert RADARS not in " ".join(printed(scores_table(SCORES, layout), 80).split())
    radar = devices()["continental-ars408-near"].spec
    sensors = [layout.sensors[0], replace(layout.sensors[1], spec=radar)]
    both = make_layout(sensors, layout.units, layout.poses, "a layout")
    assert RADARS in " ".join(printed(scores_table(SCORES, both), 80).split())


# ── Scene, layout, catalogue, map ───────────────────────────────────────────


def test_a_scene_for_people(scene):
    text = printed(scene_tables.scene_table(scene))
    count = len(scene.voxels.columns)
    assert f"{count:,} columns × 4 levels = {4 * count:,}; voxel 1 m" in text
    assert "one every" not in text
    apart = replace(scene, voxels=replace(scene.voxels, size=0.2))
    words = printed(scene_tables.scene_table(apart)).split()
    assert "voxel 0.2 m, one every 1 m" in " ".join(words)
    assert f"3 frames, {scene.traffic.mean_count:.1f} road users" in text
    assert "radius 12, seed 0" in text
    for region, key in ((1, "junction"), (3, "sidewalk")):
        columns = int((scene.voxels.region == region).sum())
        assert row(text, key)[2:] == [f"{columns:,}", f"{columns / count:.1%}"]
    assert "crosswalk" not in text


def test_a_layout_for_people(layout):
    text = printed(scene_tables.layout_table(layout))
    # Height is above the unit's base, and yaw lies in (−180°, 180°].
    camera = ["test-camera", "-10.0", "0.5", "6.0", "-90.0", "-15.5"]
    assert row(text, "1", "cam", "a")[-6:] == camera
    assert row(text, "2")[-6:] == ["test-lidar", "10.0", "0.0", "4.5", "180.0", "0.0"]
    assert "roll" not in text
    poses = np.array(layout.poses)
    poses[0, 3] = math.radians(-3)
    tilted = printed(scene_tables.layout_table(layout.with_poses(poses)))
    assert "roll" in tilted
    assert row(tilted, "1", "cam", "a")[-2:] == ["-15.5", "-3.0"]


# ── Narrow terminals ────────────────────────────────────────────────────────


def junctions(*ids):
    infos = [JunctionInfo(i, (-12.5, 7.0, 0.0), 4, 44.26, 12, 3) for i in ids]
    return scene_tables.junctions_table(infos, "city.osm")


def mixes():
    table = table_of("Cost", "mix", "cost\n[US$]", "C", "O", "IG", "P_sm", "objective", "")
    for cost in (10_800, 1_234_567):
        name = "2 velodyne-vlp-32c + 4 basler-aca1600-60gc"
        table.add_row(name, f"{cost:,}", "0.812", "0.300", "0.333", "0.701", "0.7004", "front")
    return table


SWEPT = dict(layout="Cam-d1/L-d1", status="done", coverage="0.81", occlusion="0.3", surrogate="0.7")


@pytest.mark.parametrize("width", [40, 80])
@pytest.mark.parametrize("table", [
    mixes(),
    junctions("cluster_1580411983_1580411984_26704401_26704402_29271345_3_4_5_6_7_8_9"),
    junctions(*range(26704401, 26704409)),
    *scene_tables.devices_table(devices()).renderables[:3],
    *(scene_tables.profile_table(profile) for profile in profiles().values()),
    sweep_table([SWEPT]),
    scene_tables.built_ins_table(),
], ids=lambda x: str(getattr(x, "title", x)).split(":")[0])  # fmt: skip
def test_no_table_cuts_a_number_or_a_name(table, width):
    """Lines are longer than the terminal where they must be; only long words of prose break."""
    lines = [line.rstrip() for line in printed(table, width).splitlines()]
    whole = [str(cell) for column in table.columns if column.no_wrap for cell in column.cells]
    for cell in whole:
        assert any(line == cell or f" {cell} " in f" {line} " for line in lines), cell
    for column in table.columns:
        for unit in re.findall(r"\[.*\]", str(column.header)):
            assert unit in " ".join(lines)
    for column in table.columns:
        for word in " ".join(map(str, column.cells)).split():
            assert len(word) > 24 or word in " ".join(lines)


@pytest.mark.parametrize("width", [60, 80])
def test_what_is_too_wide_goes_on_below_beside_the_names_of_its_rows(width):
    numbers = [f"{k}.0000" for k in range(12)]
    table = table_of("What each sensor adds, in a title as long as a line", "#", "sensor", *numbers)
    table.add_row("1", "corner 1 camera 1", *numbers)
    table.add_row("2", "corner 1 camera 2", *numbers)
    lines = printed(table, width).splitlines()
    assert max(map(len, lines)) <= width
    assert sum("corner 1 camera 2" in line for line in lines) > 1
    assert lines[0].startswith(str(table.title))
    first = [line for line in lines if line.strip().startswith("1 ")]
    assert [cell for line in first for cell in line.split() if cell in numbers] == numbers
