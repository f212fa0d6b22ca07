"""Heights of the ground from elevation models, against planes that they were made of."""

from dataclasses import replace

import numpy as np
import pytest
import rasters
from worlds import crossing

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.intersection import Route
from inspe_jax.scene.maps import elevation
from inspe_jax.scene.maps.elevation import with_elevation
from inspe_jax.scene.terrain import between, terrain_of
from inspe_jax.scene.traffic.frames import Snapshot, standing_on

rasterio = rasters.rasterio()


@pytest.fixture(autouse=True)
def own_projections():
    rasters.rasterio()


CENTER = (120.0, -80.0, 0.0)
SHIFT = (-690_000.0, -5_335_000.0)
"""World coordinates are so much larger than those of UTM zone 32."""
UTM, RADIUS = "EPSG:32632", 20.0


def place():
    """The test crossing near Munich, with a pole and a route."""
    line = np.column_stack([np.linspace(-30, 30, 13), *np.zeros((2, 13))]) + CENTER
    poles, routes = np.array([[9.0, 9.0, 0.0]]) + CENTER, (Route(line, 3.0),)
    own = dict(poles=poles, routes=routes, georeference=Georeference(UTM, SHIFT))
    return replace(crossing(center=CENTER), **own)


def plane(x, y):
    """Heights [m] at world coordinates: a slope of 5 % and −2 % on 520 m."""
    return 520.0 + 0.05 * (x - CENTER[0]) - 0.02 * (y - CENTER[1])


def raster(path, heights, left=0.0, top=0.0, cell=1.0, **profile):
    """A raster of heights (…, N, M), whose first cell has its corner at (left, top)."""
    heights = np.atleast_3d(heights.T).T
    profile = dict(crs=UTM, transform=rasterio.Affine(cell, 0, left, 0, -cell, top)) | profile
    size = dict(count=len(heights), height=heights.shape[1], width=heights.shape[2])
    with rasterio.open(path, "w", dtype=heights.dtype, **size, **profile) as file:
        file.write(heights)
    return path


def model(path, cell=2.0, reach=60.0, at=CENTER, holes=None, **profile):
    """A GeoTIFF or an ASCII grid of the plane in the place's projection."""
    left, top = at[0] - SHIFT[0] - reach, at[1] - SHIFT[1] + reach
    steps = (np.arange(int(2 * reach / cell)) + 0.5) * cell
    heights = plane(*np.meshgrid(left + SHIFT[0] + steps, top + SHIFT[1] - steps))
    if holes is not None:
        heights[holes] = -9999
    profile = dict(nodata=-9999) | profile
    return raster(path, heights.astype(np.float32), left, top, cell, **profile)


def test_heights_are_the_models(tmp_path):
    """To 2 mm, that of single precision at 520 m, on routes, poles, the centre and all columns."""
    found = with_elevation(place(), model(tmp_path / "dem.tif"), RADIUS)
    for points in (found.routes[0].waypoints, found.poles, found.center[None]):
        near = np.hypot(*(points[:, :2] - CENTER[:2]).T) < 30
        assert points[near, 2] == pytest.approx(plane(*points[near, :2].T), abs=2e-3)
    scene = inspe_jax.build_scene(found, radius=RADIUS, voxel=1.0, frames=2, terrain="ground")
    columns = scene.voxels.columns
    assert scene.voxels.ground == pytest.approx(plane(*columns.T), abs=2e-3)
    assert scene.terrain.steepest == pytest.approx(np.hypot(0.05, 0.02), rel=0.02)
    users = scene.traffic.center[scene.traffic.valid]
    foot = users[:, 2] - scene.traffic.size[scene.traffic.valid][:, 2] / 2
    assert foot == pytest.approx(plane(*users[:, :2].T), abs=0.05)
    assert "dem.tif" in found.notes[-1]


def test_a_model_in_degrees_agrees(tmp_path):
    """A model in longitudes and latitudes gives the same heights to 1 cm."""
    own, cell, size = place(), 1e-5, 240
    lon, lat = own.georeference.to_degrees(own.center[None, :2])[0]
    left, top = lon - size / 2 * cell, lat + size / 2 * cell
    at = (np.arange(size) + 0.5) * cell
    degrees = np.stack(np.meshgrid(left + at, top - at), -1).reshape(-1, 2)
    heights = plane(*own.georeference.from_degrees(degrees).T).reshape(size, size)
    path = raster(tmp_path / "wgs84.tif", heights, left, top, cell, crs="EPSG:4326")
    found = with_elevation(own, path, RADIUS)
    x, y, z = terrain_of(found, RADIUS).points.T
    near = np.hypot(x - CENTER[0], y - CENTER[1]) < RADIUS
    assert z[near] == pytest.approx(plane(x, y)[near], abs=0.01)


