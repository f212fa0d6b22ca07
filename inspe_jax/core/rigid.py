"""Matrices of sensors' poses as calibrations have them: checked, and turned to our axes."""

from typing import Any

import numpy as np
from jaxtyping import Float

from inspe_jax.core.errors import InspeError, check_known

ROUNDED = 2e-3  # what rounding to three decimals does at most to R · Rᵀ
LARGEST = 1e12
_OPTICAL = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])

CONVENTIONS: dict[str, tuple[np.ndarray, np.ndarray]] = {
    "body": (np.eye(4), np.eye(4)),
    "optical": (np.eye(4), _OPTICAL),
    "carla": (_MIRROR, _MIRROR),
}
"""Axes of a sensor: ours are ``body``, x forward, y left, z up; ``optical``, as OpenCV's, are x
right, y down, z forward; ``carla``'s are x forward, y right, z up, in a left-handed world. What to
multiply a matrix from the sensor to the world with, on the left and on the right, to make it
ours."""

DIRECTIONS = "sensor_to_world", "world_to_sensor"


def rigid(matrix: Any, what: str = "matrix") -> Float[np.ndarray, "4 4"]:
    """A rotation and a translation, with the nearest true rotation in place of a rounded one.

    Args:
        matrix: (4, 4), or (3, 4) without its last row; translation in any unit.
        what: What messages begin with.

    Raises:
        InspeError: It is of another shape, not finite, transposed, mirrored, scaled or skew.
    """
    found = array(matrix, what, (3, 4), (4, 4))
    found = np.vstack([found, [0, 0, 0, 1]]) if len(found) == 3 else found
    if not np.allclose(found[3], [0, 0, 0, 1], atol=1e-9):
        why = "is transposed: its translation is in the last row; transpose it"
        if not np.allclose(found[:, 3], [0, 0, 0, 1], atol=1e-9):
            why = f"has the last row {found[3].round(6).tolist()}; a rigid one has [0, 0, 0, 1]"
        raise InspeError(f"{what}: {why}")
    turn = found[:3, :3]
    lengths = np.linalg.norm(turn, axis=1)
    if np.abs(turn @ turn.T - np.eye(3)).max() > ROUNDED:
        raise InspeError(
            f"{what}: is not a rotation: its rows have lengths {words(lengths)}, its determinant "
            f"is {np.linalg.det(turn):.3f}; if lens and rotation were solved together, give their "
            "product, a 3 × 4 'projection', in place of both"
        )
    if np.linalg.det(turn) < 0:
        raise InspeError(
            f"{what}: is mirrored: its determinant is −1; flip the sign of one axis, or, of CARLA "
            "or Unreal, give poses of left-handed axes as such (convention 'carla')"
        )
    left, _, right = np.linalg.svd(turn)
    found[:3, :3] = left @ right
    return found


def array(given: Any, what: str, *shapes: tuple[int, ...]) -> np.ndarray:
    """Numbers of one of the shapes, also as OpenCV and ROS write them, with rows, cols and data.
    Raises InspeError for others, or if they are not finite or beyond :data:`LARGEST`."""
    try:
        if isinstance(given, dict):
            given = np.reshape(given["data"], (given["rows"], given["cols"]))
        found = np.array(given, float)
    except (KeyError, TypeError, ValueError, OverflowError):
        found = np.zeros(0)
    if found.shape not in shapes:
        wanted = " or ".join(" × ".join(map(str, shape)) for shape in shapes)
        raise InspeError(f"{what}: must be {wanted} numbers, got shape {found.shape}")
    if not (np.abs(found) < LARGEST).all():
        raise InspeError(f"{what}: has a number that is not finite, or beyond {LARGEST:g}")
    return found


def words(numbers: Any) -> str:
    """Numbers to three decimals, in a message."""
    return ", ".join(f"{x:.3f}" for x in np.ravel(numbers))


def pose_of(
    matrix: Any, convention: str, direction: str, what: str = "matrix"
) -> Float[np.ndarray, "6"]:
    """x, y, z [m], roll, pitch, yaw [rad] of a matrix; see :meth:`inspe_jax.Pose.from_matrix`.
    Raises InspeError as :func:`rigid`, and for another convention or direction."""
    check_known(convention, CONVENTIONS, "convention")
    check_known(direction, DIRECTIONS, "direction")
    found = rigid(matrix, what)
    found = found if direction == DIRECTIONS[0] else np.linalg.inv(found)
    left, right = CONVENTIONS[convention]
    found = left @ found @ right
    (a, _, _), (b, _, _), (c, d, e) = turn = found[:3, :3]
    level = np.hypot(a, b)
    roll, yaw = np.arctan2(d, e), np.arctan2(b, a)
    if level < 1e-9:  # straight up or down: roll and yaw turn about one axis
        roll, yaw = 0.0, np.arctan2(-turn[0, 1], turn[1, 1])
    return np.array([*found[:3, 3], roll, np.arctan2(c, level), yaw])
