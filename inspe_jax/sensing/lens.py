"""Lenses of cameras: what they project where and back, and the matrices that calibrations have.

A point ahead of the camera is first put on a plane, along its direction from the axis: as far out
as the tangent of its angle to the axis, or, by a fisheye, as the angle itself (equidistant,
r = f θ). Distortion then bends the plane: OpenCV's, by Brown with its rational part, or of a
fisheye by its polynomial in the angle. Focal lengths and the principal point give pixels. What
scores, records and solves goes through :func:`project` and :func:`unbend`, in NumPy or JAX.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Bool, Float

from inspe_jax.core.errors import InspeError, error_at
from inspe_jax.core.numerics import arctan2
from inspe_jax.core.rigid import array

SKEW = 1e-3  # less, in focal lengths, is rounding
STEPS = 8
"""Of Newton's iteration for a bent point: enough for 1e-9 where distortion is as strong as lenses
have it, and checked on a picture's rim."""
ASIDE = np.arctan(20.0)  # of a pinhole without a picture, points farther off the axis are far off
CIRCLE = np.pi  # across the image circle of a fisheye of which nothing else is said [rad]
_ON_AXIS = 1e-6  # least distance from the axis on which a direction away from it is known [m]
_STEP = 1e-3  # of differences
_EXACT = 1e-9  # largest error of a point that is bent back
FOLDS = (
    "distortion: folds the picture, which shows some directions twice: the calibration does not "
    "hold so far off the axis; give the image_circle_deg within which it does, or crop the picture"
)

Plane = tuple[Any, Any]
"""Right and down of a point of the plane, or of the picture over the focal lengths."""


def bend(a: Any, b: Any, coefficients: Any) -> tuple[Plane, tuple[Any, Any, Any]]:
    """Where distortion moves a point of the plane, and its slopes du/da, du/db = dv/da, dv/db.

    With ρ = a² + b², the radial factor is (1 + n₁ρ + n₂ρ² + n₃ρ³ + n₄ρ⁴) / (1 + d₁ρ + d₂ρ² + d₃ρ³),
    and u = a · radial + 2 p₁ab + p₂(ρ + 2a²), v = b · radial + p₁(ρ + 2b²) + 2 p₂ab.
    ``coefficients`` are n₁ … n₄, p₁, p₂, d₁ … d₃, as :attr:`Lens.coefficients` has them.
    """
    n1, n2, n3, n4, p1, p2, d1, d2, d3 = (coefficients[k] for k in range(9))
    r = a * a + b * b
    below = 1 + r * (d1 + r * (d2 + r * d3))
    radial = (1 + r * (n1 + r * (n2 + r * (n3 + r * n4)))) / below
    grows = (
        n1 + r * (2 * n2 + r * (3 * n3 + r * 4 * n4)) - radial * (d1 + r * (2 * d2 + r * 3 * d3))
    )
    twice = 2 * grows / below
    u = a * radial + 2 * p1 * a * b + p2 * (r + 2 * a * a)
    v = b * radial + p1 * (r + 2 * b * b) + 2 * p2 * a * b
    across = a * b * twice + 2 * p1 * a + 2 * p2 * b
    along = radial + a * a * twice + 2 * p1 * b + 6 * p2 * a
    down = radial + b * b * twice + 6 * p1 * b + 2 * p2 * a
    return (u, v), (along, across, down)


def unbend(u: Any, v: Any, coefficients: Any, xp: Any = np) -> Plane:
    """The point of the plane that :func:`bend` moves to (u, v)."""

    def nearer(_: Any, plane: Plane) -> Plane:
        (a, b), (at, (along, across, down)) = plane, bend(*plane, coefficients)
        x, y, area = u - at[0], v - at[1], along * down - across * across
        return a + (down * x - across * y) / area, b + (along * y - across * x) / area

    if xp is np and not np.any(coefficients[:9]):
        return u, v
    if xp is jnp:  # a loop, because unrolled each step would be compiled
        return jax.lax.fori_loop(0, STEPS, nearer, (u, v))
    return functools.reduce(lambda plane, k: nearer(k, plane), range(STEPS), (u, v))


