"""What one browser sees of its selected sensors in three dimensions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from jaxtyping import Float

from inspe_jax.report.figures import SENSOR_COLORS
from inspe_jax.viewer.scene3d import Outline, rgb

WIDE = 0.4
"""Width of the outline of what a selected sensor looks at [m]."""
POINT_SIZE = 0.14
"""Of a LiDAR's points, which have the colour of LiDARs [m]."""


class Selection3D:
    """Outlines of what the selected sensors look at, wider than others, and a LiDAR's points."""

    def __init__(self, api: viser.SceneApi, shift: Float[np.ndarray, "3"]) -> None:
        """``shift`` is the scene's centre [m]."""
        self._api, self._shift = api, shift
        self.outlines: list[Any] = []
        self.points: Any = None

    def draw_outlines(self, outlines: Sequence[Outline]) -> None:
        """Draw these outlines in place of those before."""
        for k, found in enumerate(outlines):
            color = rgb(found.color)
            if k == len(self.outlines):
                name = f"selected/{k + 1}"
                line = self._api.add_line_segments(name, found.points, color, thickness=WIDE)
                self.outlines.append(line)
            line = self.outlines[k]
            line.points, line.colors = found.points, np.array(color, np.uint8)
            line.visible = True
        for line in self.outlines[len(outlines) :]:
            line.visible = False

    def draw_points(self, points: Float[np.ndarray, "N 3"] | None) -> None:
        """Draw a LiDAR's points, given in the world [m], in place of those before; or none."""
        if points is None or not len(points):
            if self.points is not None:
                self.points.remove()
            self.points = None
            return
        at, color = (points - self._shift).astype(np.float32), rgb(SENSOR_COLORS["lidar"])
        if self.points is None:
            self.points = self._api.add_point_cloud(
                "points", at, color, point_size=POINT_SIZE, point_shading="flat"
            )
        else:
            self.points.points = at
