"""From a map and a latitude to a plan in coordinates, on the command line, and back."""

from dataclasses import replace

import numpy as np
import pytest
import rasters
from osm_town import LAT, LON, full_town
from processes import cases, refused
from shapely import Point
from worlds import write_geojson

from inspe_jax import save_scene
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.scene import load_scene

pytest.importorskip("sumolib", reason="needs SUMO: extra [sumo]")
pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")

SMALL = ("--radius", 25, "--voxel", 1, "--frames", 2, "--density", 5)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    full_town().write(folder / "city.osm")
    lamp = Point(LON + 1.5e-4, LAT + 1.0e-4), {"height_m": 7.0}
    write_geojson(folder / "poles.geojson", [lamp], lambda degrees: degrees)
    return folder


def test_a_scene_by_coordinates_and_a_plan_to_hand_on(inspe, run, scored, files):
    table = run("scene", "city.osm", "--list")
    assert "latitude, longitude" in table
    assert f"{LAT:.4f}"[:-1] in table
    here = f"{LAT + 2e-5},{LON - 2e-5}"
    status, table, error = inspe(
        "scene", "city.osm", "--at", here, "--bodies", "poles.geojson", "--statics", "map",
        *SMALL, "--out", "city.npz",
    )  # fmt: skip
    assert status == 0, error
    assert "latitude, longitude" in table
    assert error.count(") carries no sensor: in or beside a building") == 1
    place = load_scene(files / "city.npz").intersection
    assert any(one.height == 7.0 and one.kind == "pole" for one in place.bodies)
    paths = ("plan.geojson", "plan.kml", "bill.csv", "calibration.json")
    text = run("export", "city.npz", "Cam-d1/L-d1", *(x for file in paths for x in ("--out", file)))
    assert text.count("wrote") == 4
    status, _, error = inspe(
        "layout", "city.npz", "--from", "calibration.json", "--out", "hung.yaml"
    )
    assert (status, error) == (0, "")
    first, *again = (
        scored("city.npz", layout) for layout in ("Cam-d1/L-d1", "plan.geojson", "hung.yaml")
    )
    for metric in ("coverage", "occlusion", "information_gain", "surrogate"):
        for other in again:
            assert other[metric] == pytest.approx(first[metric], abs=1e-4)
    (files / "plan.kml").write_text("mine")
    error = run("export", "city.npz", "L-d1", "--out", "plan.kml", fails=True)
    assert "plan.kml: is there already, and was changed since `inspe export` wrote it" in error
    run("export", "city.npz", "L-d1", "--out", "plan.kml", "--force")


def test_a_plan_in_the_sea_is_doubted(inspe, files, scene):
    """As of CARLA's own towns, whose projection begins at 0° N 0° E."""
    nowhere = Georeference("+proj=tmerc +lat_0=0 +lon_0=0 +datum=WGS84")
    place = replace(scene.intersection, georeference=nowhere)
    save_scene(replace(scene, intersection=place), files / "sea.npz")
    status, text, error = inspe("export", "sea.npz", "Cam-d1", "--out", "sea.kml")
    assert (status, text) == (0, "wrote sea.kml\n")
    assert "Note: coordinates are in the sea, at 0.000000, 0.000000" in error


@pytest.mark.parametrize(("arguments", "message"), cases(
    (("scene", "city.osm", "--at", "48.1"), "--at 48.1: write LAT,LON, such as 48.137,11.575"),
    (("scene", "city.osm", "--at", "10,10"), "no junction within 100 m of 10,10; the middle of"),
    (("scene", "city.osm", "--at", "48,11", "--junction", "1"), "choose a place on the map"),
    (("export", "four_way", "Cam-d1", "--force"), "four_way: has no coordinates on the Earth"),
    (("export", "four_way", "Cam-d1", "--out", "plan.shp"), "in .geojson or .kml or .json or .csv"),
    (("export", "four_way", "Cam-d1", "--out", "b.csv", "--price", "x"), "--price x: write"),
))  # fmt: skip
def test_bad_input_is_one_message(inspe, files, arguments, message):
    refused(inspe, files, arguments, message)


def test_a_scene_on_an_elevation_model(run, files):
    """The place stands on it; what is read of it: tests/scene/test_elevation.py."""
    rasterio = rasters.rasterio()
    cell, size = 1e-5, 600
    heights = np.tile(500.0 + 0.04 * np.arange(size), (size, 1)).astype(np.float32)
    transform = rasterio.Affine(cell, 0, LON - 300 * cell, 0, -cell, LAT + 300 * cell)
    kind = dict(driver="GTiff", count=1, dtype="float32", crs="EPSG:4326")
    with rasterio.open(
        files / "dem.tif", "w", width=size, height=size, transform=transform, **kind
    ) as file:
        file.write(heights, 1)
    place = ("--at", f"{LAT + 2e-5},{LON - 2e-5}", "--elevation", "dem.tif")
    table = run("scene", "city.osm", *place, "--terrain", "ground", *SMALL, "--out", "hill.npz")
    assert "heights of the ground from dem.tif" in table
    assert "slopes up to" in table
    scene = load_scene(files / "hill.npz")
    assert scene.terrain is not None
    assert scene.intersection.center[2] == pytest.approx(512.0, abs=1.0)
