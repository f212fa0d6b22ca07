"""Plans as GeoJSON, KML and bills: read back here, by GDAL, and against KML's schema."""

import csv
import io
import json
from dataclasses import replace

import numpy as np
import pytest
import shapely
from shapely.geometry import Point, shape

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.strategies import strategy
from inspe_jax.report.handover import bill_of_materials, plan_geojson, plan_kml
from inspe_jax.report.schedule import installation_schedule
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.scene import build_scene
from inspe_jax.sensing.layout import make_layout
from inspe_jax.sensing.layout_geojson import load_layout_geojson

PRICES = {"paper-camera": 900.0, "hesai-xt32": 5000.5}

pyproj = pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")

SYSTEMS = {
    "utm": Georeference("EPSG:25832", (-691600.0, -5334700.0)),
    "far east of its meridian": Georeference("EPSG:25832", (-900000.0, -5334700.0)),
    "mercator": Georeference("EPSG:3857", (-1288500.0, -6130000.0)),
    "swiss": Georeference("EPSG:2056", (-2600000.0, -1200000.0)),
}


@pytest.fixture(scope="module")
def scene():
    place = replace(inspe_jax.built_in("t_junction"), georeference=SYSTEMS["utm"])
    return build_scene(place, radius=25, voxel=2.0, frames=1, density=2)


@pytest.fixture(scope="module")
def layout(scene):
    """One camera is a device of the layout's own."""
    placed = strategy(scene, "Cam-d1/L-d1", lidar="hesai-xt32")
    poses = np.array(placed.poses)
    poses[1, 3:] = np.radians([3.0, -17.25, 179.99])
    first, *rest = placed.sensors
    own = replace(first, spec=replace(first.spec, name="my-camera", reliability=0.5))
    return replace(placed, poses=poses, sensors=(own, *rest))


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_plan_is_read_back_as_the_layout(scene, layout, system, tmp_path):
    """To 2 mm and 0.0001°: PROJ inverts a change of datum to about a millimetre."""
    place = replace(scene.intersection, georeference=SYSTEMS[system])
    path = tmp_path / "plan.geojson"
    path.write_text(plan_geojson(layout, place))
    again = load_layout_geojson(path, replace(scene, intersection=place))
    assert [s.name for s in again.sensors] == [s.name for s in layout.sensors]
    assert [s.spec for s in again.sensors] == [s.spec for s in layout.sensors]
    assert [u.name for u in again.units] == [u.name for u in layout.units]
    assert (again.name, again.profile) == (layout.name, layout.profile)
    apart = np.asarray(again.poses) - np.asarray(layout.poses)
    assert np.abs(apart[:, :3]).max() < 2e-3
    turned = (np.degrees(apart[:, 3:]) + 180) % 360 - 180
    assert np.abs(turned).max() < 1e-4


def test_units_say_what_they_stand_on_as_the_schedule_does(scene, layout, tmp_path):
    """The first beside an existing pole, and still read back where the layout has it."""
    foot = np.array(layout.units[0].base)
    place = replace(scene.intersection, poles=(foot + [0.3, 0.4, 0.0])[None])
    text = plan_geojson(layout, place)
    about = [f["properties"] for f in json.loads(text)["features"]]
    units = [one for one in about if one["feature"] == "unit"]
    rows = installation_schedule(layout, place, {})
    assert [one["stands_on"] for one in units] == [row.pole for row in rows]
    assert units[0]["stands_on"] == "existing pole"
    assert units[0]["pole"] == pytest.approx(rows[0].degrees[::-1], abs=1e-9)
    assert ["pole" in one for one in units[1:]] == [False] * (len(units) - 1)
    (tmp_path / "plan.geojson").write_text(text)
    again = load_layout_geojson(tmp_path / "plan.geojson", replace(scene, intersection=place))
    np.testing.assert_allclose(again.units[0].base[:2], foot[:2], atol=2e-3)


