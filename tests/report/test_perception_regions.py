"""What stations tell of their sensors, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import CAMERA, LIDAR, place_sensors, world

from inspe_jax import CameraSpec, LidarSpec
from inspe_jax.core.errors import InspeError
from inspe_jax.report.perception_regions import perception_regions
from inspe_jax.scene.georeference import Georeference

EYE = CameraSpec.from_intrinsics("eye", 1000, 1000, hfov_deg=185, fisheye=True)
ASIDE = CameraSpec.from_intrinsics("aside", 1920, 1080, fx=1200, cy=100)
SECTOR = LidarSpec("sector", tuple(np.radians([-20.0, 5.0])), 1200, np.radians(120), 50.0)
WIDE, TALL = np.degrees(CAMERA.field_of_view)


def shape(spec, pose):
    """Of a sensor 5 m above its unit's foot, where grid north is true north."""
    pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")
    place = world(count=0).intersection
    there = Georeference("+proj=tmerc +lat_0=48 +lon_0=11")
    layout = place_sensors((spec, [3.0, 4.0, 5.0, *np.radians(pose)]))
    (unit,) = perception_regions(layout, replace(place, georeference=there))
    return unit, unit["sensorInformation"][0]


@pytest.mark.parametrize(("spec", "pose", "expected"), [
    (CAMERA, (0, -10, 90), (-WIDE / 2, WIDE / 2, -10 - TALL / 2, -10 + TALL / 2)),
    (CAMERA, (0, 0, 0), (90 - WIDE / 2, 90 + WIDE / 2, -TALL / 2, TALL / 2)),
    (CAMERA, (90, 0, 90), (-TALL / 2, TALL / 2, -WIDE / 2, WIDE / 2)),
    (SECTOR, (0, 0, 90), (-60, 60, -20, 5)),
    (SECTOR, (180, 0, 90), (-60, 60, -5, 20)),
    (ASIDE, (0, 0, 90), (-38.66, 38.66, -39.23, 4.76)),
])  # fmt: skip
def test_cones_are_clockwise_from_true_north_as_the_sensor_hangs(spec, pose, expected):
    unit, sensor = shape(spec, pose)
    cone = sensor["perceptionRegionShape"]["radial"]
    assert sensor["sensorType"] == (2 if spec is SECTOR else 3)
    assert cone["range"] == round(10 * spec.grid.reach)
    assert cone["shapeReferencePoint"] == dict(xCoordinate=0, yCoordinate=0, zCoordinate=500)
    keys = [f"{of}OpeningAngle{end}" for of in ("stationaryHorizontal", "vertical")
            for end in ("Start", "End")]  # fmt: skip
    off = (np.array([cone[key] for key in keys]) - 10 * np.array(expected) + 1800) % 3600 - 1800
    wide = pose[1] != 0  # corners of a tilted picture reach further than its middle
    assert (np.abs(off[:2]) < (60 if wide else 3)).all()
    assert (np.abs(off[2:]) < (60 if wide else 3)).all()
    assert unit["referencePosition"]["latitude"] == pytest.approx(48e7, abs=400)


@pytest.mark.parametrize(("spec", "pose"), [(LIDAR, (0, 0, 30)), (EYE, (0, -90, 0))])
def test_what_looks_all_round_is_a_cylinder(spec, pose):
    region = shape(spec, pose)[1]["perceptionRegionShape"]
    assert region["circular"]["radius"] == round(10 * spec.grid.reach)


def test_a_place_without_coordinates_is_refused():
    with pytest.raises(InspeError, match="no coordinates"):
        perception_regions(place_sensors((CAMERA, [1.0] * 6)), world(count=0).intersection)
