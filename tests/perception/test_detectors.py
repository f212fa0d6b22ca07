"""The eight detectors and the teacher, on what a loader gives."""

from functools import partial

import equinox as eqx
import jax
import numpy as np
import pytest
from loading_sets import HEIGHT, WIDTH, frame_of, write_scenario

from inspe_jax import dataset
from inspe_jax.core.errors import InspeError
from inspe_jax.perception import detector as detectors
from inspe_jax.perception import encoders
from inspe_jax.perception.detector import MODELS, Detector, loader_of, model_of
from inspe_jax.perception.head import aims, loss
from inspe_jax.perception.inputs import Agents, BevGrid, Inputs, inputs_of
from inspe_jax.perception.training.run import agents_of

GRID = BevGrid(half=12.8)


@pytest.fixture(scope="module")
def cached(tmp_path_factory):
    root = tmp_path_factory.mktemp("detectors")
    write_scenario(root / "set" / "train" / "a", [frame_of(n, points=20) for n in (0, 1)])
    return dataset.cache(root / "set", root / "cache", pictures=(HEIGHT, WIDTH), workers=1)


def inputs(cached, name: str) -> tuple[Inputs, dataset.loading.Targets]:
    batch = loader_of(name, cached, "train", GRID, batch=2, shuffle=False)[0]
    return inputs_of(batch, agents_of(cached)), batch.targets


def exchanged(given: Inputs) -> Inputs:
    """The same with the two units of each modality the other way round."""
    pillars = given.pillars
    if pillars is not None:
        pillars = type(pillars)(*(part[:, ::-1] for part in pillars))
    unit = given.unit
    if unit is not None:
        unit = np.where(unit >= 0, 1 - unit, -1).astype(np.int32)
    order = [1, 0, 3, 2][: given.present.shape[1]]
    return given._replace(pillars=pillars, unit=unit, present=given.present[:, order])


@pytest.mark.parametrize("name", MODELS)
def test_every_detector_takes_what_the_loader_gives(cached, name):
    """By shapes alone: nothing is compiled."""
    given, _ = inputs(cached, name)
    key = jax.random.key(0)
    detector = eqx.filter_eval_shape(Detector, model_of(name), agents_of(cached), GRID, key)
    found = eqx.filter_eval_shape(lambda detector, given: detector(given), detector, given)
    assert found.fused.shape == (2, GRID.side // 2, GRID.side // 2, 48)
    assert found.found.heat.shape == (2, GRID.side, GRID.side, 4)
    weights = [leaf for leaf in jax.tree.leaves(detector) if hasattr(leaf, "weak_type")]
    assert 4e5 < sum(leaf.size for leaf in weights) < 2e6
    # Else the second step of a training is compiled once more.
    assert not any(leaf.weak_type for leaf in weights)


@pytest.mark.parametrize("name", ["coalign", "attfuse"])
def test_a_detector_heeds_no_order_and_learns_everywhere(cached, name, monkeypatch):
    """One map and all scales, of LiDARs and of both; other parts by themselves are in
    ``test_parts``. Two scales are compiled sooner than three."""
    monkeypatch.setattr(encoders, "WIDTHS", (8, 16, 24))
    monkeypatch.setattr(detectors, "CHANNELS", 16)
    given, targets = inputs(cached, name)
    detector = eqx.filter_jit(Detector)(model_of(name), agents_of(cached), GRID, jax.random.key(0))

    @eqx.filter_jit
    @partial(eqx.filter_grad, has_aux=True)
    def slopes_of(detector, given):
        predicted = detector(given)
        return sum(loss(predicted.found, aims(targets, GRID))), predicted.fused

    slopes, fused = slopes_of(detector, given)
    _, turned = slopes_of(detector, exchanged(given))
    np.testing.assert_allclose(turned, fused, atol=1e-3)
    leaves = jax.tree_util.tree_leaves_with_path(slopes)
    still = [jax.tree_util.keystr(path) for path, x in leaves if not np.asarray(x).any()]
    only_on_pictures = [".pictures.heat.weight", ".pictures.heat.bias"]
    assert still == (only_on_pictures if detector.pictures else [])


def test_agents_are_filled_up_and_never_left_out(cached):
    batch = loader_of("attfuse", cached, "train", GRID, batch=3, shuffle=False)[0]
    assert batch.valid.tolist() == [True, True, False]
    more = inputs_of(batch, Agents(3, 4))
    assert more.pillars.counts.shape[1] == 3
    assert not more.pillars.counts[:, 2].any()
    # Padding, a frame without agents, has one that is empty.
    there = [[1, 1, 0, 1, 1, 0, 0]] * 2 + [[1, 0, 0, 0, 0, 0, 0]]
    np.testing.assert_array_equal(more.present, there)
    np.testing.assert_array_equal(more.unit, [[0, 1], [0, 1], [-1, -1]])
    for few, what in ((Agents(1, 2), "LiDARs"), (Agents(2, 1), "cameras")):
        with pytest.raises(InspeError, match=f"a frame has 2 units with {what}.* made for 1"):
            inputs_of(batch, few)
    batch.lidars.pillars.counts[:, 0] = 0  # whichever unit it is
    with pytest.raises(InspeError, match="a frame has 2 units with LiDARs"):
        inputs_of(batch, Agents(1, 2))


def test_an_unknown_model_is_told_which_there_are():
    with pytest.raises(InspeError, match=r"model 'v2xvit': one of lss-eff, .*did you mean v2x-vit"):
        model_of("v2xvit")
