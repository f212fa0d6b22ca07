"""Lines as arrays of points (N, 2 or 3) [m], measured in plan."""

import numpy as np
from jaxtyping import Float


def turned(line: Float[np.ndarray, "N 2"], angle: float) -> Float[np.ndarray, "N 2"]:
    """A line turned about the origin by ``angle`` [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    return line @ np.array([[c, s], [-s, c]])


def arc_of(line: np.ndarray) -> Float[np.ndarray, " N"]:
    """How far along the line each point is [m]."""
    steps = np.hypot(*np.diff(line[:, :2], axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def resampled(line: np.ndarray, spacing: float = 1.0) -> np.ndarray:
    """The same line with evenly spaced points, about ``spacing`` metres apart in plan."""
    arc = arc_of(line)
    even = np.linspace(0, arc[-1], max(2, round(arc[-1] / spacing) + 1))
    return np.column_stack([np.interp(even, arc, column) for column in line.T])


def distinct(line: np.ndarray) -> np.ndarray:
    """A line without points that repeat the one before."""
    apart = np.hypot(*np.diff(line[:, :2], axis=0).T) > 1e-6
    return line[np.concatenate([[True], apart])]
