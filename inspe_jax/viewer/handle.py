"""The handle on the sensor in hand: arrows and planes to move it, rings to turn it."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import viser
from jaxtyping import Float

from inspe_jax.core.geometry import rotation
from inspe_jax.report.scene3d import quaternion, turn_of

LENGTH = 90.0
"""Of the handle's arrows [pixel]."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Pull:
    """What is done to the handle: gripped ("start"), moved ("update"), let go ("end").

    ``at`` (3,) is where it is then, about the scene's centre, and ``turn`` how it is turned.
    """

    phase: str
    at: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3 3"]

    def on(
        self, pose: Float[np.ndarray, "6"], shift: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, "6"]:
        """What it makes of the pose that the handle was put on.

        The handle stands upright, ahead along the pose's yaw: a turn about the vertical is the
        yaw's, one about the left the pitch's, and one about ahead none, since nothing is hung
        askew.
        """
        ahead, pulled = self.turn[:, 0], pose.copy()
        pulled[:3] = self.at + shift
        pulled[4] += np.arcsin(np.clip(ahead[2], -1, 1))
        pulled[5] = np.arctan2(ahead[1], ahead[0])
        return pulled


class Handle:
    """A gizmo that browsers share; ``pulled`` is called on their event loop."""

    def __init__(self, api: viser.SceneApi, pulled: Callable[[Pull], None]) -> None:
        self.gizmo = gizmo = api.add_transform_controls(
            "handle", scale=LENGTH, fixed=True, line_width=3.5, depth_test=False
        )

        @gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            if event.client is not None:
                pulled(Pull(event.phase, np.array(gizmo.position), turn_of(gizmo.wxyz)))

    def show(
        self, pose: Float[np.ndarray, "6"], shift: Float[np.ndarray, "3"], *, visible: bool
    ) -> None:
        """Put it on a world pose, upright."""
        self.gizmo.wxyz = quaternion(rotation(np.array([0.0, 0.0, pose[5]]), np))
        self.gizmo.position = pose[:3] - shift
        self.gizmo.visible = visible
