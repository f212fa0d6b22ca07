"""The points that a picture shows, found by where they are in plan; shadows that fall on them."""

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import minimum_filter

LONGEST = 200.0
"""Longest shadow of anything [m]."""
ASIDE = 10.0
"""No road user reaches further from its centre in plan [m]: road trains are 18.75 m long."""


class SunlitPoints:
    """Those of R points that are in the sun (``lit``), sorted by the square metre of the plan they
    lie in.

    ``reach`` is the distance from the centre, along x and y, up to which points count [m].
    """

    def __init__(self, point: np.ndarray, lit: np.ndarray, reach: float) -> None:
        self.reach, self.size = reach, int(2 * reach)
        x, y = np.abs(point[:, :2].T)
        pixels = np.flatnonzero(lit & (x < reach) & (y < reach))
        cell = np.floor(point[pixels, :2] + reach).astype(int)
        cell = np.minimum(cell, self.size - 1)  # float32 sums may round up to the rim
        number = cell[:, 1] * self.size + cell[:, 0]
        order = np.argsort(number, kind="stable")
        self.pixels = pixels[order]
        self.start = np.searchsorted(number[order], np.arange(self.size**2 + 1))
        lowest = np.full(self.size**2, np.inf, np.float32)
        np.minimum.at(lowest, number, point[pixels, 2])
        square = lowest.reshape(self.size, self.size)
        around = 2 * (int(ASIDE) + 1) + 1  # one metre more, which is the step in ``ends``
        self._lowest = minimum_filter(square, around, mode="constant", cval=np.inf)

    def within(self, low: np.ndarray, high: np.ndarray) -> Int[np.ndarray, " P"]:
        """Pixels of the points in the squares that the rectangle ``low`` to ``high`` touches."""
        x0, y0 = np.clip(np.floor(low + self.reach), 0, self.size - 1).astype(int)
        x1, y1 = np.clip(np.floor(high + self.reach), 0, self.size - 1).astype(int)
        rows = np.arange(y0, y1 + 1) * self.size
        runs = zip(self.start[rows + x0], self.start[rows + x1 + 1], strict=True)
        return np.concatenate([self.pixels[a:b] for a, b in runs])

    def ends(
        self, top: Float[np.ndarray, "B 3"], along: Float[np.ndarray, "3"]
    ) -> Float[np.ndarray, " B"]:
        """How far in plan shadows of points ``top`` reach along a direction that points down [m].

        A shadow ends where no sunlit point is below its upper edge any more. On ground that falls
        in this direction it is longer than on level ground.
        """
        far = np.arange(0, LONGEST)
        unit = along / np.hypot(*along[:2])
        at = top[:, None] + far[:, None] * unit
        x, y = np.moveaxis(np.floor(at[..., :2] + self.reach).astype(int), -1, 0)
        here = (np.minimum(x, y) >= -ASIDE) & (np.maximum(x, y) < self.size + ASIDE)
        x, y = np.clip((x, y), 0, self.size - 1)
        beneath = here & (self._lowest[y, x] < at[..., 2])
        return np.where(beneath, far + 1, 0).max(-1)
