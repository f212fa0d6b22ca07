"""Bodies of one's own from GeoJSON and CSV."""

import json
from dataclasses import replace
from itertools import zip_longest

import numpy as np
import pytest
import shapely
from worlds import write_geojson

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.site import Site
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.maps.bodies import Ways
from inspe_jax.scene.maps.own_bodies import with_own_bodies
from inspe_jax.scene.scene import build_scene

pyproj = pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")

REACH = 40.0


@pytest.fixture(scope="module")
def place():
    georeference = Georeference("EPSG:25832", (-691600.0, -5334700.0))
    built = inspe_jax.built_in("t_junction")
    return replace(built, georeference=georeference, poles=np.zeros((0, 3)), bodies=())


@pytest.fixture(scope="module")
def spots(place):
    """Points within reach where nobody goes, 4 m and more apart."""
    free = shapely.Point(place.center[:2]).buffer(30).difference(Ways.of(place).paths.buffer(1.0))
    grid = np.stack(np.meshgrid(*[np.arange(-30, 31, 4.0)] * 2), -1).reshape(-1, 2)
    return grid[shapely.contains_xy(free, *grid.T)][:6]


def write(path, place, geometries, properties=(), crs=None):
    """A GeoJSON file of geometries in world metres."""

    def to_file(points):
        degrees = place.georeference.to_degrees(points)
        if crs is None:
            return degrees
        there = pyproj.Transformer.from_crs(4326, crs, always_xy=True)
        return np.column_stack(there.transform(*degrees.T))

    named = {"type": "name", "properties": {"name": f"urn:ogc:def:crs:EPSG::{crs}"}}
    features = zip_longest(geometries, properties, fillvalue={})
    return write_geojson(path, features, to_file, **({} if crs is None else {"crs": named}))


@pytest.mark.parametrize("crs", [None, 31468])
def test_poles_carry_sensors(place, spots, tmp_path, crs):
    wanted = spots[[0, 1]]
    points = shapely.points([*wanted, wanted[0] + 0.02, wanted[0] + [900.0, 0.0]])
    path = write(tmp_path / "poles.geojson", place, points, crs=crs)
    found = with_own_bodies(place, path, REACH)
    # The datum of Gauß-Krüger is converted with parameters for all of Germany: 3 m.
    near = 3.0 if crs == 31468 else 1e-3
    assert len(found.poles) == 2
    assert np.abs(found.poles[:, :2] - wanted).max() < near
    assert np.allclose(found.poles[:, 2], place.ground(found.poles[:, :2]))
    assert [one.kind for one in found.bodies] == ["pole", "pole"]
    assert {one.height for one in found.bodies} == {6.0}
    assert any("1 of 4 features are farther than 40 m: left out" in n for n in found.notes)
    far = "poles.geojson: pole features[3]: left out: "
    assert [n.startswith(far) and "farther than 40 m" in n for n in found.notes].count(True) == 1


def test_poles_that_carry_nothing_are_named_with_why(place, spots, tmp_path):
    way = next(of for of in place.routes if of.user == "vehicle").waypoints[:, :2]
    lane = way[np.hypot(*way.T).argmin()]
    rows = [dict(name="A 7"), dict(height_m=2.0), {}, dict(height_m=8.0)]
    beside = spots[3] + 0.6  # nearer than brackets reach
    points = shapely.points([lane, spots[0], spots[3], beside])
    path = write(tmp_path / "poles.geojson", place, points, rows)
    found = with_own_bodies(place, path, REACH)
    assert "poles.geojson: pole A 7: left out: on lanes, crossings or footpaths" in found.notes
    far = replace(found, poles=np.vstack([found.poles, [[28.0, 28.0, 0.0]]]))
    scene = build_scene(far, radius=30, voxel=1.0, frames=2, density="none", statics="map")
    site = Site(scene.intersection, 30.0, depth=30.0, bodies=scene.statics)
    for at, why in (
        (spots[0], "2 m high, lower than the lowest sensor, 3 m"),
        (spots[3], "too thick for brackets, or too near to another pole"),
        (beside, "in or beside a pole"),
        (np.array([28.0, 28.0]), "40 m from the centre, beyond the radius of 30 m"),
        (lane, "on a driving lane"),
    ):
        assert site.why_none(at) == why
    assert not len(site.poles)
    assert len(scene.poles) == 3  # within the radius


def test_what_has_no_geometry_is_left_out_and_a_street_lamp_is_a_pole(place, spots, tmp_path):
    rows = [dict(kind="street_lamp", height_m=8.0), dict(kind="pole")]
    path = write(tmp_path / "poles.geojson", place, shapely.points(spots[:2]), rows)
    content = json.loads(path.read_text())
    content["features"][1]["geometry"] = None
    path.write_text(json.dumps(content))
    found = with_own_bodies(place, path, REACH)
    assert [(one.kind, one.height) for one in found.bodies] == [("pole", 8.0)]
    assert "poles.geojson: features without a geometry: 1: left out" in found.notes


