"""Maps of the road users that an agent's cameras see, as OPV2V's ``_bev_visibility.png``.

HEAL's and CoAlign's camera readers keep the boxes whose middle lies on a pixel that is not black.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw

from inspe_jax.core.geometry import rotation
from inspe_jax.dataset.formats.agents import frame_of
from inspe_jax.simulation.frame import RoadUserBox, Station

PIXELS = 256
"""Width and height of a map, as in OPV2V and these readers."""
PIXEL = 0.39
"""Size of a pixel [m], as in OPV2V and these readers: they see 50 m ahead, back and aside."""
MIDDLE = 127
"""Row and column of the agent."""
CORNERS = np.array([[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]) / 2
"""In plan, of a box of length and width 1."""


def visibility_map(agent: Station, boxes: Sequence[RoadUserBox]) -> UInt8[np.ndarray, "256 256"]:
    """The map of an agent: white on black, ahead is up.

    It is in the frame of the agent's first LiDAR, or of its unit where it has none. A road user is
    white where at least one pixel of a camera shows it, or where it was not counted what pixels
    show.
    """
    pose = frame_of(agent)
    turn = rotation(pose[3:], np)
    picture = Image.new("L", (PIXELS, PIXELS))
    draw = ImageDraw.Draw(picture)
    for box, seen in zip(boxes, _seen(agent, len(boxes)), strict=True):
        if seen:
            middle = np.asarray(box.center, float)
            facing = rotation(np.array([0.0, 0.0, box.yaw]), np)
            corners = middle + (CORNERS * box.size) @ facing.T
            at = _pixels((np.vstack([corners, middle]) - pose[:3]) @ turn)
            draw.polygon([tuple(p) for p in at[:4].tolist()], fill=255)
            draw.point(tuple(at[4].tolist()), fill=255)
    return np.asarray(picture)


def _seen(agent: Station, count: int) -> Bool[np.ndarray, " B"]:
    if any(image.pixels is None for image in agent.images):
        return np.ones(count, bool)
    shown = np.zeros(count, bool)
    for image in agent.images:
        shown |= np.asarray(image.pixels) > 0
    return shown


def _pixels(points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N 2"]:
    """Column and row of points of the agent's frame; the readers round towards the agent, too."""
    ahead, left = (np.trunc(points[:, i] / PIXEL).astype(int) for i in (0, 1))
    return np.column_stack([MIDDLE - left, MIDDLE - ahead])
