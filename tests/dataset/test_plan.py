"""Study files and protocols: the scenarios that they describe, and the message of every error."""

import shutil
from collections import Counter
from dataclasses import replace
from itertools import product
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import parse_yaml
from inspe_jax.dataset import load_generation, write_protocol
from inspe_jax.dataset.folders import SPLITS
from inspe_jax.dataset.plan import SETTINGS, _split
from inspe_jax.dataset.protocol import protocol_of
from inspe_jax.mounting.strategies import strategy
from inspe_jax.scene.procedural.built_ins import BUILT_INS, built_in
from inspe_jax.scene.scene import build_scene, save_scene
from inspe_jax.sensing.layout import layout_text
from inspe_jax.simulation.recorder import Recording

STUDY = """
scenes:
  - built_in: four_way
  - {built_in: roundabout, radius: 30, name: the circle, tags: {kind: roundabout}}
layouts: [Cam-d1, Cam-d1/L-d1]
settings:
  voxel: 1
  density: [low, 33]
  light: [midday, night]
  weather: [clear, "rain:10"]
  seed: [0, 7]
  seconds: 2
"""


@pytest.fixture
def read(tmp_path):
    def read(text=STUDY, **changes):
        path = tmp_path / "study.yaml"
        path.write_text(yaml.safe_dump(yaml.safe_load(text) | changes, sort_keys=False))
        return load_generation(path)

    return read


def test_every_combination_is_a_scenario(read):
    generation = read()
    assert generation.name == "study"
    assert len(generation.scenarios) == 64
    assert generation.frames == 64 * 20
    names = [plan.name for plan in generation.scenarios]
    scenes, layouts = ("four_way", "the_circle"), ("Cam-d1", "Cam-d1_L-d1")
    parts = scenes, layouts, ("low", "33"), ("midday", "night"), ("", "rain_10"), "07"
    assert {*names} == {"__".join(filter(None, each)) for each in product(*parts)}
    assert names[0] == "four_way__Cam-d1__low__midday__0"
    assert len({plan.seed for plan in generation.scenarios}) == 64
    assert len({plan.scene for plan in generation.scenarios}) == 8
    # Road users look the same in every layout, light and weather; the noise differs.
    looks = {(plan.scene, plan.appearance_seed) for plan in generation.scenarios}
    assert len(looks) == len({seed for _, seed in looks}) == 8
    for plan in generation.scenarios:
        assert set(plan.settings) == set(SETTINGS)
        assert plan.settings["radius"] == (30 if plan.source.name == "the circle" else 50)
        assert (plan.frames, plan.build["frames"], plan.build["step"]) == (20, 20, 0.1)
        assert plan.tags == ({"kind": "roundabout"} if plan.source.name == "the circle" else {})
    (plan, *_) = read(settings={}).scenarios
    assert (plan.frames, plan.settings["seconds"], plan.recording) == (100, 10, Recording())
    (plan, *_) = read(rate_hz=4, layers=["depth"], image_size=[40, 30]).scenarios
    assert plan.recording == Recording(rate=4, layers=("depth",), image_size=(40, 30))
    assert (plan.frames, plan.build["step"]) == (8, 0.25)


def test_names_say_what_varies_and_are_valid_for_folders(read):
    varied = dict(voxel=[1, 0.5], traffic="waypoints", mix=["mixed", "largest"], seconds=[1, 2])
    names = [plan.name for plan in read(settings=varied).scenarios]
    assert "four_way__Cam-d1__medium__midday__voxel-0.5__mix-largest__seconds-2__0" in names
    scenes = [{"built_in": "four_way", "name": name} for name in ("A/b", "a b", ".. ÄÖ", "é" * 300)]
    layouts = [{"strategy": "L-c", "name": "x" * 300}, "Cam-c"]
    names = [plan.name for plan in read(scenes=scenes, layouts=layouts).scenarios]
    assert len({name.lower() for name in names}) == len(names) == 4 * 2 * 16
    for name in names:
        assert len(name) < 200
        assert name.isascii()
        assert name[0] not in ".-"
        assert not {*"/\\: *"} & {*name}


