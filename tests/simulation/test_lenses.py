"""Pictures through lenses that bend lines: a road user is where the lens has it."""

import numpy as np
import pytest
from worlds import BARREL, CEILING, place_sensors, with_boxes, world

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import pose_matrix
from inspe_jax.core.rigid import CONVENTIONS
from inspe_jax.simulation.carla.sensors import CarlaCamera
from inspe_jax.simulation.projection import corners
from inspe_jax.simulation.recorder import Recording


@pytest.mark.parametrize(("spec", "pose"), [
    (BARREL, [-6.0, 1.0, 5.0, 0.02, -0.4, 0.1]), (CEILING, [3.0, -6.0, 8.0, 0.0, -1.5, 0.7]),
], ids=["barrel", "ceiling"])  # fmt: skip
def test_a_car_is_seen_at_its_pixels_and_nothing_beyond_the_circle(spec, pose):
    """A box of 1.5 m at the side of the picture; pixels are four times as large as the camera's."""
    pytest.importorskip("embreex", reason="no wheels of Embree for this platform")
    from inspe_jax.simulation.backends import recorder_of

    at = np.array([4.0, 4.0, 0.75])
    scene = with_boxes(world(count=0, radius=40.0, voxel=2.0), (*at[:2], 0.3, 1.5, 1.5, 1.5))
    layout = place_sensors((spec, pose))
    size = spec.width // 4, spec.height // 4
    how = Recording(layers=("instance", "depth"), image_size=size)
    with recorder_of("embedded", scene, layout, recording=how) as recorder:
        (image,) = recorder.frame(0).stations[0].images
    rows, columns = np.nonzero(image.instance)
    to_optical = np.linalg.inv(pose_matrix(pose) @ np.linalg.inv(CONVENTIONS["optical"][1]))
    (box,) = corners([recorder.surroundings.actors(0).boxes[0]])
    seen = spec.optics.pixels(np.column_stack([box, np.ones(8)]) @ to_optical[:3].T) / 4
    found = np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])
    off = found - [seen.min(0), seen.max(0)]
    assert np.abs(off).max() < 0.25 * np.ptp(seen, axis=0).max()  # a car fills its box but for
    assert (off[0] > -1.1).all()  # its hood, and is not beyond it
    assert (off[1] < 1.1).all()
    assert image.depth[rows, columns].mean() == pytest.approx((to_optical @ [*at, 1])[2], abs=1.0)
    u, v = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    dark = spec.optics.beyond_circle(4 * np.column_stack([u.ravel(), v.ravel()])).reshape(u.shape)
    assert dark.any() == (spec is CEILING)
    assert np.isinf(image.depth[dark]).all()
    assert (image.rgb[dark] < 30).all()
    assert image.rgb[~dark].mean() > 60


def test_carla_refuses_lenses_that_are_not_its_own():
    with pytest.raises(InspeError, match=r"ceiling: CARLA's cameras are pinholes here, .*embedded"):
        CarlaCamera(CEILING, Recording())