def test_angles_and_heights_are_those_of_the_field(scene, layout):
    """By hand: a camera that looks east at the origin of a transverse Mercator, 6 m up."""
    east = Georeference("+proj=tmerc +lat_0=48 +lon_0=11")
    place = replace(scene.intersection, georeference=east)
    level = place.ground(np.zeros((1, 2)))[0]
    poses = np.array([[0.0, 0.0, 6.0 + level, 0.0, np.radians(-15), 0.0]])
    unit = replace(layout.units[0], base=(0.0, 0.0, 0.0))
    one = make_layout([replace(layout.sensors[0], unit=0)], [unit], poses)
    features = json.loads(plan_geojson(one, place))["features"]
    base, sensor, view = (f["geometry"]["coordinates"] for f in features)
    assert base == sensor == [11.0, 48.0]
    own = features[1]["properties"]
    assert own["azimuth_deg"] == pytest.approx(90.0, abs=1e-4)
    assert (own["pitch_deg"], own["height_m"]) == (-15.0, 6.0)
    # It sees the ground to the east, within its depth.
    depth = one.sensors[0].spec.grid.reach
    ring = np.array(view[0])
    distance = pyproj.Geod(ellps="WGS84").inv(*np.tile([[11.0], [48.0]], len(ring)), *ring.T)[2]
    assert 0.9 * depth < distance.max() < 1.01 * depth
    assert ring[:, 0].max() > 11.0001
    assert (ring[:, 0] > 11.0 - 1e-9).all()
    assert Point(11.00005, 48.0).within(shape(features[2]["geometry"]).buffer(1e-6))


def test_gdal_reads_the_plan_and_what_it_saves_is_still_the_layout(scene, layout, tmp_path):
    """Saved anew, it is without the file's own members, and coordinates have other names."""
    pyogrio = pytest.importorskip("pyogrio", reason="needs pyogrio: extra [test]")
    path = tmp_path / "plan.geojson"
    path.write_text(plan_geojson(layout, scene.intersection))
    meta, _, geometry, fields = pyogrio.raw.read(path)
    assert meta["crs"] == "EPSG:4326"
    rows = dict(zip(meta["fields"], fields, strict=True))
    kinds = list(rows["feature"])
    assert kinds.count("sensor") == kinds.count("view") == len(layout)
    assert kinds.count("unit") == len(layout.units)
    found = shapely.from_wkb(geometry)
    assert shapely.is_valid(found).all()
    georeference = scene.intersection.georeference
    at = [shapely.get_coordinates(g)[0] for g, kind in zip(found, kinds, strict=True)
          if kind == "sensor"]  # fmt: skip
    back = georeference.from_degrees(np.array(at))
    np.testing.assert_allclose(back, np.asarray(layout.poses)[:, :2], rtol=0, atol=1e-3)
    again = tmp_path / "again.geojson"
    pyogrio.raw.write(
        again, geometry, fields, meta["fields"], geometry_type="Unknown", crs="EPSG:4326",
        driver="GeoJSON", COORDINATE_PRECISION=9,
    )  # fmt: skip
    with pytest.raises(InspeError, match="my-camera"):  # whose figures are a member of the file
        load_layout_geojson(again, scene)
    again.write_text(again.read_text().replace("my-camera", "paper-camera"))
    found = load_layout_geojson(again, scene)
    assert found.profile == layout.profile
    assert np.abs(np.asarray(found.poses) - np.asarray(layout.poses))[:, :3].max() < 2e-3


def test_kml_is_valid_and_says_the_same(scene, layout, tmp_path):
    """By OGC's schema of KML 2.2, and by GDAL."""
    pytest.importorskip("lxml", reason="needs lxml: extra [geo]")
    fastkml = pytest.importorskip("fastkml", reason="needs fastkml: extra [geo]")
    from fastkml.validator import validate

    path = tmp_path / "plan.kml"
    path.write_text(plan_kml(layout, scene.intersection))
    assert validate(file_to_validate=path)
    (document,) = fastkml.KML.parse(path).features
    folders = {folder.name: folder.features for folder in document.features}
    assert [len(folders[k]) for k in ("units", "sensors", "views")] == [
        len(layout.units), len(layout), len(layout),
    ]  # fmt: skip
    poses, georeference = np.asarray(layout.poses), scene.intersection.georeference
    ground = scene.intersection.ground(poses[:, :2])
    for one, pose, level in zip(folders["sensors"], poses, ground, strict=True):
        lon, lat, height = one.geometry.coords[0]
        assert np.abs(georeference.from_degrees(np.array([[lon, lat]]))[0] - pose[:2]).max() < 1e-3
        assert height == pytest.approx(pose[2] - level, abs=0.05)
        assert one.kml_geometry.altitude_mode.value == "relativeToGround"


def test_a_bill_adds_up(layout):
    rows = list(csv.DictReader(io.StringIO(bill_of_materials(layout, PRICES))))
    count = {row["device"]: int(row["count"]) for row in rows}
    assert sum(count.values()) == len(layout)
    assert count["hesai-xt32"] == 4
    unknown, *known = rows
    assert (unknown["device"], unknown["price_usd"], unknown["total_usd"]) == ("my-camera", "", "")
    assert {row["device"]: float(row["price_usd"]) for row in known} == PRICES
    for row in known:
        total = PRICES[row["device"]] * count[row["device"]]
        assert float(row["total_usd"]) == pytest.approx(total)


