"""What stations tell of their sensors, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import CAMERA, LIDAR, place_sensors, world

from inspe_jax.core.errors import InspeError
from inspe_jax.report.perception_regions import perception_regions
from inspe_jax.scene.georeference import Georeference


def test_regions_are_clockwise_from_true_north_and_in_tenths():
    pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")
    place = world(count=0).intersection
    layout = place_sensors(
        (CAMERA, [1.0, 2.0, 5.0, 0.0, -0.2, np.pi / 2]), (LIDAR, [9.0, 0.0, 5.0, 0.0, 0.0, 1.0])
    )
    with pytest.raises(InspeError, match="no coordinates"):
        perception_regions(layout, place)
    there = replace(place, georeference=Georeference("+proj=tmerc +lat_0=48 +lon_0=11"))
    camera, lidar = perception_regions(layout, there)
    assert camera["referencePosition"]["latitude"] == pytest.approx(48e7, abs=300)
    (one,), (other,) = camera["sensorInformation"], lidar["sensorInformation"]
    assert (one["sensorType"], other["sensorType"]) == (3, 2)
    cone, half = one["perceptionRegionShape"]["radial"], np.degrees(CAMERA.field_of_view) / 2
    assert cone["range"] == round(10 * CAMERA.depth)
    assert cone["shapeReferencePoint"] == dict(xCoordinate=0, yCoordinate=0, zCoordinate=500)
    assert cone["stationaryHorizontalOpeningAngleStart"] == pytest.approx(
        3600 - 10 * half[0], abs=1
    )
    assert cone["stationaryHorizontalOpeningAngleEnd"] == pytest.approx(10 * half[0], abs=1)
    pitch = 3600 - 10 * np.degrees(0.2)
    assert cone["verticalOpeningAngleStart"] == pytest.approx(pitch - 10 * half[1], abs=1)
    assert cone["verticalOpeningAngleEnd"] == pytest.approx((pitch + 10 * half[1]) % 3600, abs=1)
    assert other["perceptionRegionShape"]["circular"]["radius"] == 10 * LIDAR.reach