def test_a_pole_of_one_s_own_takes_the_place_of_the_map_s(place, spots, tmp_path):
    """Else each would be in the way of the other, and neither carry anything."""
    first = write(tmp_path / "map.geojson", place, shapely.points(spots[:2]))
    given = with_own_bodies(place, first, REACH)
    near = [shapely.Point(spots[0] + 0.05)]
    own = write(tmp_path / "own.geojson", place, near, [dict(height_m=8.0)])
    found = with_own_bodies(given, own, REACH)
    assert sorted(one.height for one in found.bodies) == [6.0, 8.0]
    assert len(found.poles) == 2
    assert len(Site(found, 40.0, 30.0, bodies=found.bodies).carriers) == 2


def test_every_kind_has_its_size(place, spots, tmp_path):
    a, b, c, d, e, f = spots
    nothing = dict(kind=None, height_m=None, base_m=None, width_m=None)  # as if it were not there
    rows = [
        (shapely.box(*a, *(a + 1.5)), dict(height_m=9.0, base_m=3.0, owner="the city")),
        (shapely.LineString([b, b + [1.0, 0.0]]), dict(kind="hedge", width_m=0.8)),
        (shapely.Point(c), dict(kind="tree", diameter_m=1.6, height_m=5.0)),
        (shapely.Point(d), dict(height_m=8.0, diameter_m=0.3)),
        (shapely.MultiPoint([e, f]), nothing),
    ]
    path = write(tmp_path / "own.geojson", place, *zip(*rows, strict=True))
    found = with_own_bodies(place, path, REACH)
    house, hedge, tree, lamp, *others = found.bodies
    assert (house.kind, house.base, house.height) == ("building", 3.0, 9.0)
    assert house.polygon.area == pytest.approx(2.25, rel=1e-3)
    assert (hedge.kind, hedge.height) == ("hedge", 1.5)
    assert hedge.polygon.area == pytest.approx(0.8, rel=1e-3)
    assert (tree.kind, tree.height, tree.transmittance) == ("tree", 5.0, 0.05)
    assert tree.polygon.area == pytest.approx(np.pi * 0.8**2, rel=1e-3)
    assert 0 < tree.trunk <= 0.4 < tree.base < 5
    assert lamp.polygon.area == pytest.approx(np.pi * 0.15**2, rel=1e-3)
    assert [(one.kind, one.height) for one in others] == [("pole", 6.0)] * 2
    assert len(found.poles) == 3
    scene = build_scene(found, radius=25, voxel=2.0, frames=1, density=2, statics="map")
    assert "building" in {one.kind for one in scene.statics}


def test_a_table_of_poles(place, spots, tmp_path):
    (lon, lat), (east, north) = place.georeference.to_degrees(spots[:2]).tolist()
    path = tmp_path / "poles.csv"
    path.write_text(
        f"name,latitude,longitude,height_m\nlamp,{lat!r},{lon!r},8\ntree,{north!r},{east!r},\n"
    )
    found = with_own_bodies(place, path, REACH)
    assert np.abs(found.poles[:, :2] - spots[:2]).max() < 1e-3
    assert [one.height for one in found.bodies] == [8.0, 6.0]


@pytest.mark.parametrize(("properties", "words"), [
    (dict(kind="house"), r"features\[0\]: kind 'house': one of building, wall"),
    (dict(height_m=-1), "height_m: input should be greater than 0"),
    (dict(height_m="high"), "height_m: input should be a valid number"),
    (dict(base_m=9), r"base_m 9 m must be below height_m 6 m"),
    (dict(transmittance=2), "transmittance"),
    ({}, r"nothing within 40 m of .* the nearest is [89],\d\d\d m away"),
])  # fmt: skip
def test_a_wrong_property_says_what_is_wrong(place, spots, tmp_path, properties, words):
    at = spots[0] if properties else spots[0] + [0.0, 9000.0]
    path = write(tmp_path / "own.geojson", place, [shapely.Point(at)], [properties])
    with pytest.raises(InspeError, match=words):
        with_own_bodies(place, path, REACH)


@pytest.mark.parametrize(("name", "text", "words"), [
    ("a.geojson", '{"type": "FeatureCollection", "features": []}', "has no features"),
    ("a.geojson", "{", "not JSON"),
    ("a.geojson", "[" * 100_000, "not JSON"),
    ("a.csv", "lat,lon\n1,2\n", "each of 'latitude' and 'longitude'; columns are lat, lon"),
    ("a.csv", "latitude,longitude\n48,\n", "row 1: needs a number"),
    ("a.csv", "", "it is empty"),
])  # fmt: skip
def test_a_file_of_another_kind_says_so(place, tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    with pytest.raises(InspeError, match=words):
        with_own_bodies(place, tmp_path / name, REACH)
