"""Tables and maps of what a road user gets name the kinds of sensors that a layout has."""

from drawn import printed, texts
from worlds import LIDAR, place_sensors, world

from inspe_jax.report.targets import targets_record, targets_table, targets_view
from inspe_jax.scoring.targets import target_view
from inspe_jax.sensing.catalogue import device


def test_radars_are_no_lidars():
    """Radars have no returns: alone they have the map of chances; beside a LiDAR its map is of the
    LiDAR."""
    scene, pose = world(radius=12, voxel=1.0, frames=3, count=5), [-10.0, 0.0, 6.0, 0.0, -0.3, 0.0]
    radar = device("continental-ars408-near").spec
    alone, both = place_sensors((radar, pose)), place_sensors((radar, pose), (LIDAR, pose))
    for layout, lidar in ((alone, False), (both, True)):
        view = target_view(scene, layout, "car")
        record = targets_record(scene, layout, view)
        assert ("lidar_returns" in record) == lidar
        assert "pixels_per_metre" not in record
        assert ("LiDAR returns" in printed(targets_table(record))) == lidar
        figure = targets_view(scene, layout, view)
        assert len(figure.axes) == 1 + lidar
        assert any("LiDAR returns" in words for words, _ in texts(figure)) == lidar
        assert record["detectability"]["all"] > 0
