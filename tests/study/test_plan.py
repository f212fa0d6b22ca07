"""Study files: which jobs they mean, and the one message of every bad one."""

import json
import shutil
from itertools import product

import pytest
import yaml
from osm_town import full_town

from inspe_jax.core.errors import InspeError
from inspe_jax.jobs.sources import place_layout, scene_of
from inspe_jax.mounting.mixes import starting_layout
from inspe_jax.mounting.strategies import strategy
from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import build_scene, save_scene
from inspe_jax.scoring.detection import detection_curves
from inspe_jax.sensing.layout import layout_text, save_layout
from inspe_jax.study.plan import SCORE_ONLY, SETTINGS, Study, load_study

STUDY = """
scenes:
  - built_in: four_way
  - {built_in: roundabout, radius: 30, name: circle, tags: {kind: roundabout}, note: one voxel size}
layouts:
  - Cam-d1
  - {strategy: l-d2, lidar: paper-lidar-32, name: thirty-two}
settings:
  voxel: 1
  density: [low, 33]
  light: [midday, night]
  weather: [clear, "rain:10"]
"""


@pytest.fixture(scope="module")
def scene():
    return build_scene(built_in("four_way"), radius=15, voxel=2, frames=2, density=5)


@pytest.fixture
def read(tmp_path):
    def read(text, **changes):
        content = yaml.safe_load(text) | changes
        path = tmp_path / "study.yaml"
        path.write_text(yaml.safe_dump(content))
        return load_study(path)

    return read


def test_every_combination_is_a_job(read):
    study, plain = read(STUDY, metrics=["redundancy"]), read(STUDY)
    assert study.metrics == (*plain.metrics, "redundancy")
    assert [job.key for job in study.jobs] == [job.key for job in plain.jobs]
    assert Study("some", study.jobs[2:]).metrics == study.metrics
    assert study.name == "study"
    assert study.tags == ("kind",)
    got = [
        (j.source.name, j.settings["density"], j.layout.name, j.settings["light"],
         j.settings["weather"]) for j in study.jobs
    ]  # fmt: skip
    weather = ("clear", "rain:10")
    layouts = ("Cam-d1", "thirty-two")
    assert got == [
        *product(("four_way", "circle"), ("low", 33), layouts, ("midday", "night"), weather)
    ]
    assert len({job.key for job in study.jobs}) == 32
    assert len({job.scene for job in study.jobs}) == 4
    for job in study.jobs:
        assert set(job.settings) == set(SETTINGS)
        assert job.settings["radius"] == (30 if job.source.name == "circle" else 50)
        assert (job.settings["voxel"], job.settings["frames"]) == (1, 100)
        assert (job.settings["method"], job.settings["seconds"]) == (SCORE_ONLY, None)
    assert study.jobs[0].layout.strategy == "Cam-d1"
    assert study.jobs[4].layout.options == (("lidar", "paper-lidar-32"),)


def test_what_a_job_is_called_depends_on_all_that_its_result_does(read):
    """And on nothing else: not on its study's name, on notes or tags, or how rain is spelt."""
    keys = {job.key for job in read(STUDY).jobs}
    for same in (
        STUDY.replace("settings:", "name: again\nsettings:"),
        STUDY.replace("one voxel size", "something else"),
        STUDY.replace("kind: roundabout", "size: large"),
        STUDY.replace("rain:10", "RAIN"),
    ):
        assert same != STUDY
        assert {job.key for job in read(same).jobs} == keys
    half = {job.key for job in read(STUDY.replace("paper-lidar-32", "paper-lidar-64")).jobs}
    assert len(half & keys) == len(keys) / 2
    for setting in ("seed: 1", "frames: 99", "visibility: line_of_sight", "statics: street"):
        other = {job.key for job in read(STUDY + f"  {setting}\n").jobs}
        assert not other & keys


def test_curves_of_detection_are_part_of_what_a_job_is(read, tmp_path):
    """By what they are, not by the name of their file; the usual ones are as none."""
    plain = read(STUDY)
    car = "[lidar.car]\nmost = 0.9\nhalf = {}\nslope = 1\n"
    keys = {}
    for name, half in (("a", 10), ("b", 10), ("c", 20)):
        (tmp_path / f"{name}.toml").write_text(car.format(half))
        study = read(STUDY, detection=f"{name}.toml")
        assert study.jobs[0].detection.of("lidar")[0].half == half
        keys[name] = {job.key for job in study.jobs}
    assert keys["a"] == keys["b"]
    assert not keys["a"] & keys["c"]
    assert not keys["a"] & {job.key for job in plain.jobs}
    (tmp_path / "usual.json").write_text(json.dumps(detection_curves().record))
    assert read(STUDY, detection="usual.json").jobs == plain.jobs
    with pytest.raises(InspeError, match=r"study.yaml: detection: .*no such file"):
        read(STUDY, detection="none.toml")