def test_seed_and_split_depend_on_the_content_of_a_scenario(read, tmp_path):

    def facts(generation):
        return {(p.source.name, p.name.partition("__")[2]): p.seed for p in generation.scenarios}

    again = read(name="again", scenes=[{"built_in": "four_way", "tags": {"a": "b"}}])
    whole = read()
    assert facts(again).items() <= facts(whole).items()
    (tmp_path / "elsewhere").mkdir()
    shutil.copy(tmp_path / "study.yaml", tmp_path / "elsewhere")
    other = load_generation(tmp_path / "elsewhere" / "study.yaml")
    assert [p.split for p in other.scenarios] == [p.split for p in whole.scenarios]
    assert facts(read(pictures="jpeg")) == facts(whole)
    assert {plan.split for plan in read(splits=dict(test=1)).scenarios} == {"test"}


DENSITIES, KINDS = ["low", "medium", "high"], ("round", "crossing")
SIX = dict(
    scenes=[{"built_in": at, "tags": {"kind": KINDS[n % 2]}} for n, at in enumerate(BUILT_INS)],
    layouts=["Cam-d1", "L-d1"],
    settings=dict(density=DENSITIES, light=["midday", "night"], radius=30, seconds=2),
    splits=dict(train=4, test=2),
)


def places(generation, *of):
    """The splits in which each group of scenarios with the same ``of`` is."""
    found = {}
    for plan in generation.scenarios:
        found.setdefault(tuple(f(plan) for f in of), set()).add(plan.split)
    return found


def test_no_traffic_is_in_two_splits(read):
    seeds = list(range(10))
    settings = dict(seed=seeds, light=["midday", "night"], seconds=[1, 2], voxel=[0.5, 1])
    generation = read(settings=settings)
    where = places(generation, lambda plan: plan.source.name, lambda plan: plan.settings["seed"])
    assert len(where) == 20
    assert all(len(splits) == 1 for splits in where.values())
    assert [len(plans) for plans in generation.splits.values()] == [224, 32, 64]
    assert [len(plans) for plans in read(split_by="scenario").splits.values()] == [45, 6, 13]
    even = read(splits=dict(train=0.5, test=0.5), split_by="scenario")
    assert [len(plans) for plans in even.splits.values()] == [32, 0, 32]


@pytest.mark.parametrize("split_by", ["scene", "intersection"])
def test_splits_hold_every_density_and_kind_in_proportion(read, split_by):
    """Six intersections of two kinds at three densities, four scenarios of each scene."""
    generation = read(**SIX, split_by=split_by)
    assert [len(plans) for plans in generation.splits.values()] == [48, 0, 24]
    for split, plans in generation.splits.items():
        found = Counter((plan.settings["density"], plan.tags["kind"]) for plan in plans)
        for both in product(DENSITIES, KINDS):
            assert found[both] == len(plans) / 6, (split, *both)
    where = places(generation, lambda plan: plan.source.name)
    assert len(where) == 6
    assert all(len(splits) == 1 for splits in where.values()) == (split_by == "intersection")


@pytest.mark.parametrize("split_by", ["scene", "intersection"])
def test_a_place_with_two_names_is_one_place(read, split_by):
    scenes = [{"built_in": "four_way", "name": "a"}, {"built_in": "four_way", "name": "b"}]
    scenes[1]["radius"] = 30
    settings = dict(seed=list(range(6)), density=["low", 20, "high"], voxel=1)
    generation = read(scenes=scenes, settings=settings, split_by=split_by)
    where = places(generation, lambda plan: plan.settings["seed"], lambda plan: plan.density)
    assert len(where) == 12
    assert all(len(splits) == 1 for splits in where.values())
    assert len({plan.appearance_seed for plan in generation.scenarios}) == 12
    if split_by == "intersection":
        assert {plan.split for plan in generation.scenarios} == {"train"}
        assert "test is empty: 1 intersection for 3 splits; give more" in generation.notes[-1]


def saved(path, **options):
    scene = build_scene(built_in("four_way"), radius=15, voxel=2, density=5, **options)
    save_scene(scene, path)


def test_saved_scenes_of_one_place_are_one_intersection(read, tmp_path):
    for seed in (0, 1):
        saved(tmp_path / f"{seed}.npz", frames=4, step=0.1, seed=seed)
    scenes = [{"file": f"{seed}.npz"} for seed in (0, 1)]
    given = dict(scenes=scenes, settings={}, splits=dict(train=1, test=1))
    apart = read(**given).scenarios
    assert len({plan.split for plan in apart}) == 2  # the traffic differs
    together = read(**given, split_by="intersection").scenarios
    assert len({plan.split for plan in together}) == 1


