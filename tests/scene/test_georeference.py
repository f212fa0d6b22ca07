"""Where places lie on the Earth: against PROJ, CARLA's client and published points."""

import sys

import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.georeference import Georeference, of_open_drive

pyproj = pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")

SOME = np.array([[0.0, 0.0], [30.0, -20.0], [-400.0, 900.0]])


@pytest.mark.parametrize(("code", "middle"), [
    ("EPSG:25832", (691608, 5334763)), ("EPSG:3067", (385000, 6672000)),
])  # fmt: skip
def test_degrees_are_those_of_the_projection(code, middle):
    """Against pyproj's other interface, which has no datum; both are on WGS 84 or ETRS89."""
    georeference = Georeference(code, tuple(-np.array(middle, float)))
    found = georeference.to_degrees(SOME)
    plain = np.column_stack(pyproj.Proj(code)(*(SOME + middle).T, inverse=True))
    assert np.abs(found - plain).max() < 1e-9  # 0.1 mm
    assert np.abs(georeference.from_degrees(found) - SOME).max() < 1e-4


def test_a_datum_of_its_own_is_converted():
    """The origin of the Swiss grid, the old observatory of Bern, which Bessel's ellipsoid of 1903
    has 130 m elsewhere: swisstopo, Formulas and constants for the Swiss map projection."""
    (lon, lat) = Georeference("EPSG:2056").to_degrees(np.array([[2_600_000.0, 1_200_000.0]]))[0]
    assert abs(lon - 7.438637) < 2e-5
    assert abs(lat - 46.951081) < 2e-5


@pytest.mark.parametrize("east", [-2.0, 0.0, 2.0])
def test_azimuths_are_from_true_north(east):
    """Grid north of UTM leans by arctan(tan Δλ sin φ) from it: Snyder, Map Projections, 1987."""
    georeference, lat = Georeference("EPSG:32632"), 48.0
    at = georeference.from_degrees(np.array([[9.0 + east, lat]]))
    lean = np.degrees(np.arctan(np.tan(np.radians(east)) * np.sin(np.radians(lat))))
    yaw = np.radians([90.0, 0.0, 180.0, -90.0])
    found = georeference.azimuth(np.repeat(at, 4, 0), yaw)
    off = (found - lean - [0, 90, 270, 180] + 180) % 360 - 180
    assert np.abs(off).max() < 1e-3
    back = georeference.yaw(np.repeat(at, 4, 0), found)
    assert np.abs((back - yaw + np.pi) % (2 * np.pi) - np.pi).max() < 1e-6


@pytest.mark.parametrize("wrong", ["EPSG:4326", "EPSG:1", "nonsense", "+proj=nonsense"])
def test_what_is_no_projection_is_refused(wrong):
    with pytest.raises(InspeError, match="projection"):
        Georeference(wrong).check()


def test_pyproj_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(InspeError, match=r"pip install .*\[geo\]'"):
        Georeference("EPSG:25832").to_degrees(SOME)


def test_an_open_drive_projection_is_read():
    text = "+proj=tmerc +lat_0=48 +lon_0=11 +datum=WGS84 +geoidgrids=no_such.gtx +vunits=m +no_defs"
    georeference = of_open_drive(text, (5.0, -3.0))
    assert np.abs(georeference.to_degrees(np.array([[5.0, -3.0]])) - [11, 48]).max() < 1e-9
    assert of_open_drive("  ") is None
    assert of_open_drive("EPSG:25832") == Georeference("EPSG:25832")


@pytest.mark.parametrize(("lat", "lon"), [(49.0, 8.0), (0.0, 0.0), (-33.9, 151.2)])
def test_carla_s_own_maps_lie_where_its_client_says(maps, lat, lon):
    """Their Earth is a sphere, on which degrees are up to 0.7 % longer or shorter. North is +y."""
    carla = pytest.importorskip("carla", reason="the comparison needs the CARLA client")
    given = "+lat_0=4.9000000000000000e+1 +lon_0=8.0000000000000000e+0"
    text = (maps / "Town03.xodr").read_text()
    assert given in text
    georeference = of_open_drive(f"+lat_0={lat!r} +lon_0={lon!r}")
    town = carla.Map("Town03", text.replace(given, f"+lat_0={lat!r} +lon_0={lon!r}"))
    for x, y in SOME:
        there = town.transform_to_geolocation(carla.Location(x=float(x), y=float(y), z=0.0))
        at = georeference.from_degrees(np.array([[there.longitude, there.latitude]]))[0]
        assert np.hypot(*(at - [x, y])) <= 0.007 * np.hypot(x, y) + 1e-6
