"""Modules under their old names: what the README has shown goes on to work, with a warning."""

import importlib

import pytest

MOVED = {
    "inspe_jax.sensing.raycast": ("inspe_jax.visibility.raycast", "in_view"),
    "inspe_jax.dataset.recorder": (
        "inspe_jax.simulation.embedded.recorder",
        "EmbeddedRecorder",
    ),
}


@pytest.mark.parametrize("old", MOVED)
def test_an_old_name_works_and_says_the_new_one(old):
    new, name = MOVED[old]
    with pytest.warns(DeprecationWarning, match=f"{old} is now {new}"):
        found = getattr(importlib.import_module(old), name)
    assert found is getattr(importlib.import_module(new), name)
    with (
        pytest.warns(DeprecationWarning, match=old),
        pytest.raises(AttributeError, match="nothing_of_it"),
    ):
        importlib.import_module(old).nothing_of_it  # noqa: B018


def test_names_of_before_work_and_say_the_new_ones():
    import inspe_jax.dataset as dataset

    with pytest.warns(DeprecationWarning, match="Thing is now RoadUserBox"):
        assert dataset.Thing is dataset.RoadUserBox
    with pytest.raises(AttributeError, match="nothing_of_it"):
        dataset.nothing_of_it  # noqa: B018
