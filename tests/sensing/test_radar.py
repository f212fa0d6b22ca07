"""A radar as a spec: what its beam covers, its keys, its devices, and what weather takes."""

import numpy as np
import pytest
from worlds import place_sensors, world

import inspe_jax
from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.sensing.catalogue import device, spec_of, table_of
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import load_layout, save_layout
from inspe_jax.sensing.radar import RadarSpec
from inspe_jax.visibility.queries import in_view

TABLE = dict(
    kind="radar",
    range_m=25.0,
    azimuth_fov_deg=60.0,
    elevation_fov_deg=20.0,
    range_resolution_m=0.5,
    azimuth_resolution_deg=4.0,
    speed_resolution_mps=0.2,
)
POSE = [-12.0, 3.0, 5.0, 0.05, -0.2, -0.3]


def test_its_beam_fills_its_field_of_view():
    """A voxel is in view where its middle is between the edges, but for those at the rim."""
    scene, spec = world(radius=20.0, voxel=0.5, frames=1, count=2), spec_of(TABLE, "r", "here")
    q = (scene.voxels.centers - POSE[:3]) @ rotation(np.array(POSE[3:]), np)
    distance = np.linalg.norm(q, axis=1)
    depth = (
        np.minimum(
            np.radians([30.0, 10.0])[:, None]
            - np.abs([np.arctan2(q[:, 1], q[:, 0]), np.arcsin(q[:, 2] / distance)]),
            1.0,
        ).min(0)
        * distance
    )
    depth = np.minimum(depth, 25.0 - distance)
    ours = in_view(scene, place_sensors((spec, POSE)))[0]
    sure = np.abs(depth) > 0.5  # more than half of a voxel's diagonal
    assert 0.1 < (depth > 0).mean() < 0.9
    assert sure.mean() > 0.8
    assert (ours == (depth > 0))[sure].all()


@pytest.mark.parametrize("reach", [70.0, 250.0])
@pytest.mark.parametrize("voxel", [0.2, 0.5])
def test_its_beam_fills_it_up_to_its_reach_for_voxels_of_any_profile(reach, voxel):
    """A region in the middle of the beam is in view, however small its voxels are."""
    scene = world(radius=10.0, voxel=voxel, frames=1, count=2)
    spec = spec_of(TABLE | dict(range_m=reach), "r", "here")
    pose = [12.0 - reach, 0.1, 1.5, 0.01, 0.02, 0.02]
    assert in_view(scene, place_sensors((spec, pose)))[0].all()


@pytest.mark.parametrize("name", [n for n, d in inspe_jax.devices().items() if d.kind == "radar"])
def test_neighbouring_rays_are_at_most_a_small_voxel_apart(name):
    spec = device(name).spec
    rows = np.diff(spec.grid.rows).max() * spec.reach
    assert max(rows, spec.grid.column_step * spec.reach) <= 0.2 + 1e-9
    assert len(spec.grid.rows) * spec.grid.column_count < 150_000


def test_each_ray_stands_for_the_same_solid_angle():
    spec = spec_of(TABLE | dict(elevation_fov_deg=120.0), "r", "here")
    up = np.sin(spec.grid.rows)
    np.testing.assert_allclose(np.diff(up), up[1] - up[0], rtol=1e-9)
    assert np.degrees(spec.field_of_view) == pytest.approx([60.0, 120.0])
    assert spec.grid.column_count * spec.grid.column_step == pytest.approx(np.pi / 3)


def test_keys_and_layouts_are_read_and_written(tmp_path):
    spec = spec_of(TABLE, "r", "here")
    assert isinstance(spec, RadarSpec)
    assert spec.min_speed == 0.2
    assert spec_of(TABLE | dict(min_speed_mps=0.0), "r", "here").min_speed == 0.0
    assert spec_of(table_of(spec), "r", "here") == spec
    scene = world(radius=20.0, voxel=0.5, frames=1, count=2)
    save_layout(
        place_sensors((spec, POSE), (device("paper-camera").spec, POSE)), tmp_path / "a.yaml"
    )
    again = load_layout(tmp_path / "a.yaml", scene)
    assert again.sensors[0].spec == spec
    with pytest.raises(InspeError, match="range_resolution_m"):
        spec_of(TABLE | dict(range_resolution_m=0.0), "r", "here")


@pytest.mark.parametrize("name", [n for n, d in inspe_jax.devices().items() if d.kind == "radar"])
def test_devices_have_a_source_and_a_maker(name):
    row = device(name)
    assert row.maker
    assert row.source
    assert row.spec.range_resolution < row.spec.reach / 10


def test_rain_takes_little_and_light_and_fog_nothing():
    """At 10 mm/h 5.9 dB/km (ITU-R P.838-3), both ways: z⁴ exp(2 k z) is as it was."""
    spec = spec_of(TABLE | dict(range_m=100.0), "r", "here")
    wet = Conditions.of("night", "rain:10").spec(spec)
    lost = 5.89 / 1000 * np.log(10) / 10
    assert wet.reach**4 * np.exp(2 * lost * wet.reach) == pytest.approx(100.0**4, rel=0.01)
    assert wet.reach == pytest.approx(94, abs=0.5)
    assert wet.reliability == spec.reliability
    assert Conditions.of("night", "fog:50").spec(spec) == spec
