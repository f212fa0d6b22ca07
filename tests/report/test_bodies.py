"""Static bodies on maps: their outlines, and that nothing is scored in them."""

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from worlds import street_bodies, world

from inspe_jax.report.bodies import BODY_COLORS, body_keys, look_of
from inspe_jax.report.figures import scene_view
from inspe_jax.report.layers import layers
from inspe_jax.scene.statics import KINDS, upright_box
from inspe_jax.scoring.viewshed import Viewshed


@pytest.fixture(scope="module")
def street():
    scene = world(count=0, slope=0.03, center=(40.0, -20.0, 3.0))
    return scene.with_statics(street_bodies(scene.intersection))


def test_a_map_has_the_outline_of_every_body(street):
    (ax, *_) = scene_view(street).axes
    drawn = [
        path.vertices[:-1]
        for collection in ax.collections
        if isinstance(collection, PolyCollection) and collection.zorder == 3.5
        for path in collection.get_paths()
    ]
    assert len(drawn) == len(street.statics)
    for one in street.statics:
        assert any(
            len(found) == len(one.outline) and np.allclose(found, one.outline) for found in drawn
        )


def test_the_legend_has_the_kinds_in_the_circle_each_once(street):
    far = upright_box("hedge", street.voxels.center[:2] + 400.0, (2, 2, 2))
    others = tuple(one for one in street.statics if one.kind != "hedge")
    scene = street.with_statics([*others, far])
    found = ", ".join(key.get_label() for key in body_keys(scene)).split(", ")
    assert sorted(found) == sorted({one.kind for one in others})
    assert set(BODY_COLORS) == set(KINDS)
    assert look_of("tree")["fc"] == "none"  # the ground beneath is seen
    rim = upright_box("building", street.voxels.center[:2] + [25.0, 0.0], (30, 10, 6))
    (key,) = body_keys(street.with_statics([rim]))  # its middle is outside the circle
    assert key.get_label() == "building"


def test_layers_have_no_value_within_a_body(street):
    """Nor does a voxel within one count as not seen."""
    grid = street.voxels
    inside = np.asarray(street.inside_statics)
    whole = inside.all(1)
    part = inside.any(1) & ~whole
    assert whole.any()
    assert part.any()
    free = ~inside.ravel()
    everything = Viewshed(sensors=3 * free, seen=5 * free, occupied=0 * free, frame_count=5)
    found = layers(street, everything)
    for name, value in (("seen", 1.0), ("redundancy", 3.0), ("blind", 0.0)):
        values = found[name].values
        assert np.isnan(values[whole]).all()
        np.testing.assert_allclose(values[~whole], value, err_msg=name)
    assert len(values) == len(grid.columns)
