"""What a page says to who mounts the sensors: on hand-made plans with known answers."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import CAMERA, LIDAR, crossing, world

from inspe_jax import built_in
from inspe_jax.report.page import FACTS, template
from inspe_jax.report.schedule import installation_schedule, materials
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.statics import pole
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import Sensor, Unit, make_layout

ALONE = "In the scores no pole, arm or housing hides anything."


@pytest.fixture(scope="module")
def scene():
    return world(radius=12.0, voxel=2.0, count=2, frames=2, seed=1)


def rendered(name, **about):
    return " ".join(template("report", name).render(**FACTS, **about).split())


def origin_words(place):
    return rendered("origin.html.j2", place=place)


def words_of(scene, *sensors):
    """What is said of one pole at (9, 8) with sensors: (spec, offset along x, height) each."""
    poses = np.array([[9.0 + x, 8.0, z, 0.0, 0.0, 0.0] for _, x, z in sensors])
    members = [Sensor(f"s{k}", spec, 0) for k, (spec, *_) in enumerate(sensors)]
    layout = make_layout(members, [Unit("corner", (9.0, 8.0, 0.0))], poses)
    units = installation_schedule(layout, scene.intersection, {})
    return rendered("mounting.html.j2", scene=scene, units=units)


ARM, AXIS = (CAMERA, 1.5, 6.5), (LIDAR, 0.0, 6.0)


def test_what_the_plan_leaves_open(scene):
    """More is said where a sensor is on the axis of a pole."""
    for sensors, on_axis in (([ARM], False), ([ARM, AXIS], True)):
        words = words_of(scene, *sensors)
        assert words.startswith(ALONE)
        assert words.endswith("as near to it as their housings allow.")
        assert ("what the pole then hides, the scores count as seen" in words) == on_axis


def test_poles_that_stand_there(scene):
    """Those that are bodies hide something; how high others are is not known."""
    body = scene.with_statics([pole((-9.0, 9.0), radius=0.1, height=6.0)])
    assert "only poles that are bodies of the scene hide" in words_of(body, ARM)
    place = replace(scene.intersection, poles=np.array([[9.0, 8.0, 0.0]]))
    said = "How high existing poles are is not known."
    assert said in words_of(replace(scene, intersection=place), ARM)
    assert said not in words_of(scene, ARM)


def test_coordinates_are_those_of_a_built_in_place_a_map_or_a_projection():
    words = origin_words(built_in("four_way"))
    assert words.startswith("x and y are 0 in the middle of the junction, and z on its level")
    assert "four_way is made up, not surveyed: this plan is an example." in words
    words = origin_words(replace(crossing(), source="town.xodr (OpenDRIVE)"))
    assert words.startswith("x and y are the coordinates of the map town.xodr (OpenDRIVE); z is")
    assert "less its netOffset" in origin_words(replace(crossing(), source="a.net.xml (SUMO)"))
    place = replace(crossing(), georeference=Georeference("EPSG:32632", (-690_000.0, 12.5)))
    assert "the projection EPSG:32632, plus -690000.00 and 12.50;" in origin_words(place)
    assert "plus" not in origin_words(replace(place, georeference=Georeference("EPSG:32632")))
    nowhere = replace(place, georeference=Georeference("+proj=tmerc +lat_0=0 +lon_0=0"))
    assert "But coordinates are in the sea, at 0.000000, 0.000000" in origin_words(nowhere)
    assert "in the sea" not in origin_words(place)


def test_a_model_cannot_be_bought():
    """The paper's devices; not those of makers, nor those that a layout describes."""
    names = "paper-camera", "paper-lidar-32", "velodyne-vlp-16"
    specs = [*(device(name).spec for name in names), CAMERA]
    members = [Sensor(spec.name, spec, 0) for spec in specs]
    poses = np.array([[0.0, 0.0, 5.0 + k, 0.0, 0.0, 0.0] for k in range(4)])
    layout = make_layout(members, [Unit("corner", (0.0, 0.0, 0.0))], poses)
    rows = materials(layout, {})
    assert [row.product for row in rows] == [False, False, True, True]
    about = {spec.name: spec for spec in specs}
    _, words, of_lidar = rendered("models.html.j2", materials=rows, specs=about).split("<p")
    assert "paper-camera is a model and cannot be bought." in words
    assert "800 × 600 pixels, a field of view of 100° × 84° and a reach of 38 m." in words
    low, high = np.degrees(specs[1].elevations)[[0, -1]]
    assert f"32 channels at elevations from {low:.1f}° to {high:.1f}°" in of_lidar