def test_views_are_on_the_ground_of_their_pole(scene, layout):
    """On a hill of its own, a sensor sees as far as on level ground; in the ground, nothing."""
    place = scene.intersection
    heads = [shape(f["geometry"]).area for f in json.loads(plan_geojson(layout, place))["features"]]
    raised = replace(place, center=place.center + np.array([0.0, 0.0, 50.0]))
    again = json.loads(plan_geojson(layout, raised))["features"]
    assert [shape(f["geometry"]).area for f in again] == heads
    poses = np.array(layout.poses)
    poses[0, 2] = -1.0
    sunk = json.loads(plan_geojson(layout.with_poses(poses), place))["features"]
    kinds = [f["properties"]["feature"] for f in sunk]
    assert kinds.count("view") == len(layout) - 1


def test_names_may_be_anything(scene, layout):
    """Viewers of maps read a description as HTML, and a name as text."""
    names = ("Südost <b>1</b> & \x07\ud800 ☃", "\u202e12", *(s.name for s in layout.sensors[2:]))
    sensors = [replace(one, name=name) for one, name in zip(layout.sensors, names, strict=True)]
    units = (replace(layout.units[0], name="<img src=x onerror=alert(1)>"), *layout.units[1:])
    odd = replace(layout, sensors=tuple(sensors), units=units)
    text = plan_kml(odd, scene.intersection)
    assert "Südost &lt;b&gt;1&lt;/b&gt; &amp; \\x07\\ud800 ☃" in text
    assert "unit: &amp;lt;img src=x onerror=alert(1)&amp;gt;&lt;br/&gt;device" in text
    assert "<name>\\u202e12</name>" in text
    assert "\u202e" not in text


# ── Bad files ───────────────────────────────────────────────────────────────


def set_at(*path, to):
    def change(content):
        here = content
        for key in path[:-1]:
            here = here[key]
        here[path[-1]] = to

    return change


@pytest.mark.parametrize(("change", "words"), [
    (lambda c: [1], "must hold keys"),
    (lambda c: {"type": "Feature"}, "type"),
    (set_at("features", to=[]), "no unit: a layout is features whose property"),
    (set_at("features", 1, "properties", "unit", to="nowhere"), "no unit 'nowhere'"),
    (set_at("features", 1, "properties", "device", to="no-such"), "device"),
    (set_at("features", 1, "geometry", "coordinates", to=["a", "b"]), "no geometry"),
    (set_at("features", 0, "geometry", "coordinates", to=[691600.0, 5334700.0]),
     "is no longitude and latitude; write the file in WGS 84"),
    (set_at("crs", to={"type": "name", "properties": {"name": "EPSG:1"}}),
     "crs: 'EPSG:1' is no coordinate system"),
    (set_at("features", 0, "geometry", to={"type": "LineString",
                                           "coordinates": [[11, 48], [11.1, 48]]}),
     "a unit is a Point"),
    (set_at("features", 1, "geometry", "coordinates", to=[11.6, 48.14]), "at most 2 m"),
    (set_at("features", 1, "geometry", to=None), "features[1].geometry: no geometry"),
    (set_at("features", 0, "geometry", "coordinates", to=[]), "has no coordinates"),
    (set_at("features", 1, "geometry", "coordinates", to=[int("9" * 400), 1]), "400 digits"),
    (set_at("features", 1, "properties", "azimuth_deg", to=1e300), "azimuth_deg"),
])  # fmt: skip
def test_a_wrong_file_says_what_is_wrong(scene, layout, tmp_path, change, words):
    """The plan is changed in place before it is read."""
    content = json.loads(plan_geojson(layout, scene.intersection))
    content = change(content) or content
    path = tmp_path / "plan.geojson"
    path.write_text(json.dumps(content))
    with pytest.raises(InspeError) as error:
        load_layout_geojson(path, scene)
    assert str(error.value).startswith(str(path))
    assert words in str(error.value)


def test_a_place_without_coordinates_says_so(layout, scene):
    bare = replace(scene.intersection, georeference=None)
    for write in (plan_geojson, plan_kml):
        with pytest.raises(InspeError, match="has no coordinates on the Earth"):
            write(layout, bare)
