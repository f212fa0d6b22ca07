"""Traffic of tracks: worked out by hand, from files as data sets have them, and bad files."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import crossing

from inspe_jax import InspeError, build_scene
from inspe_jax.scene.georeference import Georeference
from inspe_jax.scene.traffic.frames import ROAD_USERS
from inspe_jax.scene.traffic.tracks import NEAR, tracks_traffic

SIZE = dict(radius=60, frames=3)
CAR, TRUCK, CYCLIST, PEDESTRIAN = range(4)
TWO = {
    "id": ["b", "b", "a", "a"],
    "time": [1.7e9, 1.7e9 + 2, 1.7e9 + 2, 1.7e9],  # in any order
    "x": [0.0, 4.0, 10.0, 10.0],
    "y": [0.0, 0.0, 3.0, -1.0],
    "yaw_deg": [170.0, -170.0, 90.0, 90.0],
    "class": ["car", "car", "Pedestrian", "Pedestrian"],
}


@pytest.fixture
def place():
    return crossing(center=(0, 0, 0))


def changed(**columns):
    return {key: value for key, value in (TWO | columns).items() if value is not None}


def write(path, columns):
    rows = [columns, *zip(*columns.values(), strict=True)]
    path.write_text("\n".join(",".join(map(str, row)) for row in rows))
    return path


def test_who_is_where_worked_out_by_hand(place):
    said: list[str] = []
    found = tracks_traffic(place, TWO, radius=60, frames=9, step=0.5, notes=said)
    assert found.time.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
    one = found.at(1)
    assert one.kind.tolist() == [PEDESTRIAN, CAR]
    usual = [ROAD_USERS[kind].size for kind in one.kind]
    assert one.size == pytest.approx(np.array(usual))
    middle = [[10, 0, usual[0][2] / 2], [1, 0, usual[1][2] / 2]]
    assert one.center == pytest.approx(np.array(middle))
    assert np.degrees(one.yaw) % 360 == pytest.approx([90, 175])  # the short way round
    assert one.velocity == pytest.approx(np.array([[0, 2, 0], [2, 0, 0]]))
    assert said == [
        "tracks: lengths, widths or heights are missing: 4 rows of the usual size of the class"
    ]


def test_directions_are_those_of_movement(place):
    """Who waits at first looks where he goes then; who stops, where he went."""
    steps = dict(x=[0, 0, 0, 0, 0], y=[0, 0, 1, 2, 2], time=[0, 1, 2, 3, 4], id=[1] * 5)
    columns = changed(**steps, yaw_deg=None) | {"class": ["person"] * 5}
    found = tracks_traffic(place, columns, radius=60, frames=5)
    assert found.velocity[:, 0, 1].tolist() == [0, 0.5, 1, 0.5, 0]
    assert found.yaw[:, 0] == pytest.approx(np.full(5, np.pi / 2))
    stands = columns | dict(y=[0] * 5)
    assert not tracks_traffic(place, stands, **SIZE).yaw.any()


def test_who_is_lost_does_not_fly(place):
    """Of a track with a gap and a jump, each end stays for a second; one at rest stays there."""
    far = changed(time=[0.0, 8.0, 8.0, 0.0], x=[0.0, 30.0, 10.0, 10.0], y=[0, 0, 3, -1])
    found = tracks_traffic(place, far, radius=60, frames=17, step=0.5)
    car = (found.kind == CAR) & found.valid
    near = found.time[car.any(1)]
    assert near.tolist() == [0, 0.5, NEAR, 8 - NEAR, 7.5, 8]
    assert set(found.center[car][:, 0].tolist()) == {0.0, 30.0}
    assert ((found.kind == PEDESTRIAN) & found.valid).any(1).all()


def test_fast_cars_are_between_the_rows_of_a_slow_recorder(place):
    columns = dict(id=[1] * 4, time=[0, 1, 2, 3], x=[-21, -7, 7, 21], y=[-3] * 4)
    columns |= {"class": ["car"] * 4}
    found = tracks_traffic(place, columns, radius=60, frames=9, step=0.5)
    assert found.center[:, 0, 0] == pytest.approx(np.arange(-21, 22, 7.0))


def test_the_names_of_other_data_sets(place, tmp_path):
    """SinD's: milliseconds and radians. V2X-Seq's: vehicles by their kind or their length."""
    sind = dict(track_id=[1, 1], timestamp_ms=[0, 1000], agent_type=["bus", "bus"], x=[0, 3])
    sind |= dict(y=[0, 0], vx=[2, 4], vy=[0, 0], yaw_rad=[1, 1], length=[12, 12], width=[2.5, 2.5])
    found = tracks_traffic(place, write(tmp_path / "a.csv", sind), radius=60, frames=9, step=0.5)
    assert found.frame_count == 3
    one = found.at(1)
    assert (one.kind.tolist(), one.yaw.tolist(), one.velocity[0, 0]) == ([TRUCK], [1.0], 3.0)
    assert one.size[0] == pytest.approx([12, 2.5, ROAD_USERS[TRUCK].size[2]])
    seq = dict(timestamp=[5.0] * 4, id=[1, 2, 3, 4], type=["VEHICLE"] * 3 + ["ANIMAL"])
    seq |= dict(x=[0, 9, 18, 0], y=[0, 0, 0, 0], theta=[0] * 4, length=[4, 7, 2, 1])
    found = tracks_traffic(place, seq, radius=60, frames=1, notes=(said := []))
    assert found.at(0).kind.tolist() == [CAR, TRUCK, CAR]
    assert said[0] == "tracks: left out are rows of class animal"
    seq["sub_type"] = ["VAN", "BUS", "MOTORCYCLIST", "PEDESTRIAN"]
    found = tracks_traffic(place, seq, radius=60, frames=1)
    assert found.at(0).kind.tolist() == [CAR, TRUCK, CYCLIST, PEDESTRIAN]


def test_ind_and_degrees_on_the_earth(place, tmp_path):
    """With the two files beside it, over the map's own projection."""
    pytest.importorskip("pyproj", reason="needs pyproj: extra [geo]")
    utm = Georeference("EPSG:32632")
    place = replace(place, georeference=Georeference("EPSG:32632", (-300_000.0, -5_600_000.0)))
    tracks = dict(trackId=[0, 0], frame=[0, 25], xCenter=[30.0, 32.0], yCenter=[-20.0, -20.0])
    tracks |= dict(heading=[0, 0], xVelocity=[2, 2], yVelocity=[0, 0], width=[0, 0], length=[0, 0])
    path = write(tmp_path / "07_tracks.csv", tracks)
    with pytest.raises(InspeError, match=r"07_tracksMeta\.csv: no such file"):
        tracks_traffic(place, path, **SIZE)
    write(tmp_path / "07_tracksMeta.csv", {"trackId": [0], "class": ["bicycle"]})
    meta = dict(frameRate=[25.0], latLocation=[50.78], lonLocation=[6.07])
    meta |= dict(xUtmOrigin=[299_970.0], yUtmOrigin=[5_600_020.0])
    write(tmp_path / "07_recordingMeta.csv", meta)
    found = tracks_traffic(place, path, radius=60, frames=9, step=0.5)
    assert found.frame_count == 3
    assert found.at(1).kind.tolist() == [CYCLIST]
    assert found.center[1, 0, :2] == pytest.approx([1, 0], abs=1e-6)
    lon, lat = utm.to_degrees(np.array([[300_005.0, 5_600_007.0]]))[0]
    one = dict(id=[1], time=[0], lat=[lat], lon=[lon], type=["car"])
    assert tracks_traffic(place, one, radius=60, frames=1).center[0, 0, :2] == pytest.approx([5, 7])