def ray(
    u: Any, v: Any, coefficients: Any, fisheye: bool, circle: Any, xp: Any = np
) -> tuple[Any, Any, Any]:
    """Unit direction, right, down and ahead, of what a lens shows at a point of the picture; from
    beyond the radius ``circle`` on, of the circle's rim there."""
    inside = xp.minimum(1.0, circle / xp.sqrt(xp.maximum(u * u + v * v, _ON_AXIS**2)))
    a, b = unbend(u * inside, v * inside, coefficients, xp)
    if not fisheye:
        ahead = 1.0 / xp.sqrt(1.0 + a * a + b * b)
        return a * ahead, b * ahead, ahead
    angle = xp.sqrt(xp.maximum(a * a + b * b, _ON_AXIS**2))
    out = xp.sin(angle) / angle
    return a * out, b * out, xp.cos(angle)


def project(
    right: Any, down: Any, ahead: Any, coefficients: Any, fisheye: bool, far: Any, xp: Any = np
) -> Plane:
    """Where a lens shows points, over the focal lengths.

    Beyond the angle ``far`` to the axis [rad], where the polynomials mean nothing, it is that at
    ``far``, and further out by as many times as the angle is larger in radians.
    """
    off = xp.sqrt(xp.maximum(right * right + down * down, _ON_AXIS**2))
    angle = (np.arctan2 if xp is np else arctan2)(off, ahead)
    within = xp.minimum(angle, far)
    out = (within if fisheye else xp.tan(within)) / off
    (u, v), _ = bend(right * out, down * out, coefficients)
    return u * (1 + angle - within), v * (1 + angle - within)


