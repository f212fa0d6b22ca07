"""Places of own regions: arms, routes and poles worked out by hand, GeoJSON, and bad files."""

import numpy as np
import pytest
import shapely
from shapely.geometry import box
from worlds import write_geojson

from inspe_jax import InspeError, build_scene, evaluate, strategy
from inspe_jax.scene.georeference import about
from inspe_jax.scene.maps.own_regions import intersection_of
from inspe_jax.scene.maps.registry import list_junctions, read_map
from inspe_jax.scene.regions import Region

ROADS = shapely.union_all([box(-60, -6, 60, 6), box(-6, -60, 6, 0)])  # a T with its leg south
REGIONS = {
    "junction": box(-6, -6, 6, 6),
    "driveway": ROADS,
    "crosswalk": box(-12, -6, -8, 6),
    "sidewalk": box(-60, 6, 60, 9),
}
ALONG = ([(-70, -3), (70, -3)], "vehicle", 4.0)
TURN = ([(3, -40), (3, -3), (40, -3)], "vehicle")
BOW = shapely.Polygon([(0, 0), (5, 5), (5, 0), (0, 8)])
ON_FOOT = ([(-30, 7), (30, 7)], "pedestrian")


def test_arms_and_routes_by_hand():
    place = intersection_of(REGIONS, [ALONG, TURN, ON_FOOT], [(7, 8), (300, 0)], radius=40)
    assert np.allclose(place.center, 0)
    assert np.allclose([arm.mouth for arm in place.arms], [(6, 0), (-6, 0), (0, -6)], atol=0.5)
    turns = np.degrees([arm.bearing for arm in place.arms]) % 360
    assert turns == pytest.approx([0, 180, 270], abs=3)
    assert [arm.width for arm in place.arms] == pytest.approx([12] * 3, abs=0.1)
    along, turn, *walks = place.routes
    assert (along.through, along.width) == ((1, 0), 4.0)
    assert (turn.through, turn.width) == ((2, 0), 3.5)
    assert along.waypoints[[0, -1], 0] == pytest.approx([-39.9, 39.9], abs=0.1)
    assert [walk.user for walk in walks] == ["pedestrian"] * 2
    assert walks[0].waypoints[0] == pytest.approx(walks[1].waypoints[-1])
    assert place.poles.tolist() == [[7, 8, 0]]
    assert place.mounting.covers(shapely.Point(0, 8))
    assert not place.regions[Region.DRIVEWAY].intersects(box(-5, -5, 5, 5))


def test_arms_lead_away_from_their_own_junction_and_what_is_far_is_named():
    far = ([(900, 0), (950, 0)], "vehicle")
    two = dict(junction=box(-6, -6, 6, 6) | box(24, -6, 36, 6), driveway=box(-60, -6, 60, 6))
    place = intersection_of(two, [ALONG, far], center=(0, 0))
    turns = np.degrees([arm.bearing for arm in place.arms]).round() % 360
    at = [round(arm.mouth[0]) for arm in place.arms]
    assert dict(zip(at, turns, strict=True)) == {6: 0, 24: 180, 36: 0, -6: 180}
    assert place.notes[-1] == "routes that do not come within 50 m: 2"
    wide = intersection_of(REGIONS, [(*ON_FOOT, 3.0)])
    assert [route.width for route in wide.routes] == [3.0, 3.0]


def test_people_cross_where_nothing_else_is_said():
    place = intersection_of(REGIONS, [ALONG])
    (walk, _) = (route for route in place.routes if route.user == "pedestrian")
    assert np.ptp(walk.waypoints[:, 1]) == pytest.approx(18)  # the crosswalk, and beyond
    assert np.ptp(walk.waypoints[:, 0]) < 0.1


def write(path, *features):
    return write_geojson(path, features, about(48.2, 11.6).to_degrees)


def test_a_file_is_a_map(tmp_path):
    pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")
    shapes = [(shape, dict(region=name)) for name, shape in REGIONS.items()]
    line = shapely.LineString(ALONG[0])
    path = write(
        tmp_path / "corner.geojson",
        *shapes,
        (line, dict(route="vehicle", width_m=4.0)),
        (shapely.Point(7, 8), dict(kind="pole")),
    )
    (one,) = list_junctions(path)
    assert (one.id, one.arms, one.crosswalks) == (1, 3, 1)
    assert one.size == pytest.approx(12, abs=0.01)
    place = read_map(path, junction=1, radius=40)
    assert len(place.arms) == 3
    made = intersection_of(REGIONS, [ALONG], [(7, 8)], radius=40)
    at = place.center[:2]
    for region, shape in made.regions.items():
        moved = shapely.transform(shape, lambda xy: xy + at)
        apart = place.regions[region].symmetric_difference(moved).area
        assert apart < 0.01 * max(shape.area, 1.0)
    assert place.poles[0, :2] - at == pytest.approx([7, 8], abs=0.01)
    assert place.georeference.to_degrees(at[None])[0] == pytest.approx([11.6, 48.2], abs=1e-6)
    scene = build_scene(place, radius=40, voxel=1.0, frames=2, density=10)
    assert scene.traffic.mean_count > 3
    assert evaluate(scene, strategy(scene, "Cam-d1")).surrogate > 0.2


@pytest.mark.parametrize(
    ("regions", "routes", "message"),
    [
        ({"driveway": ROADS}, [], "has no region 'junction'"),
        ({"junktion": ROADS}, [], "region 'junktion': one of driveway, junction"),
        ({"junction": box(-6, -6, 6, 6)}, [], "no driveway meets the junction within 50 m"),
        (REGIONS, [([(0, 0)], "vehicle")], "route 1: needs two or more points x, y"),
        (REGIONS, [ALONG, ([(0, 0), (1, 0)], "tram")], "route 2, user 'tram': one of vehicle, ped"),
        (REGIONS, [(*ALONG[:2], -1.0)], "route 1: needs finite points, and a width up to 50 m"),
        (dict(junction=None), [], "region 'junction': needs a polygon of shapely with an area"),
        (REGIONS | dict(sidewalk=BOW), [], "Self-intersection.*: draw it without crossings"),
    ],
)
def test_bad_regions(regions, routes, message):
    with pytest.raises(InspeError, match=message):
        intersection_of(regions, routes)


def test_bad_files(tmp_path):
    pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")
    junction = (REGIONS["junction"], dict(region="junction"))
    for features, message in (
        ([(shapely.Point(0, 0), {})], "no feature has a property 'region'"),
        ([(ROADS, dict(region="street"))], "region 'street': one of driveway, junction"),
        ([junction, (shapely.Point(0, 0), dict(region="sidewalk"))], "points neither: this Point"),
        ([junction, (shapely.Point(0, 0), dict(feature="unit"))], "is a layout: inspe score SCENE"),
        ([junction, (ROADS, {})], r"features\[1\]: polygons have a 'region', lines a 'route'"),
        ([junction, (ROADS, dict(region="driveway", width_m=-1))], "width_m"),
    ):
        with pytest.raises(InspeError, match=message):
            list_junctions(write(tmp_path / "a.geojson", *features))
    path = write(tmp_path / "a.geojson", junction, (ROADS, dict(region="driveway")))
    with pytest.raises(InspeError, match="no junction '2'; there are: 1"):
        read_map(path, junction=2)