def test_a_scene_has_it(tmp_path):
    path = write(tmp_path / "two.csv", TWO)
    scene = build_scene("four_way", radius=20, voxel=1.0, frames=50, step=0.5, traffic=path)
    settings = dict(scene.settings)
    assert settings["frames"] == "5"
    assert (settings["traffic"], settings["mix"]) == ("two.csv", "as recorded")
    assert settings["density"] == "as recorded"
    assert "usual size" in scene.intersection.notes[-1]
    same = build_scene("four_way", radius=20, voxel=1.0, frames=50, step=0.5, traffic=TWO)
    assert same.traffic.center.tolist() == scene.traffic.center.tolist()
    assert dict(same.settings)["traffic"] == "tracks"


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (dict(id=None), "needs a column of track: one of track_id, trackId, id"),
        (dict(time=None), "needs a column of time: one of time, timestamp, timestamp_ms"),
        (dict(x=[0.0]), "columns are not arrays of one length"),
        (dict(x=np.zeros((4, 2))), "columns are not arrays of one length"),
        (dict(length=[450.0] * 4), "length: 450 is too large for metres"),
        (dict(yaw_deg=None, yaw=[90.0] * 4), "yaw: 90 is too large for radians; name a column"),
        (dict(x=None), "needs a column of x: one of x, xCenter"),
        (dict(x=[0, "?", 1, 2]), "row 2, x: '\\?' is no number"),
        (dict(time=[0, 1, np.nan, 2]), "row 3, time: nan is no number"),
        (dict(time=[0, 0, 1, 2]), "track b has two rows at 0 s"),
        ({"class": ["cat"] * 4}, "no class of car, van, .* among cat"),
        (dict(y=[900] * 4), "in 2 s nobody comes within 60 m of"),
        (dict(x=[30] * 4, y=[30] * 4), "0% of its cars and trucks are on the roads of"),
    ],
)
def test_bad_tracks(place, columns, message):
    with pytest.raises(InspeError, match=message):
        tracks_traffic(place, changed(**columns), **SIZE)


def test_bad_files(place, tmp_path):
    for text, message in (
        ("", "has no rows"),
        ("id,time\n\n", "has no rows"),
        ("id,time\n1", "invalid column index 1 at row 1 with 1 columns"),
        ("id,time\n1,2\n1,?", "could not convert string '\\?' to float64 at row 1, column 2"),
        ("version https://git-lfs.github.com/spec/v1\nsize 1", "needs a column of track"),
    ):
        (path := tmp_path / "a.csv").write_text(text)
        with pytest.raises(InspeError, match=message):
            tracks_traffic(place, path, **SIZE)