def test_a_search_has_a_budget_and_a_score_has_none(read):
    study = read(
        STUDY,
        settings=dict(method=["none", "grid"], seconds=[5, 10], search_seed=[0, 1], density="low"),
    )
    per_layout = [
        (job.settings["method"], job.settings["seconds"], job.settings["search_seed"])
        for job in study.jobs
        if job.source.name == "circle" and job.layout.name == "Cam-d1"
    ]
    assert per_layout == [
        ("none", None, None),
        *(("grid", seconds, seed) for seconds in (5, 10) for seed in (0, 1)),
    ]
    default = read(STUDY, settings=dict(method="grid"))
    assert default.jobs[0].settings["seconds"] == 60


def test_weights_are_by_name(read):
    """However they are spelt, the same weights are the same job."""
    given = dict(occlusion=0.3, coverage=0.2, information_gain=0.5)
    study = read(STUDY, settings=dict(weights=given))
    assert study.jobs[0].settings["weights"] == given
    one = read(STUDY, settings=dict(weights={"localisation": 1}))
    assert one.metrics == (*study.metrics, "localisation")
    zero = given | dict(detectability=0)
    assert read(STUDY, settings=dict(weights=[zero])).jobs == study.jobs
    two = read(STUDY, settings=dict(weights=[given, {"coverage": 1}]))
    assert len(two.jobs) == 2 * len(study.jobs)
    usual = dict(coverage=0.3, occlusion=0.5, information_gain=0.2)
    assert read(STUDY, settings=dict(weights=usual)).jobs == read(STUDY, settings={}).jobs


def test_devices_of_ones_own(read, scene):
    """They reach the sensors that name them, and their figures are part of what a job is."""
    own = {"far": {"like": "paper-camera", "depth_m": 60}}
    layouts = [{"strategy": "Cam-d1", "camera": "far", "name": "far"}, "Cam-d1"]
    study = read(STUDY, devices=own, layouts=layouts)
    specs = {
        job.layout.name: {sensor.spec for sensor in place_layout(job.layout, scene).sensors}
        for job in study.jobs
    }
    (far,), (near,) = specs["far"], specs["Cam-d1"]
    assert (far.name, far.depth, near.name, near.depth) == ("far", 60, "paper-camera", 38)
    own["far"]["depth_m"] = 61
    other = read(STUDY, devices=own, layouts=layouts)
    same = {job.key for job in study.jobs} & {job.key for job in other.jobs}
    assert len(same) == len(study.jobs) / 2
    with pytest.raises(InspeError, match=r"devices.far: depth_m: .*greater than 0"):
        read(STUDY, devices={"far": {"like": "paper-camera", "depth_m": 0}})


def test_a_mix_of_devices_is_a_layout(read, scene):
    """As `inspe pareto` begins with it; a device of which there is none is as if not named."""
    mix = {"paper-camera": 1, "paper-lidar-32": 2}
    study = read(STUDY, layouts=[{"mix": mix}, {"mix": {"far": 1}, "name": "one that sees far"}],
                 devices={"far": {"like": "paper-camera", "depth_m": 60}})  # fmt: skip
    own = {job.layout.name: job.layout for job in study.jobs}
    assert list(own) == ["1 paper-camera + 2 paper-lidar-32", "one that sees far"]
    placed, far = (place_layout(layout, scene) for layout in own.values())
    start = starting_layout(scene, mix)
    assert layout_text(placed) == layout_text(start)
    assert [sensor.spec.depth for sensor in far.sensors] == [60]
    with_none = read(STUDY, layouts=[{"mix": mix | {"ideal-camera": 0}}])
    assert {job.key for job in with_none.jobs} < {job.key for job in study.jobs}
    assert len({job.key for job in study.jobs}) == len(study.jobs)
    more = read(STUDY, layouts=[{"mix": mix | {"paper-camera": 2}, "name": placed.name}])
    assert not {job.key for job in more.jobs} & {job.key for job in study.jobs}


