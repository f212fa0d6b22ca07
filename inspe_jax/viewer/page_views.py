"""What a report page shows that needs more than figures: a photograph, and the scene to turn. The
photograph is the recorder's, from above, with the sensors marked on it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from inspe_jax.core.errors import InspeError
from inspe_jax.core.geometry import pixels
from inspe_jax.core.sheet import house_style
from inspe_jax.report.figures import SENSOR_COLORS
from inspe_jax.report.outlines import clear_outlines
from inspe_jax.report.page import PageViews
from inspe_jax.scene.scene import Scene
from inspe_jax.scoring.viewshed import Visibility, sight_in
from inspe_jax.sensing.conditions import FAIR, Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec
from inspe_jax.simulation.embedded.recorder import simulated_sensor
from inspe_jax.simulation.embedded.surroundings import Surroundings
from inspe_jax.simulation.frame import Image
from inspe_jax.viewer.scene3d import Scene3D, look_from
from inspe_jax.viewer.server import new_token, quiet, serve

WIDTH, HEIGHT, DOTS = 1200, 660, 170  # of the picture [pixels], and how many of them an inch has
FOCAL = 0.72  # focal length of the camera, in widths of the picture
BACK, UP, BEYOND = 1.25, 0.95, 0.12
"""Where the camera is, south of the middle and above it, and where it looks, south of the middle:
in radii of the region of interest, or more where a sensor would be outside of the picture."""
RIM = 20  # every sensor is so far inside the picture, and twice as far from its top [pixels]
NEAR = 1.0  # lines are cut where they come closer to the plane of the camera than this [m]


class _Eye(NamedTuple):
    """The camera: its world pose, and its calibration in pixels."""

    pose: Float[np.ndarray, "6"]
    intrinsic: Float[np.ndarray, "3 3"]


def still_view(scene: Scene, layout: Layout, frame: int = 0) -> Figure | None:
    """A layout in its place at midday, from the south and above, with the road users of a frame,
    what each sensor looks at, and numbers at the units' highest sensors; None without Embree."""
    eye = _eye_on(scene, layout)
    (focal, _, middle), (_, _, row), _ = eye.intrinsic
    spec = CameraSpec("still", WIDTH, HEIGHT, focal, (middle, row), 1.0, 1000.0)
    try:
        around = Surroundings(scene, layout, FAIR)
    except InspeError:
        return None
    camera = simulated_sensor(spec, eye.pose, around)
    picture = camera.record(around.actors(frame), np.random.default_rng(0))
    assert isinstance(picture, Image)
    return _marked(picture, scene, layout, eye)


def _eye_on(scene: Scene, layout: Layout) -> _Eye:
    """The camera, farther off than :data:`BACK` and :data:`UP` say if a sensor would be outside."""
    at, size = np.asarray(layout.poses, float)[:, :3], scene.voxels.radius
    down = np.arctan2(UP, BACK - BEYOND)
    focal = FOCAL * WIDTH
    intrinsic = np.array([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
    while True:
        place = scene.voxels.center + size * np.array([0.0, -BACK, UP])
        eye = _Eye(np.array([*place, 0.0, -down, np.pi / 2]), intrinsic)
        column, row, depth = pixels(eye, at).T
        across = abs(column - WIDTH / 2) < WIDTH / 2 - RIM
        if (across & (row > 2 * RIM) & (row < HEIGHT - RIM) & (depth > NEAR)).all():
            return eye
        size *= 1.05


def _marked(picture: Image, scene: Scene, layout: Layout, eye: _Eye) -> Figure:
    poses, ground = np.asarray(layout.poses, float), scene.intersection.ground
    with house_style():
        fig = Figure(figsize=(WIDTH / DOTS, HEIGHT / DOTS))
        ax = fig.add_axes((0.0, 0.0, 1.0, 1.0))
        ax.imshow(picture.rgb, extent=(0, WIDTH, HEIGHT, 0), interpolation="none")
        ax.set(xlim=(0, WIDTH), ylim=(HEIGHT, 0))
        ax.axis("off")
        for sensor, pose in zip(layout.sensors, poses, strict=True):
            for line in clear_outlines(scene, sensor.spec, pose):
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
    """A unit's upright pole, level arms to dots at its sensors, their numbers above the highest."""
    hung = np.column_stack([np.tile(foot[:2], (len(at), 1)), at[:, 2]])  # where arms begin
    lines = [np.array([foot, hung[np.argmax(at[:, 2])]]), *np.stack([hung, at], 1)]
    drawn = [pixels(eye, line) for line in lines]
    if min(line[:, 2].min() for line in drawn) < NEAR:
        return
    for line in drawn:
        ax.plot(*line[:, :2].T, color="#202020", lw=1.2)
    dots = np.array([line[1] for line in drawn[1:]])
    ax.plot(*dots[:, :2].T, "o", ms=2.5, color="#202020")
    ax.annotate(
        words, tuple(dots[np.argmax(at[:, 2]), :2]), (0, 4), textcoords="offset points",
        ha="center", va="bottom", size=7,
        bbox=dict(boxstyle="round,pad=0.2", fc="white", ec="#202020", lw=0.5, alpha=0.9),
    )  # fmt: skip


def scene3d_page(scene: Scene, layout: Layout, conditions: Conditions, frame: int) -> str:
    """An HTML page with one frame of a scene and what a layout sees of it, to turn and zoom."""
    server = serve(0, new_token())  # nobody is told: the page is a file
    try:
        scene3d = Scene3D(server.scene, scene)
        scene3d.draw_users(frame)
        sight = sight_in(scene, layout, frame, conditions=conditions)
        scene3d.draw_voxels(sight, (Visibility.HIDDEN, Visibility.OUT_OF_VIEW))
        scene3d.draw_layout(conditions.layout(layout))
        look_from(server.initial_camera, scene)
        return server.scene.as_html()
    finally:
        with quiet():
            server.stop()


VIEWS = PageViews(still_view, scene3d_page)