def test_a_grid_without_projection_is_in_that_of_the_place(tmp_path):
    path = model(tmp_path / "dem.asc", crs=None, driver="AAIGrid")
    (tmp_path / "dem.prj").unlink(missing_ok=True)
    # World coordinates of a place without a projection are those of the file.
    local = dict(georeference=None, center=place().center - [*SHIFT, 0], routes=())
    for own in (place(), replace(place(), **local, poles=np.zeros((0, 3)))):
        assert with_elevation(own, path, RADIUS).center[2] == pytest.approx(520.0, abs=2e-3)


@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_what_is_wrong_is_said(tmp_path, monkeypatch):
    def file(name, **options):
        return model(tmp_path / f"{name}.tif", **options)

    own, holes = place(), np.s_[28:32, 28:32]
    local, nowhere = replace(own, georeference=None), dict(crs=None, transform=None)
    with rasterio.open(file("feet"), "r+") as feet:
        feet.units = ["ft"]
    (tmp_path / "text.tif").write_text("no picture")
    photo = raster(tmp_path / "photo.tif", np.zeros((3, 9, 9), np.uint8), top=9.0)
    plain = raster(tmp_path / "plain.tif", np.zeros((300, 300), np.float32), **nowhere)
    for at, path, words in (
        (own, file("far", at=(9_000.0, 0.0, 0.0)), "of another region"),
        (own, file("small", reach=12.0), r"for \d+% of the ground within 20 m"),
        (own, file("holes", holes=holes), "has heights for 9"),
        (own, file("void", holes=holes, nodata=None), "if some stand for no data"),
        (own, photo, "has 3 bands, as a"),
        (own, tmp_path / "feet.tif", "heights in ft, not in metres"),
        (local, file("dem"), "does not say where on the"),
        (local, plain, "it has no geotransform"),
        (own, tmp_path / "text.tif", "not an elevation model"),
        (own, tmp_path / "missing.tif", r"missing\.tif"),
    ):
        with pytest.raises(InspeError, match=words):
            with_elevation(at, path, RADIUS)
    monkeypatch.setattr(elevation, "MOST", 50)
    with pytest.raises(InspeError, match="resample it"):
        with_elevation(own, file("fine", cell=1.0), RADIUS)


def test_no_other_file_and_no_address_is_read(tmp_path):
    """GDAL's virtual rasters name other files and addresses; under any name they are refused."""
    model(tmp_path / "dem.tif")
    virtual = (
        '<VRTDataset rasterXSize="60" rasterYSize="60"><VRTRasterBand dataType="Float32" band="1">'
        f"<SimpleSource><SourceFilename>{tmp_path / 'dem.tif'}</SourceFilename>"
        "<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    for name, why in (("other.vrt", "an elevation model is"), ("other.tif", "not an elevation")):
        (tmp_path / name).write_text(virtual)
        with pytest.raises(InspeError, match=why):
            with_elevation(place(), tmp_path / name, RADIUS)


def test_beyond_the_radius_the_nearest_height_goes_on(tmp_path):
    found = with_elevation(place(), model(tmp_path / "dem.tif", reach=24.0), RADIUS)
    edge = terrain_of(found, RADIUS).height(np.array([[CENTER[0] + 34.0, CENTER[1]]]))
    assert edge == pytest.approx(plane(CENTER[0] + 23.0, CENTER[1]), abs=0.11)


def test_there_is_no_step_at_the_rim_of_what_is_known():
    """Points on one side of a place: beyond them the surface goes on as their rim is."""
    corners = np.array([[-40.0, -40.0], [60.0, -30.0], [-30.0, 50.0], [5.0, -2.0]])
    known = np.column_stack([corners, 0.07 * corners[:, 0]])
    side = np.arange(-60.0, 61.0)
    at = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    heights = between(known, at).reshape(len(side), len(side))
    steps = [np.abs(np.diff(heights, axis=axis)).max() for axis in (0, 1)]
    assert max(steps) < 0.15
    assert between(known[:2], at).min() == pytest.approx(known[:2, 2].min())


def test_traffic_of_a_map_stays_on_other_ground():
    """Who is on which level is a matter of the map's own heights."""
    line = np.array([[CENTER[0], CENTER[1]]])
    raised = place().standing_on(place().ground_points + [0.0, 0.0, 520.0])
    assert raised.ground(line) == pytest.approx([520.0])
    assert raised.level(line) == pytest.approx([0.0])
    again = raised.standing_on(raised.ground_points + [0.0, 0.0, 5.0])
    assert again.level(line) == pytest.approx([0.0])
    at = np.tile([*CENTER[:2], 0.0], (3, 1))
    users = Snapshot(at, np.zeros(3), np.ones((3, 3)), *np.zeros((2, 3), int), np.zeros((3, 3)))
    found = standing_on(again, 10.0, users, np.array([0.2, 6.0, np.nan]))
    assert found.center[:, 2] == pytest.approx([525.5, 525.5])  # the second is on a deck
