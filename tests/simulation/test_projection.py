"""Boxes in pictures: corners calculated by hand, and what is left out."""

from dataclasses import replace

import numpy as np
import pytest
from frames import AHEAD, CAMERA

from inspe_jax.core.geometry import pixels
from inspe_jax.simulation.projection import NEAR, corners, edge_lines

WIDE, HIGH = 800, 600


def test_corners_in_the_world():
    turned = replace(AHEAD, yaw=np.pi / 2)
    found = corners([AHEAD, turned])
    np.testing.assert_allclose(found[0, 0], [12, 1, 0])  # front left, at the bottom
    np.testing.assert_allclose(found[0, 6], [8, -1, 2])  # rear right, at the top
    np.testing.assert_allclose(found[1, 0], [9, 2, 0], atol=1e-12)
    assert corners([]).shape == (0, 8, 3)


def test_a_known_corner_falls_on_a_known_pixel():
    """The near left top corner (8, 1, 2): 1/8 to the left, 4/8 below the middle."""
    np.testing.assert_allclose(pixels(CAMERA, np.array([8.0, 1.0, 2.0])), [400 - 12.5, 300 + 50, 8])
    lines, owner = edge_lines(CAMERA, corners([AHEAD]), WIDE, HIGH)
    assert len(lines) == 12
    assert not owner.any()
    ends = lines.reshape(-1, 2)
    assert ends.min(0) == pytest.approx([387.5, 300 + 100 * 4 / 12])
    assert ends.max(0) == pytest.approx([412.5, 300 + 100 * 6 / 8])
    assert (np.abs(ends - [387.5, 350]).max(1) < 1e-9).sum() == 3  # three edges meet there


def test_boxes_behind_or_outside_are_left_out():
    behind = replace(AHEAD, track=1, center=np.array([-10.0, 0.0, 1.0]))
    beside = replace(AHEAD, track=2, center=np.array([10.0, 60.0, 1.0]))
    below = replace(AHEAD, track=3, center=np.array([10.0, 0.0, -60.0]))
    _, owner = edge_lines(CAMERA, corners([behind, beside, AHEAD, below]), WIDE, HIGH)
    assert set(owner.tolist()) == {2}
    assert len(edge_lines(CAMERA, corners([]), WIDE, HIGH)[0]) == 0


def test_a_box_that_reaches_behind_the_camera_is_cut():
    """20 m long, from 9 m behind to 11 m ahead, its top 3 m below: its far end is at 300 + 300/11,
    and its long edges leave the picture at the bottom, where depth is 1 m for the top, 5/3 m for
    the bottom."""
    long = replace(AHEAD, center=np.array([1.0, 0.0, 2.0]), size=np.array([20.0, 2.0, 2.0]))
    lines, _ = edge_lines(CAMERA, corners([long]), WIDE, HIGH)
    ends = lines.reshape(-1, 2)
    assert np.isfinite(ends).all()
    assert ends.min() >= -1e-9
    assert (ends <= [WIDE + 1e-9, HIGH + 1e-9]).all()
    assert ends[:, 1].min() == pytest.approx(300 + 300 / 11)
    at_bottom = np.sort(ends[np.abs(ends[:, 1] - HIGH) < 1e-6, 0])
    np.testing.assert_allclose(at_bottom, [300, 340, 460, 500])
    assert len(lines) == 8  # four long edges and those of the far end


def test_edges_are_cut_at_the_near_plane():
    """A beam overhead is cut close to the camera; the rest is in the picture."""
    camera = replace(CAMERA, pose=np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    beam = replace(AHEAD, center=np.array([0.0, 0.0, 1.0]), size=np.array([8.0, 1e-4, 1e-4]))
    lines, _ = edge_lines(camera, corners([beam]), WIDE, HIGH)
    spread = np.abs(lines.reshape(-1, 2) - [400, 300]).max()
    assert spread == pytest.approx(100 * 0.5e-4 / NEAR, rel=1e-6)
