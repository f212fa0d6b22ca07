"""Into CARLA's world and back, against the CARLA client's own transforms."""

import numpy as np
import pytest
from frames import POSES
from hypothesis import given, settings

from inspe_jax.core.carla_frame import between, flip, from_carla, matrix, to_carla
from inspe_jax.core.geometry import rotation


def test_known_pose():
    """10 m east and 20 m north, facing north, nose up, leaning right."""
    pose = [10, 20, 5, np.radians(10), np.radians(20), np.radians(90)]
    np.testing.assert_allclose(to_carla(pose), [10, -20, 5, 10, -90, 20])


@given(POSES)
def test_there_and_back_one_by_one_or_many_at_once(pose):
    np.testing.assert_allclose(from_carla(to_carla(pose)), pose, rtol=1e-14, atol=1e-14)
    two = np.array([[pose, pose]])
    np.testing.assert_array_equal(to_carla(two)[0, 1], to_carla(pose))
    np.testing.assert_array_equal(from_carla(two)[0, 1], from_carla(pose))


def test_matrix_is_the_clients():
    """To single precision, which is the client's: 1e-3 m at 2 km, 1e-6 of a direction."""
    carla = pytest.importorskip("carla", reason="compares with the CARLA client")

    @settings(max_examples=50)
    @given(POSES)
    def compare(pose):
        x, y, z, roll, yaw, pitch = to_carla(pose)
        place = carla.Location(x, y, z), carla.Rotation(pitch=pitch, yaw=yaw, roll=roll)
        ours, theirs = matrix(to_carla(pose)), np.array(carla.Transform(*place).get_matrix())
        np.testing.assert_allclose(ours[:3, :3], theirs[:3, :3], atol=2e-6)
        np.testing.assert_allclose(ours[:, 3], theirs[:, 3], atol=1e-3)
        point = carla.Transform(*place).transform(carla.Location(1, 2, 3))
        np.testing.assert_allclose(
            (ours @ [1, 2, 3, 1])[:3], [point.x, point.y, point.z], atol=1e-3
        )

    compare()


@given(POSES)
def test_points_go_to_the_same_place_either_way(pose):
    """Body to world and then to CARLA's, or to CARLA's body and then by its matrix."""
    points = np.array([[1.0, 2.0, 3.0], [-4.0, 0.5, -6.0]])
    world = points @ rotation(pose[3:], np).T + pose[:3]
    there = flip(points) @ matrix(to_carla(pose))[:3, :3].T + to_carla(pose)[:3]
    np.testing.assert_allclose(flip(world), there, atol=1e-9)


def test_between_two_bodies():
    """A camera 1 m above a LiDAR and turned to the right sees the LiDAR's right ahead."""
    lidar = to_carla([5, 6, 3, 0, 0, 0])
    camera = to_carla([5, 6, 4, 0, 0, np.radians(-90)])
    np.testing.assert_allclose(between(lidar, camera) @ [0, 2, 0, 1], [2, 0, -1, 1], atol=1e-12)
