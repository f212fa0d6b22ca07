"""The handle on the selected sensor: arrows and planes move it, rings turn it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser
from jaxtyping import Float

from inspe_jax.core.geometry import rotation
from inspe_jax.viewer.scene3d import quaternion, turn_of

LENGTH = 90.0
"""Length of the handle's arrows [pixel]."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class HandleDrag:
    """One event of a drag: the handle is gripped ("start"), moved ("update") or let go ("end").

    ``at`` (3,) is the handle's position about the scene's centre [m], ``turn`` its rotation matrix.
    """

    phase: str
    at: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3 3"]

    def on(
        self, pose: Float[np.ndarray, "6"], shift: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "6"]:
        """The world pose that the drag gives a sensor. ``shift`` is the scene's centre [m].

        The handle stands upright and faces along the yaw of ``pose``, the pose that it was put on.
        A turn about the vertical axis changes the yaw, one about the left axis the pitch. A turn
        about the forward axis changes nothing, since no sensor is mounted with a roll.
        """
        ahead, dragged = self.turn[:, 0], pose.copy()
        dragged[:3] = self.at + shift
        dragged[4] += np.arcsin(np.clip(ahead[2], -1, 1))
        dragged[5] = np.arctan2(ahead[1], ahead[0])
        return dragged


class Handle:
    """A gizmo that one browser sees; ``dragged`` is called on the server's event loop."""

    def __init__(self, api: viser.SceneApi, dragged: Callable[[HandleDrag], None]) -> None:
        self.gizmo = gizmo = api.add_transform_controls(
            "handle", scale=LENGTH, fixed=True, line_width=3.5, depth_test=False
        )

        @gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            if event.client is not None:
                dragged(HandleDrag(event.phase, np.array(gizmo.position), turn_of(gizmo.wxyz)))

    def show(
        self, pose: Float[np.ndarray, "6"], shift: Float[np.ndarray, "3"], *, visible: bool
    ) -> None:
        """Put the handle on a world pose, upright. ``shift`` is the scene's centre [m]."""
        self.gizmo.wxyz = quaternion(rotation(np.array([0.0, 0.0, pose[5]]), np))
        self.gizmo.position = pose[:3] - shift
        self.gizmo.visible = visible
