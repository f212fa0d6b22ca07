"""Scores of before scores were counted over sets, kept: the same voxels are seen.

Made by the state before that change. Of 1120 voxels and 5 frames, one voxel more or less in one
frame moves O by 2e-4; what another JAX or CPU adds up in another order differs by some 2e-7.
"""

import pytest

import inspe_jax
from inspe_jax.scoring.metrics import listed

KEPT = {
    ("four_way", "roi", "past_others"): (
        (0.97117919, 0.95305794, 0.80421132, 0.92872500),
        (0.97069538, 0.96835434, 0.80717081, 0.93681997),
    ),
    ("four_way", "covered", "line_of_sight"): (
        (0.97117919, 0.97770137, 0.61879617, 0.90396363),
        (0.97069538, 0.99382317, 0.71957397, 0.93203503),
    ),
    ("four_way", "targets", "in_view"): (
        (0.97117919, 0.97460872, 0.85292739, 0.94924366),
        (0.97069538, 0.97982281, 0.84823835, 0.95076776),
    ),
    ("roundabout", "roi", "past_others"): (
        (1.00000000, 0.95063365, 0.89405662, 0.95412815),
        None,
    ),
    ("roundabout", "covered", "line_of_sight"): (
        (1.00000000, 0.95063365, 0.65029639, 0.90537614),
        None,
    ),
    ("roundabout", "targets", "in_view"): (
        (1.00000000, 1.00000000, 0.94068277, 0.98813659),
        None,
    ),
    ("highway_ramp", "roi", "past_others"): (
        (0.98559749, 0.91728008, 0.77463526, 0.90924639),
        None,
    ),
    ("highway_ramp", "covered", "line_of_sight"): (
        (0.98559749, 0.93014020, 0.63667011, 0.88808334),
        None,
    ),
    ("highway_ramp", "targets", "in_view"): (
        (0.98559749, 0.87110317, 0.86181527, 0.90359390),
        None,
    ),
}
"""Exact and soft C, O, IG and P_sm by built-in, occlusion reference and visibility."""


def four(scores):
    return tuple(scores.value(metric.name) for metric in listed())


@pytest.mark.parametrize(("name", "reference", "visibility"), KEPT)
def test_scores_are_those_of_before(name, reference, visibility):
    size = dict(radius=30, voxel=1.0, spacing=2.0, frames=5, density=12, seed=4)
    scene = inspe_jax.build_scene(inspe_jax.built_in(name), **size)
    layout = inspe_jax.strategy(scene, "Cam-c/L-c")
    options = dict(occlusion_reference=reference, visibility=visibility)
    exact, soft = KEPT[name, reference, visibility]
    assert four(inspe_jax.evaluate(scene, layout, **options)) == pytest.approx(exact, abs=2e-6)
    if soft is not None:
        found = inspe_jax.evaluate(
            scene, layout, softness=inspe_jax.Softness(0.5, 0.5, "exact"), **options
        )
        assert four(found) == pytest.approx(soft, abs=2e-6)