@given(
    st.lists(st.tuples(st.sampled_from("ab"), st.sampled_from("xyz")), min_size=1, max_size=80),
    st.lists(st.floats(0, 10), min_size=3, max_size=3).filter(lambda of: sum(of) > 0.1),
    st.randoms(),
)
def test_splits_of_any_number(kinds, proportions, random):
    kinds = {f"key {n}": kind for n, kind in enumerate(kinds)}
    found = _split(kinds, proportions)
    assert set(found) == set(kinds)
    for split, share in zip(SPLITS, proportions, strict=True):
        many = list(found.values()).count(split)
        assert abs(many - share / sum(proportions) * len(kinds)) < 1 + 1e-6
        assert share or not many
    keys = list(kinds)
    random.shuffle(keys)
    assert _split({key: kinds[key] for key in keys}, proportions) == found


@pytest.mark.parametrize(("changes", "message"), [
    (dict(scenes=[{"built_in": "four_way", "frames": 3}]), r"scenes\[0\].frames: unknown key"),
    (dict(settings=dict(weather="hail")), r"settings.weather: weather 'hail'"),
    (dict(settings=dict(frames=5)), r"settings.frames: unknown key.*allowed: density, light"),
    (dict(settings=dict(seconds=0)), r"settings.seconds\[0\]: .*greater than 0"),
    (dict(settings=dict(seconds=0.25)), r"settings.seconds: 0.25 s are 2.5 frames at 10 Hz"),
    (dict(settings=dict(seconds=1e4)), r"settings.seconds: 10000 s are 100000 frames .* 10000"),
    (dict(rate=10), r"rate: unknown key; did you mean rate_hz"),
    (dict(layers=["depth", "depth"]), r"layers: two are named 'depth'"),
    (dict(image_size=[352, 0]), r"image_size \(width, height\)\[1\]: 0 is out of range"),
    (dict(pictures="jpg"), r"pictures: 'jpg': one of png, jpeg; did you mean jpeg"),
    (dict(cameras_per_agent=99), "as there are.: number: 99 is out of range: from 0 to 16"),
    (dict(splits=dict(train=0)), r"splits: one of train, validate, test must be above 0"),
    (dict(splits=dict(train=-1)), r"splits.train: .*greater than or equal to 0"),
    (dict(split_by="layout"), r"split_by: .*'intersection' or 'scenario', got 'layout'"),
])  # fmt: skip
def test_bad_studies(read, changes, message):
    with pytest.raises(InspeError, match=message):
        read(**changes)


def test_saved_scenes(read, tmp_path):
    saved(tmp_path / "saved.npz", frames=12, step=0.1)
    scenes = [{"file": "saved.npz"}]
    settings = dict(light=["midday", "night"])
    plans = read(scenes=scenes, settings=settings, layouts=["L-c"]).scenarios
    names = [f"saved__L-c__5__{light}__0" for light in ("midday", "night")]
    assert [(plan.name, plan.frames) for plan in plans] == [(name, 12) for name in names]
    settings["seconds"] = [1]
    plans = read(scenes=scenes, settings=settings).scenarios
    assert {plan.frames for plan in plans} == {10}
    settings["seconds"] = [1, 1.3]
    given = [{"file": "saved.npz", "radius": 20}]
    for changes, message in (
        (dict(settings=settings), "saved.npz has 12 frames, but 1.3 s at 10 Hz are 13"),
        (dict(settings={}, rate_hz=5), "saved.npz has frames 0.1 s apart, but rate_hz 5 needs"),
        (dict(scenes=given), r"scenes\[0\]: a saved scene keeps the settings it was built with;"),
    ):
        with pytest.raises(InspeError, match=message):
            read(**dict(scenes=scenes) | changes)


def protocol(plan, folder, backend="embedded", **changes):
    scene = build_scene(built_in("four_way"), radius=15, voxel=2, frames=1, density=0)
    layout = parse_yaml(layout_text(strategy(scene, "Cam-d1")), "layout")
    write_protocol(folder, protocol_of(plan, layout, backend) | changes)
    return folder / "data_protocol.yaml"


def test_a_protocol_is_its_scenario(read, tmp_path):
    for number, plan in enumerate(read(layers=["depth", "semantic"]).scenarios[::9]):
        path = protocol(plan, tmp_path / str(number), "carla")
        generation = load_generation(path)
        (again,) = generation.scenarios
        assert generation.backend == "carla"
        assert not generation.notes
        for key in ("name", "split", "source", "settings", "recording", "seed", "tags", "build"):
            assert getattr(again, key) == getattr(plan, key)
        same = protocol_of(again, parse_yaml(again.layout.text, ""), "carla")
        write_protocol(tmp_path / "again", same)
        assert (tmp_path / "again" / "data_protocol.yaml").read_bytes() == path.read_bytes()
    content = yaml.safe_load(path.read_text())
    content["versions"] |= {"numpy": "1.0"}
    path.write_text(yaml.safe_dump(content))
    (note,) = load_generation(path).notes
    assert note.startswith("made with numpy 1.0 (here ")
    path.write_text("[1, 2]")
    with pytest.raises(InspeError, match="the study is empty: it needs 'scenes' and 'layouts'"):
        load_generation(path)