class Lens(NamedTuple):
    """Intrinsics [px] of a camera; ``distortion`` is OpenCV's: k1, k2, p1, p2, k3, k4, k5, k6, or
    k1 … k4 of a ``fisheye``; ``image_circle`` is the angle across what it shows at all [rad]."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    fisheye: bool = False
    image_circle: float | None = None

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Those of :func:`bend`. Raises InspeError where there are further ones."""
        known = 4 if self.fisheye else 8
        if any(self.distortion[known:]):
            of = "k1, k2, k3, k4 of a fisheye" if self.fisheye else "k1, k2, p1, p2, k3, k4, k5, k6"
            raise InspeError(f"distortion: only {of} are known; undistort the pictures")
        k = (*self.distortion, *[0.0] * 8)[:8]
        return (*k[:4], *[0.0] * 5) if self.fisheye else (*k[:2], k[4], 0.0, *k[2:4], *k[5:])

    def pixels(self, optical: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
        """Pixels of points in the camera's optical axes [m]; what is behind is far off.

        >>> lens = inspe_jax.Lens(1000.0, 1000.0, 960.0, 540.0)
        >>> lens.pixels(np.array([[1.0, 0.5, 10.0]])).tolist()  # right, down, ahead
        [[1060.0, 590.0]]
        """
        far = np.pi if self.fisheye else ASIDE
        right, down, ahead = np.asarray(optical, float).T
        behind = (ahead < 0) & (np.hypot(right, down) < _ON_AXIS)  # the way off the axis is lost
        right = np.where(behind, _ON_AXIS, right)
        u, v = project(right, down, ahead, self.coefficients, self.fisheye, far)
        return np.column_stack([self.fx * u + self.cx, self.fy * v + self.cy])

    def rays(self, pixels: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
        """Unit directions, in body axes, of what pixels show: of those beyond the image circle,
        its rim."""
        u, v = ((np.asarray(pixels) - [self.cx, self.cy]) / [self.fx, self.fy]).T
        right, down, ahead = ray(u, v, self.coefficients, self.fisheye, self.circle)
        return np.column_stack([ahead, -right, -down])

    def beyond_circle(self, pixels: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
        """Which pixels are beyond the image circle, and black."""
        u, v = ((np.asarray(pixels) - [self.cx, self.cy]) / [self.fx, self.fy]).T
        return np.hypot(u, v) > self.circle

    @property
    def circle(self) -> float:
        """Radius of the image circle over the focal lengths; infinite without one. Raises
        InspeError where distortion folds the picture within it."""
        across = self.image_circle or (CIRCLE if self.fisheye else None)
        if across is None:
            return np.inf
        if not self.fisheye and across >= np.pi:
            raise InspeError("image_circle_deg: only a 'lens: fisheye' sees 180° or more")
        end = across / 2 if self.fisheye else np.tan(across / 2)
        coefficients = (*self.coefficients[:4], 0.0, 0.0, *self.coefficients[6:])
        (out, _), (slope, *_) = bend(np.linspace(0.0, end, 64), np.zeros(64), coefficients)
        if (slope <= 0).any():
            raise InspeError(FOLDS)
        return float(out[-1])

    def table(self, width: float, height: float) -> tuple[float, ...]:
        """What rays need of a lens with a picture of so many pixels: its coefficients; the radius
        of the image circle; the greatest angle to the axis of what is shown; and how much a row or
        a column bends, the largest second derivative of its coordinate by the direction.

        Raises InspeError where distortion folds the picture: where one of its points is shown
        twice.
        """
        u, v = ((rim(width, height) - [self.cx, self.cy]) / [self.fx, self.fy]).T
        coefficients, out = self.coefficients, np.hypot(u, v)
        circle = min(self.circle, float(out.max()))
        inside = np.minimum(1.0, circle / np.maximum(out, _ON_AXIS))
        u, v = u * inside, v * inside
        with np.errstate(all="ignore"):
            a, b = unbend(u, v, coefficients)
            at, _ = bend(a, b, coefficients)
            part = np.linspace(0.0, 1.0, 33)[:, None]
            _, (along, across, down) = bend(part * a, part * b, coefficients)
            exact = np.abs(np.subtract(at, (u, v))).max() < _EXACT
        if not (exact and (along * down > across * across).all() and (along > 0).all()):
            raise InspeError(FOLDS)
        far = np.hypot(a, b).max()
        far = float(far if self.fisheye else np.arctan(far))
        return (*coefficients, circle, far, self._bending(far))

    def _bending(self, far: float) -> float:
        """The largest second derivative, by differences all over the cone of view, and half more
        for what lies between them."""
        angle, around = np.meshgrid(np.linspace(0.01, far, 25), np.linspace(0, 2 * np.pi, 48))
        aside = np.sin(angle) * [np.cos(around), np.sin(around)]
        at = np.stack([*aside, np.cos(angle)]).reshape(3, -1)
        steps = np.array(list(np.ndindex(3, 3, 3))[14:], float) - 1  # half of the 26 ways
        steps *= _STEP / np.linalg.norm(steps, axis=1)[:, None]

        def seen(points: np.ndarray) -> np.ndarray:
            right, down, ahead = points
            return np.array(project(right, down, ahead, self.coefficients, self.fisheye, np.pi))

        bends = [
            seen(at + step[:, None]) - 2 * seen(at) + seen(at - step[:, None]) for step in steps
        ]
        return 1.5 * float(np.abs(bends).max()) / _STEP**2


def rim(width: float, height: float) -> Float[np.ndarray, "N 2"]:
    """Points all along the edge of a picture [px]."""
    side = np.linspace(0.0, 1.0, 65)
    ends = [np.column_stack([side, 0 * side + end]) for end in (0, 1)]
    return np.concatenate([way for end in ends for way in (end, end[:, ::-1])]) * [width, height]


def focal_of(side: int, fov_deg: float, unit: Lens | None = None, axis: int = 0) -> float:
    """The focal length [px] with which a picture of so many pixels along a row (``axis`` 0) or down
    a column (1) shows a field of view [degrees]; of a lens that bends, by the same lens with a
    focal length of 1."""
    half = np.radians(fov_deg) / 2
    if unit is None or not (unit.fisheye or unit.distortion):
        return float(side / 2 / np.tan(half))
    edge = np.array([[np.sin(half), 0.0, np.cos(half)]])[:, [axis, 1 - axis, 2]]
    return float(side / 2 / unit.pixels(edge)[0, axis])


def distortion_of(given: Any) -> tuple[float, ...]:
    """Coefficients as OpenCV has them, also as an array of one row or one column, or as a file's
    mapping with ``data``. Raises InspeError where they are no numbers."""
    with error_at("must be numbers", TypeError, ValueError, KeyError):
        found = given["data"] if isinstance(given, dict) else given
        return tuple(np.array(() if found is None else found, float).ravel().tolist())


def lens_of(
    given: Any, where: str, notes: list[str], distortion: Any = (), fisheye: bool = False
) -> Lens:
    """The lens of a camera matrix (3, 3), or (3, 4) of a rectified camera. Raises InspeError where
    it is no upper triangle with positive focal lengths, or the distortion has unknown terms."""
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
    with error_at(f"{where}, its distortion"):
        bent = distortion_of(distortion)
    (fx, _, cx), (_, fy, cy), _ = found.tolist()
    lens = Lens(fx, fy, cx, cy, bent if any(bent) else (), fisheye)
    with error_at(where):
        lens.coefficients  # noqa: B018
    return lens


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
    triangle, turn = scipy.linalg.rq(square)
    signs = np.diag(np.sign(np.diag(triangle)))
    matrix[:3, :3] = (signs @ turn).T
    matrix[:3, 3] = -np.linalg.solve(square, found[:, 3])
    return lens_of(np.triu(triangle @ signs), where, notes), matrix
