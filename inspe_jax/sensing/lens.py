"""Lenses of cameras: from camera matrices and projections, and what they show.

Brown's distortion as in OpenCV; fisheyes are equidistant, r = f θ.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import rq

from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.rigid import array

NEAR = 0.05  # least depth that is projected [m]
SKEW = 1e-3  # less, in focal lengths, is rounding


class Lens(NamedTuple):
    """Intrinsics [px]; ``distortion`` is OpenCV's k1, k2, p1, p2, k3."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fisheye: bool = False

    def pixels(self, optical: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
        """Pixels of points in the camera's optical axes [m]; what is behind is far off.

        >>> lens = inspe_jax.Lens(1000.0, 1000.0, 960.0, 540.0)
        >>> lens.pixels(np.array([[1.0, 0.5, 10.0]])).tolist()  # right, down, ahead
        [[1060.0, 590.0]]
        """
        x, y, z = optical.T
        if self.fisheye:
            off = np.maximum(np.hypot(x, y), 1e-12)
            a, b = np.arctan2(off, z) / off * (x, y)
        else:
            a, b = np.array([x, y]) / np.maximum(z, NEAR)
        k1, k2, p1, p2, k3 = (*self.distortion, *[0.0] * 5)[:5]
        r = a * a + b * b
        radial = 1 + r * (k1 + r * (k2 + r * k3))
        u = a * radial + 2 * p1 * a * b + p2 * (r + 2 * a * a)
        v = b * radial + p1 * (r + 2 * b * b) + 2 * p2 * a * b
        return np.column_stack([self.fx * u + self.cx, self.fy * v + self.cy])


def lens_of(given: Any, where: str, notes: list[str], distortion: Any = ()) -> Lens:
    """The lens of a camera matrix (3, 3), or (3, 4) of a rectified camera. Raises InspeError where
    it is no upper triangle with positive focal lengths."""
    found = array(given, where, (3, 3), (3, 4))[:, :3]
    if np.abs(found[[1, 2, 2], [0, 0, 1]]).max() > 1e-9 * np.abs(found).max():
        raise InspeError(
            f"{where}: is no camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: below its "
            "diagonal there are numbers, so that a rotation is mixed in; give its product with "
            "the extrinsics, a 3 × 4 'projection', in place of both"
        )
    if (np.diag(found) <= 0).any():
        raise InspeError(f"{where}: a focal length is not positive: the picture is mirrored")
    found = found / found[2, 2]
    if abs(found[0, 1]) > SKEW * found[0, 0]:
        notes.append(f"{where}: its skew of {found[0, 1]:.1f} px is left out")
    with error_at(f"{where}, its distortion", TypeError, ValueError, KeyError):
        bent = distortion["data"] if isinstance(distortion, dict) else distortion or ()
        bent = tuple(np.array(bent, float).ravel().tolist())
    if any(bent):
        notes.append(f"{where}: its distortion is left out: layouts have pinhole cameras")
    (fx, _, cx), (_, fy, cy), _ = found.tolist()
    return Lens(fx, fy, cx, cy, bent)


def split_projection(
    given: Any, where: str, notes: list[str]
) -> tuple[Lens, Float[np.ndarray, "4 4"]]:
    """Lens, and matrix from the optical axes to the frame, of a projection P = K R [I | −C] (3, 4),
    by RQ decomposition (Hartley and Zisserman, *Multiple View Geometry*, section 6.2.4). Raises
    InspeError where it is singular or mirrored."""
    found = array(given, where, (3, 4))
    square, matrix = found[:, :3], np.eye(4)
    if np.linalg.cond(square) > 1e9:
        raise InspeError(f"{where}: is singular: no pinhole camera projects so")
    if np.linalg.det(square) < 0:
        raise InspeError(
            f"{where}: is mirrored: the determinant of its first three columns is negative; if it "
            "gives points before the camera a negative depth, multiply it by −1; if its frame is "
            "left-handed, as CARLA's, flip the sign of its second column"
        )
    triangle, turn = rq(square)
    signs = np.diag(np.sign(np.diag(triangle)))
    matrix[:3, :3] = (signs @ turn).T
    matrix[:3, 3] = -np.linalg.solve(square, found[:, 3])
    return lens_of(np.triu(triangle @ signs), where, notes), matrix
