"""A picture of a layout in its place, from above: the recorder's, with the sensors marked on it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from inspe_jax.core.errors import InspeError
from inspe_jax.report.figures import SENSOR_COLORS
from inspe_jax.report.outlines import view_outline
from inspe_jax.report.sheet import house_style
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.conditions import FAIR
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec
from inspe_jax.simulation.embedded.sensors import simulated_sensor
from inspe_jax.simulation.embedded.surroundings import surroundings_of
from inspe_jax.simulation.frame import Image
from inspe_jax.simulation.projection import pixels
from inspe_jax.simulation.recorder import Recording

WIDTH, HEIGHT, DOTS = 1200, 660, 170
"""Of the picture [pixels], and how many of them an inch has."""
FOCAL = 0.72
"""Focal length of the camera, in widths of the picture."""
BACK, UP, BEYOND = 1.25, 0.95, 0.12
"""Where the camera is, south of the middle and above it, and where it looks, south of the middle:
in half-widths of what is shown."""
HIGH = 3.5
"""A sensor that is a metre higher is shown like one so much farther from the middle [m]."""
NEAR = 1.0
"""Lines are cut where they come closer to the plane of the camera than this [m]."""


class _Eye(NamedTuple):
    """The camera: its world pose, and its calibration in pixels."""

    pose: Float[np.ndarray, "6"]
    intrinsic: Float[np.ndarray, "3 3"]


def still_view(scene: Scene, layout: Layout, *, frame: int = 0) -> Figure | None:
    """A layout in its place, from the south and above, with the road users of a frame.

    Lines show what each sensor looks at, numbers stand at the units' highest sensors. It is midday,
    whatever the conditions that are scored. ``layout`` has the reach that sensors have in those.
    None where Embree is missing.
    """
    radius, center = size_of(scene, layout), scene.voxels.center
    down = np.arctan2(UP, BACK - BEYOND)
    at = center + radius * np.array([0.0, -BACK, UP])
    pose = np.array([*at, 0.0, -down, np.pi / 2])
    focal, middle = FOCAL * WIDTH, (WIDTH / 2, HEIGHT / 2)
    spec = CameraSpec("still", WIDTH, HEIGHT, focal, middle, 1.0, 10 * radius, 1.0)
    try:
        around = surroundings_of(scene, layout, FAIR, Recording(), 0)
    except InspeError:
        return None
    camera = simulated_sensor(spec, pose, around)
    picture = camera.record(around.actors(frame), np.random.default_rng(0))
    assert isinstance(picture, Image)
    return _marked(picture, scene, layout, _Eye(pose, picture.intrinsic))


def size_of(scene: Scene, layout: Layout) -> float:
    """Half of what the picture has to show across [m]: the region of interest, and all sensors."""
    away = np.asarray(layout.poses, float)[:, :3] - scene.voxels.center
    return float(max(scene.voxels.radius, *np.hypot(*away[:, :2].T), *(HIGH * away[:, 2])))


def _marked(picture: Image, scene: Scene, layout: Layout, eye: _Eye) -> Figure:
    poses, ground = np.asarray(layout.poses, float), scene.intersection.ground
    with house_style():
        fig = Figure(figsize=(WIDTH / DOTS, HEIGHT / DOTS))
        ax = fig.add_axes((0.0, 0.0, 1.0, 1.0))
        ax.imshow(picture.rgb, extent=(0, WIDTH, HEIGHT, 0), interpolation="none")
        ax.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
        ax.axis("off")
        for sensor, pose in zip(layout.sensors, poses, strict=True):
            level = float(ground(pose[None, :2])[0])
            line = view_outline(sensor.spec, pose, level)
            there = pixels(eye, np.column_stack([line, ground(line) + 0.1]))
            there[there[:, 2] < NEAR] = np.nan
            color = SENSOR_COLORS[sensor.spec.kind]
            ax.plot(*there[:, :2].T, color=color, lw=0.9, alpha=0.85)
        for unit, members in zip(layout.units, layout.members(), strict=True):
            if members:
                words = "  ".join(str(s + 1) for s in members)
                _label_unit(ax, eye, unit.base, poses[list(members), :3], words)
    return fig


def _label_unit(
    ax: Axes, eye: _Eye, foot: tuple[float, float, float], at: Float[np.ndarray, "M 3"], words: str
) -> None:
    """A unit's pole, dots at its sensors, and their numbers above it."""
    pole = pixels(eye, np.array([foot, at[np.argmax(at[:, 2])]]))
    dots = pixels(eye, at)
    if min(pole[:, 2].min(), dots[:, 2].min()) < NEAR:
        return
    ax.plot(*pole[:, :2].T, color="#202020", lw=1.2)
    ax.plot(*dots[:, :2].T, "o", ms=2.5, color="#202020")
    ax.annotate(
        words, tuple(pole[1, :2]), (0, 4), textcoords="offset points", ha="center", va="bottom",
        size=7, bbox=dict(boxstyle="round,pad=0.2", fc="white", ec="#202020", lw=0.5, alpha=0.9),
    )  # fmt: skip