def test_saved_scenes_and_layout_files(read, scene, tmp_path):
    save_scene(scene, tmp_path / "saved.npz")
    save_layout(strategy(scene, "L-c"), tmp_path / "mine.yaml")
    study = read(STUDY, scenes=[{"file": "saved.npz"}], layouts=["mine.yaml"])
    (first, *_), settings = study.jobs, study.jobs[0].settings
    assert (settings["radius"], settings["voxel"], settings["density"]) == ("15", "2", "5")
    assert len(study.jobs) == 4  # its density is what it is
    assert first.layout.text == (tmp_path / "mine.yaml").read_text()
    keys = [job.key for job in study.jobs]

    folder = tmp_path / "elsewhere"
    folder.mkdir()
    for name in ("saved.npz", "mine.yaml", "study.yaml"):
        shutil.copy(tmp_path / name, folder / name)
    assert [job.key for job in load_study(folder / "study.yaml").jobs] == keys
    text = (tmp_path / "mine.yaml").read_text()
    (folder / "mine.yaml").write_text(text.replace("yaw_deg: 0.0", "yaw_deg: 1.0"))
    assert not set(keys) & {job.key for job in load_study(folder / "study.yaml").jobs}
    beside = read(STUDY, layouts=["L-c", "mine.yaml"])
    assert {job.layout.name for job in beside.jobs} == {"L-c", "mine"}


def test_an_extract_is_read_with_the_side_that_is_given(read, tmp_path):
    pytest.importorskip("sumolib", reason="needs SUMO: extra [sumo]")
    full_town().write(tmp_path / "town.osm")
    place = {"map": "town.osm", "junction": "1", "voxel": 2, "frames": 1}
    own, left = read(STUDY, scenes=[place, place | {"name": "l", "driving_side": "left"}]).jobs[
        ::16
    ]
    assert own.scene != left.scene
    assert scene_of(own.source, own.build).intersection.driving_side is None
    assert scene_of(left.source, left.build).intersection.driving_side == "left"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(scenes=[]), r"study.yaml: scenes: needs at least 1, has 0"),
        (dict(scenes=[{}]), r"scenes\[0\]: give exactly one of built_in, map and file"),
        (dict(scenes=[{"built_in": "five_ways"}]), r"scenes\[0\].built_in.*did you mean five_way"),
        (
            dict(scenes=[{"built_in": "four_way", "center": [1, 2]}]),
            "center and driving_side are only",
        ),
        (
            dict(scenes=[{"map": "study.yaml", "junction": 1, "driving_side": "left"}]),
            "only OpenStreet",
        ),
        (dict(scenes=[{"built_in": "four_way", "radios": 3}]), r"unknown key; did you mean radius"),
        (dict(scenes=[{"built_in": "four_way"}] * 2), r"scenes: two are named 'four_way'"),
        (dict(scenes=[{"map": "a.xodr", "junction": 3}]), r"a.xodr: no such file"),
        (dict(scenes=[{"map": "study.yaml"}]), "choose a place on the map: give either junction"),
        (dict(layouts=["Cam-d9"]), r"layouts\[0\]: no strategy 'Cam-d9'.*did you mean Cam-d"),
        (dict(layouts=["L-c", "l-c"]), r"layouts: two are named 'L-c'"),
        (dict(layouts=[{"name": "x"}]), r"layouts\[0\]: give either a strategy or a file"),
        (dict(layouts=[{"mix": {"paper-camera": 1}, "lidar": "x"}]), "a mix has its own devices"),
        (dict(layouts=[{"mix": {"paper-camara": 1}}]), r"layouts\[0\].mix: no device 'paper-cam"),
        (dict(layouts=[{"mix": {"paper-camera": 0}}]), r"layouts\[0\].mix: needs at least one"),
        (dict(layouts=[{"strategy": "L-c", "name": "two\nlines"}]), r"layouts\[0\].name: string"),
        (dict(settings=dict(density="many")), r"settings.density: density 'many': none, low"),
        (dict(settings=dict(light=["midday", "noon"])), r"settings.light: light 'noon': one of"),
        (dict(settings=dict(mix="bikes")), r"settings.mix: 'bikes': one of mixed, fleet, largest"),
        (dict(settings=dict(method="adm")), r"settings.method: 'adm': one of none, .*mean adam"),
        (dict(settings=dict(weights={"coverage": 0.5})), r"settings.weights: .* sum to 1"),
        (dict(settings=dict(weights={"coverage": "all"})), r"settings.weights\[0\].coverage: .*"),
        (dict(settings=dict(frames=0)), r"settings.frames\[0\]: .*greater than or equal to 1"),
        (dict(settings=dict(seconds=[])), r"settings.seconds: needs at least 1"),
        (dict(settings=dict(occlusion_reference="all")), r"occlusion_reference 'all': one of"),
        (dict(metrics=["detectabilty"]), "metrics: .*did you mean detectability"),
        (dict(settings=dict(lights="dusk")), r"settings.lights: unknown key; did you mean light"),
    ],
)
def test_bad_studies(read, changes, message):
    with pytest.raises(InspeError, match=message):
        read(STUDY, **changes)
