"""Map layers of a scored layout, with a value for each column: how often it is seen, and others."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.viewshed import Viewshed, Visibility

HIDDEN = 0.5
"""A column is a blind spot if traffic hides it for more than this share of the time it is empty."""
CELL = 2.5
"""Side of the square about a column that maps show the mean of [m]: a few rays of a camera or a
LiDAR wide at the reach of most."""
BLIND = (
    ("seen", "#f2f2f2"),
    ("hidden by traffic\nmost of the time", "#e69f00"),
    ("in part out of view", "#8a8a8a"),
    ("never in view", "#202020"),
)
"""Kinds of columns with their colours: greys out of view, orange (Okabe and Ito) behind traffic."""
SIGHT_COLORS: dict[Visibility, str] = {
    Visibility.OUT_OF_VIEW: "#202020",
    Visibility.HIDDEN: "#e69f00",
    Visibility.SEEN: "#56b4e9",
}
"""Colours of voxels in one frame: the same, and sky blue for voxels that are seen."""

USER_COLOR = "#fafafa"


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class MapLayer:
    """A value for each column, NaN for none, and how it is shown: in the colour map ``colors`` from
    0 to ``most``; or each as the number of one of ``kinds``, pairs of a name and a colour. If
    ``averaged``, maps show the mean or the most frequent kind of squares as wide as :data:`CELL`:
    of single columns, rays that miss some voxels and hit their neighbours make rings."""

    label: str
    values: Float[np.ndarray, " L"]
    most: float = 1.0
    colors: str = "cividis"
    kinds: tuple[tuple[str, str], ...] = ()
    averaged: bool = False


def layers(scene: Scene, shed: Viewshed) -> dict[str, MapLayer]:
    """Every layer by its name, from the viewshed of a layout."""
    levels, cell = scene.voxels.level_count, cell_words(scene)
    exists = free_of_bodies(scene)
    number = exists.sum(1).astype(float)
    number[number == 0] = np.nan

    def mean(values: np.ndarray) -> np.ndarray:
        """The mean over the levels of each column that are in no body; NaN if there is none."""
        return (np.asarray(values, float).reshape(-1, levels) * exists).sum(1) / number

    return {
        "seen": seen_layer(mean(shed.seen) / shed.frame_count, scene),
        "blind": MapLayer(f"most of {cell} is", blind(scene, shed), kinds=BLIND, averaged=True),
        "redundancy": MapLayer(
            f"sensors that have it in view,\nmean over its levels,\nmean over {cell}",
            mean(shed.sensors),
            averaged=True,
            most=max(float((shed.sensors * exists.ravel()).max(initial=0)), 1.0),
            colors="viridis",
        ),
    }


def cell_rows(spacing: float) -> int:
    """How many rows of columns, so far apart [m], maps average: odd, about :data:`CELL` wide."""
    return max(1, 2 * round((CELL / spacing - 1) / 2) + 1)


def cell_words(scene: Scene) -> str:
    """The square that maps average, in words."""
    side = cell_rows(scene.voxels.spacing) * scene.voxels.spacing
    return f"{side:g} × {side:g} m"


def seen_layer(seen_share: Float[np.ndarray, " L"], scene: Scene) -> MapLayer:
    """How often each column is seen: :attr:`~inspe_jax.scoring.evaluate.Scores.seen_share`."""
    values, free = np.asarray(seen_share), free_of_bodies(scene).any(1)
    if values.shape == free.shape:  # else they are of another scene, which the map will say
        values = np.where(free, values, np.nan)
    label = f"share of frames and levels\nin which it is seen,\nmean over {cell_words(scene)}"
    return MapLayer(label, values, averaged=True)


def blind(scene: Scene, shed: Viewshed) -> Float[np.ndarray, " L"]:
    """The kind of each column, as its place in :data:`BLIND`; NaN inside a static body."""
    levels, exists = scene.voxels.level_count, free_of_bodies(scene)
    in_view = (shed.sensors > 0).reshape(-1, levels) & exists
    free = (shed.frame_count - shed.occupied).reshape(-1, levels) * in_view
    seen = (shed.seen.reshape(-1, levels) * exists).sum(1) / np.maximum(free.sum(1), 1)
    hidden = (free.sum(1) > 0) & (seen < 1.0 - HIDDEN)
    kinds = [~exists.any(1), ~in_view.any(1), ~(in_view | ~exists).all(1), hidden]
    return np.select(kinds, [np.nan, 3.0, 2.0, 1.0], 0.0)


def free_of_bodies(scene: Scene) -> Bool[np.ndarray, "L Z"]:
    """Whether each voxel is outside all static bodies."""
    if scene.inside_statics is None:
        return np.ones((len(scene.voxels.columns), scene.voxels.level_count), bool)
    return ~np.asarray(scene.inside_statics)