@pytest.mark.parametrize("kind", ["map", "file"])
def test_protocols_find_their_maps(read, tmp_path, kind, monkeypatch):
    name = {"map": "place.xodr", "file": "saved.npz"}[kind]
    if kind == "file":
        saved(tmp_path / name, frames=20, step=0.1)
    else:
        (tmp_path / name).write_text("<OpenDRIVE/>")
    scene = {kind: name} | ({"center": [1, 2.5]} if kind == "map" else {})
    (plan, *_) = read(scenes=[scene]).scenarios
    folder = tmp_path / "set" / "train" / plan.name
    path = protocol(plan, folder)
    assert str(tmp_path) not in path.read_text()
    missing = rf"{name} was not found; searched in {folder}, .*/set, .*--f"
    with pytest.raises(InspeError, match=missing):
        load_generation(path)

    def found(files=None) -> Path:
        (again,) = load_generation(path, files).scenarios
        assert (again.settings, again.build) == (plan.settings, plan.build)
        assert replace(again.source, **{kind: str(tmp_path / name)}) == plan.source
        return Path(getattr(again.source, kind))

    for place in (tmp_path / "set", folder):  # the closest folder is searched first
        shutil.copy(tmp_path / name, place)
        assert found() == place / name
    with (folder / name).open("ab") as f:
        f.write(b" ")
    assert found() == tmp_path / "set" / name
    with pytest.raises(InspeError, match=rf"{name} has changed since the protocol was written; se"):
        load_generation(path, folder)
    assert found(tmp_path) == tmp_path / name
    (tmp_path / "set" / name).unlink()
    monkeypatch.chdir(tmp_path)
    assert found() == tmp_path / name


@pytest.mark.parametrize(("key", "value", "message"), [
    ("format", "inspe_jax scenario 9", r"format: 'inspe_jax scenario 9': one of inspe_jax sc"),
    ("format", None, r"a protocol that was not written by this package"),
    ("split", "trial", r"split: 'trial': one of train, validate, test; did you mean train"),
    ("name", "../../etc", r"name: string should match"),
    ("scene", {"name": "a", "built_in": "b"}, r"scene.built_in: 'b': one of four_way"),
    ("scene", {"built_in": "four_way"}, r"scene.name: missing key"),
    ("settings", {}, r"settings: radius: missing key"),
    ("settings.light", ["midday", "dusk"], r"settings: light: must be one value, got \['midda"),
    ("settings.seconds", 0.01, r"settings: seconds: 0.01 s are 0.1 frames at 10 Hz"),
    ("settings.wind", 1, r"settings: wind: unknown key"),
    ("recording.backend", "film", r"recording.backend: 'film': one of embedded, carla"),
    ("layout", {"units": []}, r"layout: units: needs at least 1, has 0"),
    ("colour", "red", r"colour: unknown key"),
])  # fmt: skip
def test_bad_protocols(read, tmp_path, key, value, message):
    path = protocol(read().scenarios[0], tmp_path)
    content = yaml.safe_load(path.read_text())
    *outer, last = key.split(".")
    place = content[outer[0]] if outer else content
    place[last] = value
    if value is None:
        del place[last]
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(InspeError, match=f"data_protocol.yaml: {message}"):
        load_generation(path)


def test_street_furniture_is_part_of_what_a_scenario_is(read, tmp_path):
    study = "{scenes: [{built_in: four_way}], layouts: [Cam-d1], settings: {seconds: 2}}"
    (plan,) = read(study).scenarios
    bare, street = read(study, settings=dict(seconds=2, statics=["none", "street"])).scenarios
    assert (bare.key, bare.scene) == (plan.key, plan.scene)
    assert street.key != bare.key
    assert street.scene != bare.scene
    assert (street.traffic_key, street.split) == (bare.traffic_key, bare.split)
    assert street.name == bare.name.replace("statics-none", "statics-street")
    (again,) = load_generation(protocol(street, tmp_path / "street")).scenarios
    assert again.build["statics"] == "street"
    assert again.settings == street.settings
