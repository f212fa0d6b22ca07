"""The pose of a camera from pixels of places whose coordinates are known (resection).

Least squares of the reprojection error over place and rotation, from starts all around the places,
of which the best counts (the camera resection of Hartley and Zisserman, *Multiple View Geometry*,
section 7).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import rotation
from inspe_jax.core.rigid import array, pose_of, words
from inspe_jax.sensing.lens import Lens
from inspe_jax.sensing.sensors import Pose

ROBUST = 5.0  # residuals beyond this count less than squared [px]: some pixels are misread
HEIGHTS = 8.0, 20.0  # of starts above the places [m]
SPREADS = 0.6, 1.0, 2.0  # distances of starts, in times that at which the places fill their pixels
ROUGH, FINE = 25, 200  # most steps from each start, and from the best on
OPEN = 1e12  # a greater condition number of the slopes is no pose
FEWEST = 4  # pairs: of three, up to four poses agree


@dataclass(frozen=True)
class PoseFit:
    """A solved pose: ``residuals`` [px] of each pair, (N, 2), found less given; ``covariance``
    (6, 6) of x, y, z [m] and of turns about the axes x, y, z of the frame [rad], 0 for what was
    held. It is that of scattered pixels: lens and points count as exact."""

    pose: Pose
    residuals: Float[np.ndarray, "N 2"]
    covariance: Float[np.ndarray, "6 6"]

    @property
    def rms(self) -> float:
        """Root mean square of the distances between pixels found and given [px]."""
        return float(np.sqrt((self.residuals**2).sum(1).mean()))

    @property
    def words(self) -> str:
        """How well it fits, in a line."""
        at, turns = np.split(np.sqrt(np.diag(self.covariance)), 2)
        off = np.linalg.norm(self.residuals, axis=1)
        return (
            f"{len(off)} pairs, {self.rms:.1f} px rms, at most {off.max():.1f} px; standard "
            f"deviations of x, y, z {words(at)} m, of turns about them {words(np.degrees(turns))}°"
        )


def solve_pose(
    pixels: Any, points: Any, lens: Lens, *, place: Any = None, robust: float = ROBUST
) -> PoseFit:
    """The pose from which a lens shows known points at the given pixels.

    Args:
        pixels: (N, 2) columns and rows [px].
        points: (N, 3) places [m], in the frame that the pose is wanted in.
        lens: Intrinsics, which are held.
        place: (3,) the camera's place [m] if it is known; it is then held.
        robust: Residual [px] from which on the loss is no longer square but linear (soft L1).

    Returns:
        The pose, residuals and covariance of the best of the starts.

    Raises:
        InspeError: There are too few pairs, shapes differ, all points lie on one line, the pairs
            leave the pose open, or the lens has distortion of an unknown kind.

    >>> lens = inspe_jax.Lens(1000.0, 1000.0, 960.0, 540.0)
    >>> at = [[20, -5, 0], [20, 5, 0], [40, -8, 0], [40, 8, 0], [30, 0, 2]]
    >>> seen = [[1194, 828], [726, 828], [1153, 682], [767, 682], [960, 676]]
    >>> inspe_jax.solve_pose(seen, at, lens).pose.z > 5
    True
    """
    points = array(points, "points", (len(points) if np.ndim(points) else 0, 3))
    pixels = array(pixels, "pixels", (len(points), 2))
    if len(points) < FEWEST:
        raise InspeError(f"pairs: {len(points)}, but a pose needs {FEWEST} or more")
    middle = points.mean(0)
    if np.linalg.svd(points - middle, compute_uv=False)[1] < 1e-6:
        raise InspeError("pairs: all points lie on one line; add some beside it")

    def off(center: np.ndarray, turn: np.ndarray) -> np.ndarray:
        x, y, z = ((points - center) @ turn).T  # ahead, left, up
        return (lens.pixels(np.column_stack([-y, -z, x])) - pixels).ravel()

    def fit(start: np.ndarray, first: np.ndarray, steps: int) -> _Fit:
        """From a place and a rotation on; x is a turn about the world's axes, and a shift."""

        def parts(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            turn = scipy.spatial.transform.Rotation.from_rotvec(x[:3]).as_matrix() @ first
            return start + (x[3:] if place is None else 0), turn

        x = np.zeros(6 if place is None else 3)
        how: dict[str, Any] = dict(loss="soft_l1", f_scale=robust, x_scale="jac", max_nfev=steps)
        found = scipy.optimize.least_squares(lambda x: off(*parts(x)), x, **how)
        return _Fit(found.cost, *parts(found.x), found.jac)

    starts = _starts(points, pixels, lens) if place is None else [array(place, "place", (3,))]
    looks = [_looking(start, middle) for start in starts]
    best = min((fit(*one, ROUGH) for one in looks), key=lambda one: one.cost)
    best = fit(best.center, best.turn, FINE)
    if np.linalg.cond(best.slopes) > OPEN:
        raise InspeError("pairs: they leave the pose open; add some elsewhere, or give its place")
    count = best.slopes.shape[1]
    variance = 2 * best.cost / max(2 * len(points) - count, 1)
    own = np.linalg.inv(best.slopes.T @ best.slopes) * variance
    order = [*range(3, count), 0, 1, 2]
    covariance = np.zeros((6, 6))
    covariance[-count:, -count:] = own[np.ix_(order, order)]
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = best.turn, best.center
    pose = pose_of(matrix, "body", "sensor_to_world")
    return PoseFit(Pose(*pose.tolist()), off(best.center, best.turn).reshape(-1, 2), covariance)


class _Fit(NamedTuple):
    cost: float
    center: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3 3"]
    slopes: Float[np.ndarray, "K P"]


def _looking(start: np.ndarray, to: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A place, and the rotation with which it looks at a point."""
    way = to - start
    pitch, yaw = np.arctan2(way[2], np.hypot(*way[:2])), np.arctan2(way[1], way[0])
    return start, rotation(np.array([0.0, pitch, yaw]), np)


def _starts(points: np.ndarray, pixels: np.ndarray, lens: Lens) -> list[np.ndarray]:
    """Places to look at the points from: rings about them, and above."""
    middle, top = points.mean(0), points[:, 2].max()
    spread = np.linalg.norm(points - middle, axis=1).mean()
    seen = np.linalg.norm(pixels - pixels.mean(0), axis=1).mean()
    away = lens.fx * spread / max(seen, 1.0)
    ring = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    starts = [
        middle + [k * away * np.cos(a), k * away * np.sin(a), top - middle[2] + HEIGHTS[0]]
        for k in SPREADS
        for a in ring
    ]
    above = [[0.3 * np.cos(a), 0.3 * np.sin(a), h] for h in HEIGHTS for a in ring]
    return starts + [middle + one for one in above]
