"""A scene in three dimensions: ground, lanes, road users, sensors, voxels and what hides them.

Drawn with viser, for a browser. World metres about the scene's centre, since graphics cards work in
single precision.
"""

import io
from collections.abc import Mapping
from contextlib import redirect_stdout
from typing import Any

import numpy as np
import viser
from jaxtyping import Float, Int
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

from inspe_jax.geometry import rotation
from inspe_jax.report.figures import SENSOR_COLORS, view_outline
from inspe_jax.report.layers import SIGHT_COLORS
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.traffic import CLASSES
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec, Spec
from inspe_jax.viewshed import Sight, sight_in

GROUND_COLORS: dict[Region, str] = dict(
    zip(Region, ("#8c8f94", "#7c7f85", "#e6e6e6", "#c3c0b8", "#a3a59f"), strict=True)
)
"""Greys, as of asphalt and paving: colours are for what is seen and by whom."""
USER_COLOR = "#fafafa"
OPACITY = {Sight.OUT_OF_VIEW: 0.45, Sight.HIDDEN: 0.6, Sight.SEEN: 0.12}
"""Of the voxels that are drawn."""
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""A camera's frame in the body's: right, down and forward are −y, −z and x."""
LIFT = 0.05
"""Lines on the ground are drawn so much above it [m]."""

_BOX = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    + [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)


class Stage:
    """A scene on a viser server: what stands still is drawn at once, the rest when it is told."""

    def __init__(self, api: viser.SceneApi, scene: Scene) -> None:
        """Draw the ground and the lanes."""
        self.api, self.scene = api, scene
        self.shift = scene.voxels.center
        self.drawn: dict[str, Any] = {}
        api.set_up_direction("+z")
        api.configure_environment_map(None)
        api.configure_fog(1e6, 1e7)
        api.configure_default_lights(enabled=False)
        api.add_light_ambient("light/sky", intensity=1.0)
        api.add_light_directional("light/sun", intensity=1.0, position=(-60.0, -100.0, 200.0))
        self._draw_ground()
        self._draw_lanes()

    def draw_users(self, frame: int) -> None:
        """The road users of one frame as boxes, white as on the maps."""
        traffic = self.scene.traffic
        for kind, name in enumerate(CLASSES):
            who = traffic.valid[frame] & (traffic.kind[frame] == kind)
            half = traffic.yaw[frame, who] / 2
            turn = np.column_stack([np.cos(half), 0 * half, 0 * half, np.sin(half)])
            center = traffic.center[frame, who] - self.shift
            self._boxes(f"road users/{name}", center, traffic.size[frame, who], USER_COLOR, turn)

    def draw_voxels(self, sight: Int[np.ndarray, " V"], shown: Mapping[Sight, bool]) -> None:
        """Voxels in the colour of what each is in a frame: see :class:`Sight`."""
        grid = self.scene.voxels
        by_column = np.asarray(sight).reshape(-1, grid.level_count)
        for kind, opacity in OPACITY.items():
            column, low, high = runs(by_column == kind)
            foot = grid.ground[column] + grid.size * low
            tall = grid.size * (high - low)
            center = np.column_stack([grid.columns[column], foot + tall / 2]) - self.shift
            wide = np.full(len(column), 0.94 * grid.size)
            size = np.column_stack([wide, wide, tall])
            name = f"voxels/{kind.name.lower().replace('_', ' ')}"
            self._boxes(name, center, size, SIGHT_COLORS[kind], opacity=opacity)
            self.drawn[name].visible = shown.get(kind, False)

    def draw_layout(self, layout: Layout) -> None:
        """Every sensor with its number, on its pole, and what it looks at on the ground."""
        for name in [name for name in self.drawn if name.startswith("sensors/")]:
            self.drawn.pop(name).remove()
        for k, sensor in enumerate(layout.sensors):
            pose = np.asarray(layout.poses[k], float)
            self._draw_sensor(f"sensors/{k + 1}", sensor.spec, pose, str(k + 1))

    def _draw_sensor(self, name: str, spec: Spec, pose: Float[np.ndarray, "6"], word: str) -> None:
        color, at = rgb(SENSOR_COLORS[spec.kind]), pose[:3] - self.shift
        turn = rotation(pose[3:], np)
        if isinstance(spec, CameraSpec):
            self.drawn[f"{name}/device"] = self.api.add_camera_frustum(
                f"{name}/device",
                fov=2 * np.arctan(spec.height / 2 / spec.focal),
                aspect=spec.width / spec.height,
                scale=1.2,
                thickness=0.06,
                color=color,
                wxyz=quaternion(turn @ OPTICAL),
                position=at,
                variant="filled",
            )
        else:
            self.drawn[f"{name}/device"] = self.api.add_cylinder(
                f"{name}/device", 0.35, 0.6, color=color, wxyz=quaternion(turn), position=at
            )
        ground = float(self.scene.intersection.ground(pose[None, :2])[0]) - self.shift[2]
        pole = np.array([[[*at[:2], ground], at]])
        self._lines(f"{name}/pole", pole, "#404040", 0.08)
        outline = self._on_ground(view_outline(spec, pose))
        self._lines(f"{name}/view", segments(outline), SENSOR_COLORS[spec.kind], 0.12)
        ahead = 1.6 * turn[:, 0] if isinstance(spec, CameraSpec) else np.array([0.0, 0.0, 0.9])
        self.drawn[f"{name}/number"] = self.api.add_label(
            f"{name}/number", word, position=at + ahead, anchor="center-center"
        )

    def _draw_ground(self) -> None:
        """A mesh for each region, its corners on the ground."""
        grid = self.scene.voxels
        index = np.round((grid.columns - grid.center[:2]) / grid.size - 0.5).astype(int)
        for region, color in GROUND_COLORS.items():
            own = index[grid.region == region]
            if not len(own):
                continue
            corner = own[:, None] + [[0, 0], [1, 0], [1, 1], [0, 1]]  # (L, 4, 2)
            at, which = np.unique(corner.reshape(-1, 2), axis=0, return_inverse=True)
            points = self._on_ground(grid.center[:2] + grid.size * at, lift=0.0)
            square = which.reshape(-1, 4)
            faces = np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]])
            name = f"ground/{region.key}"
            self.drawn[name] = self.api.add_mesh_simple(
                name, points.astype(np.float32), faces.astype(np.uint32), color=rgb(color),
                side="double", cast_shadow=False,
            )  # fmt: skip

    def _draw_lanes(self) -> None:
        near = []
        for route in self.scene.intersection.routes:
            if route.user == "vehicle":
                line = route.waypoints - self.shift
                inside = np.hypot(*line[:, :2].T) <= self.scene.voxels.radius
                both = segments(line + [0, 0, LIFT])[inside[:-1] & inside[1:]]
                near.append(both)
        if near:
            self._lines("ground/lanes", np.concatenate(near), "#ffffff", 0.06)

    def _on_ground(self, xy: Float[np.ndarray, "N 2"], lift: float = LIFT) -> np.ndarray:
        z = self.scene.intersection.ground(np.asarray(xy, float))
        return np.column_stack([xy, z + lift]) - self.shift

    def _lines(self, name: str, ends: np.ndarray, color: str, wide: float) -> None:
        self.drawn[name] = self.api.add_line_segments(
            name, ends.astype(np.float32), colors=rgb(color), thickness=wide
        )

    def _boxes(
        self,
        name: str,
        center: np.ndarray,
        size: np.ndarray,
        color: str,
        turn: np.ndarray | None = None,
        opacity: float | None = None,
    ) -> None:
        """Boxes (N, 3) of sizes (N, 3) [m]."""
        if turn is None:
            turn = np.tile([1.0, 0.0, 0.0, 0.0], (len(center), 1))
        self.drawn[name] = self.api.add_batched_meshes_simple(
            name,
            _BOX.astype(np.float32),
            _FACES.astype(np.uint32),
            turn.astype(np.float32),
            center.astype(np.float32),
            batched_scales=size.astype(np.float32),
            batched_colors=rgb(color),
            opacity=opacity,
            lod="off",
            flat_shading=True,
            cast_shadow=opacity is None,
        )


def runs(flags: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Levels of a column that follow each other, of flags (L, Z): (column, first, one past)."""
    edges = np.diff(np.pad(flags.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    column, low = np.nonzero(edges == 1)
    return column, low, np.nonzero(edges == -1)[1]


def segments(line: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 2 3"]:
    """A line's pieces, each by its two ends."""
    return np.stack([line[:-1], line[1:]], 1)


def rgb(color: str) -> tuple[int, int, int]:
    """A colour's parts, 0 to 255."""
    red, green, blue = (round(255 * part) for part in to_rgb(color))
    return red, green, blue


def quaternion(turn: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """A rotation matrix as w, x, y, z."""
    return np.roll(Rotation.from_matrix(turn).as_quat(), 1)


def stage_page(scene: Scene, layout: Layout, conditions: Conditions, frame: int) -> str:
    """A page of its own: one frame of a scene, and what a layout sees of it, to turn and zoom."""
    with redirect_stdout(io.StringIO()):  # viser tells addresses that nobody needs here
        server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    try:
        stage = Stage(server.scene, scene)
        stage.draw_users(frame)
        sight = sight_in(scene, layout, frame, conditions=conditions)
        stage.draw_voxels(sight, {Sight.HIDDEN: True, Sight.OUT_OF_VIEW: True})
        stage.draw_layout(conditions.layout(layout))
        look_from(server.initial_camera, scene)
        return server.scene.as_html()
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()


def look_from(camera: Any, scene: Scene) -> None:
    """Let a camera see the whole of a scene from the south, from above."""
    radius = scene.voxels.radius
    camera.position = (0.0, -1.05 * radius, 0.95 * radius)
    camera.look_at = (0.0, -0.08 * radius, 0.0)
