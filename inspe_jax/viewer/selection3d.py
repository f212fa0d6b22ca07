"""What one browser has in three dimensions: the handle on a sensor, outlines, a LiDAR's points. The
handle's arrows and planes move the sensor in hand, its rings turn it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from jaxtyping import Float
from viser.transforms import SO3

from inspe_jax.report.figures import SENSOR_COLORS
from inspe_jax.viewer.scene3d import rgb

LENGTH = 90.0  # length of the handle's arrows [pixel]
WIDE = 0.4  # width of the outline of what a selected sensor looks at [m]
POINT_SIZE = 0.14  # of a LiDAR's points, which have the colour of LiDARs [m]


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class HandleDrag:
    """One event of a drag: the handle is gripped ("start"), moved ("update") or let go ("end").
    ``at`` (3,) is the handle's position in the world [m], ``turn`` its rotation matrix."""

    phase: str
    at: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3 3"]

    def on(self, pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "6"]:
        """The world pose that the drag gives a sensor. The handle was put upright on ``pose``,
        along its yaw; a turn about the forward axis changes nothing: no sensor has a roll."""
        ahead, (roll, pitch) = self.turn[:, 0], pose[3:5]
        pitch += np.arcsin(np.clip(ahead[2], -1, 1))
        return np.array([*self.at, roll, pitch, np.arctan2(ahead[1], ahead[0])])


class Selection3D:
    """The handle, outlines of what the selected sensors look at, wider than others, and points."""

    def __init__(
        self,
        api: viser.SceneApi,
        shift: Float[np.ndarray, "3"],
        dragged: Callable[[HandleDrag], None],
    ) -> None:
        """``shift`` is the scene's centre [m]. ``dragged`` is called on the server's event loop."""
        self._api, self._shift = api, shift
        self.outlines: list[Any] = []
        self.points: Any = None
        self.gizmo = gizmo = api.add_transform_controls(
            "handle", scale=LENGTH, fixed=True, line_width=3.5, depth_test=False
        )

        @gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            if event.client is not None:
                at, turn = np.array(gizmo.position) + shift, SO3(np.array(gizmo.wxyz)).as_matrix()
                dragged(HandleDrag(event.phase, at, turn))

    def put_handle(self, pose: Float[np.ndarray, "6"], *, visible: bool) -> None:
        """Put the handle on a world pose, upright."""
        self.gizmo.wxyz = SO3.from_z_radians(pose[5]).wxyz
        self.gizmo.position = pose[:3] - self._shift
        self.gizmo.visible = visible

    def draw_outlines(self, outlines: Sequence[tuple[Float[np.ndarray, "N 2 3"], str]]) -> None:
        """Draw these line segments [m] in their colours, in place of those before."""
        for k, (points, color) in enumerate(outlines):
            if k == len(self.outlines):
                name = f"selected/{k + 1}"
                line = self._api.add_line_segments(name, points, rgb(color), thickness=WIDE)
                self.outlines.append(line)
            line = self.outlines[k]
            line.points, line.colors = points, np.array(rgb(color), np.uint8)
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
