"""A scene in three dimensions, drawn with viser, and what one browser has of its own in it.

Positions are in metres about the scene's centre, since graphics cards work in single precision.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import shapely
import viser
from jaxtyping import Bool, Float, Int
from matplotlib.colors import to_hex, to_rgb
from viser.transforms import SO3

from inspe_jax.core.geometry import rotation
from inspe_jax.core.rigid import CONVENTIONS
from inspe_jax.report.bodies import BODY_COLORS
from inspe_jax.report.figures import SENSOR_COLORS
from inspe_jax.report.layers import SIGHT_COLORS, USER_COLOR, free_of_bodies
from inspe_jax.report.outlines import view_outline
from inspe_jax.scene.regions import Region
from inspe_jax.scene.scene import Scene
from inspe_jax.scene.traffic.frames import CLASSES
from inspe_jax.scoring.viewshed import Visibility
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import CameraSpec, Spec
from inspe_jax.simulation.embedded.static_bodies import body_parts

GROUND_COLORS: dict[Region, str] = dict(
    zip(Region, ("#8c8f94", "#7c7f85", "#e6e6e6", "#c3c0b8", "#a3a59f"), strict=True)
)
"""Greys, such as those of asphalt and paving; colours are kept for voxels and sensors."""
BROKEN_COLOR = "#ff1744"
"""Colour of sensors that break a rule of mounting; their number has a ! beside it, too."""
OPTICAL = CONVENTIONS["optical"][1][:3, :3].T  # from a camera's optical axes to ours
OPACITY = 0.6  # opacity of hidden voxels
TINTS = {Visibility.OUT_OF_VIEW: 0.75, Visibility.SEEN: 0.45}
"""Share of a kind's own colour in the ground below columns of voxels that are mostly of it."""
MOUNTING_COLOR = "#303030"  # colour of the outlines of mounting areas, and of standing poles
POLE = 4.0  # height at which standing poles are drawn [m]
ABOVE = 0.8  # height of numbers above a unit's highest sensor [m]
CROWN = 0.5  # opacity of the crowns of trees
THIN = 0.12  # width of the outlines of what sensors look at [m]
LIFT = 0.05  # height of lines above the ground [m]
LENGTH = 90.0  # length of the handle's arrows [pixel]
WIDE = 0.4  # width of the outline of what a selected sensor looks at [m]
POINT_SIZE = 0.14  # of a LiDAR's points, which have the colour of LiDARs [m]

_BOX = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    + [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)


class Scene3D:
    """A scene on a viser server. The static parts are drawn at once, the rest by its methods."""

    def __init__(self, api: viser.SceneApi, scene: Scene) -> None:
        """Draw the ground, the lanes and the static bodies."""
        self.api, self.scene = api, scene
        self.shift, self._ground = scene.voxels.center, scene.intersection.ground
        self.drawn: dict[str, Any] = {}
        self._looks: dict[int, tuple[Spec, str]] = {}  # of the sensors that are drawn
        self._at: dict[int, Float[np.ndarray, 6]] = {}  # their poses
        api.set_up_direction("+z")
        api.configure_environment_map(None)
        api.configure_fog(1e6, 1e7, enabled=False)
        api.configure_default_lights(enabled=False)
        api.add_light_ambient("light/sky", intensity=1.0)
        api.add_light_directional("light/sun", intensity=1.0, position=(-60.0, -100.0, 200.0))
        for region, color in GROUND_COLORS.items():
            self._squares(f"ground/{region.key}", scene.voxels.region == region, color, 0.0)
        self._draw_lanes()
        self._draw_bodies()

    def draw_mounting(self) -> None:
        """Draw outlines of where units can stand, and the standing poles."""
        place, center = self.scene.intersection, self.shift[:2]
        radius = self.scene.voxels.radius
        within = place.mounting.intersection(shapely.Point(center).buffer(radius))
        rings = shapely.segmentize(shapely.get_rings(shapely.get_parts(within)), 2.0)
        lines = [segments(self._on_ground(shapely.get_coordinates(ring))) for ring in rings]
        at = self.scene.poles
        if len(at):
            feet = self._on_ground(at[:, :2], lift=0.0)
            lines.append(np.stack([feet, feet + [0, 0, POLE]], 1))
        if lines:
            self._lines("ground/mounting", np.concatenate(lines), MOUNTING_COLOR, 0.1)

    def draw_users(self, frame: int) -> None:
        """Draw the road users of one frame as boxes, white as on the maps."""
        traffic = self.scene.traffic
        for kind, name in enumerate(CLASSES):
            who = traffic.valid[frame] & (traffic.kind[frame] == kind)
            center, yaw = traffic.center[frame, who] - self.shift, traffic.yaw[frame, who]
            self._boxes(f"road users/{name}", center, traffic.size[frame, who], yaw, USER_COLOR)

    def draw_voxels(self, sight: Int[np.ndarray, " V"], shown: Iterable[Visibility]) -> None:
        """Draw the voxels of the kinds ``shown``, by the ``sight`` of each in a frame: hidden ones
        as boxes, others as ground in the tint of most voxels of a column."""
        free, wanted = free_of_bodies(self.scene), set(shown)
        kinds = np.where(free, np.asarray(sight).reshape(free.shape), -1)
        self._forget("voxels/")
        if Visibility.HIDDEN in wanted and (kinds == Visibility.HIDDEN).any():
            self._draw_hidden(kinds == Visibility.HIDDEN)
        for kind in wanted.intersection(TINTS):
            self._draw_tint(kind, kinds)

    def _draw_hidden(self, hidden: Bool[np.ndarray, "L Z"]) -> None:
        grid = self.scene.voxels
        column, low, high = runs(hidden)
        foot = grid.ground[column] + grid.spacing * low
        tall = grid.spacing * (high - low)
        center = np.column_stack([grid.columns[column], foot + tall / 2]) - self.shift
        wide = np.full(len(column), 0.94 * grid.spacing)
        size = np.column_stack([wide, wide, tall])
        color = SIGHT_COLORS[Visibility.HIDDEN]
        self._boxes("voxels/hidden", center, size, np.zeros(len(column)), color, OPACITY)

    def _draw_tint(self, kind: Visibility, kinds: Int[np.ndarray, "L Z"]) -> None:
        counts = np.stack([(kinds == other).sum(1) for other in Visibility])
        mostly = (counts.argmax(0) == kind) & (counts[kind] > 0)
        for region, ground in GROUND_COLORS.items():
            name = f"voxels/{kind.name.lower().replace('_', ' ')}/{region.key}"
            color = mixed(ground, SIGHT_COLORS[kind], TINTS[kind])
            self._squares(name, mostly & (self.scene.voxels.region == region), color, LIFT / 2)

    def draw_layout(self, layout: Layout, broken: Iterable[int] = ()) -> dict[int, Any]:
        """Draw every sensor on its pole, the outline of what it looks at, and its number; move what
        is drawn already. The ``broken`` sensors, which break a rule of mounting, are red. Returns
        the bodies of sensors that are new, by their place in the layout."""
        wrong, new = set(broken), {}
        looks = [
            (sensor.spec, BROKEN_COLOR if k in wrong else SENSOR_COLORS[sensor.spec.kind])
            for k, sensor in enumerate(layout.sensors)
        ]
        for k, look in list(self._looks.items()):
            if k >= len(looks) or look != looks[k]:
                self._forget(f"sensors/{k + 1}/")
                del self._looks[k], self._at[k]
        poses = np.asarray(layout.poses, float)
        for k, (spec, color) in enumerate(looks):
            if k not in self._looks:
                self._draw_sensor(k, spec, color)
                new[k], self._looks[k] = self.drawn[f"sensors/{k + 1}/device"], (spec, color)
            if k not in self._at or (self._at[k] != poses[k]).any():
                self._move_sensor(k, spec, poses[k])
                self._at[k] = poses[k].copy()
        self._number(layout, poses, wrong)
        return new

    def outline(self, k: int) -> tuple[Float[np.ndarray, "N 2 3"], str]:
        """The outline of what the sensor at place ``k`` looks at, as line segments about the
        scene's centre [m], and its colour."""
        return self.drawn[f"sensors/{k + 1}/view"].points, self._looks[k][1]

    def _draw_sensor(self, k: int, spec: Spec, color: str) -> None:
        name, body = f"sensors/{k + 1}", f"sensors/{k + 1}/device"
        if isinstance(spec, CameraSpec):
            self.drawn[body] = self.api.add_box(body, rgb(color), dimensions=(0.7, 0.5, 0.5))
            self.drawn[f"{name}/frustum"] = self.api.add_camera_frustum(
                f"{name}/frustum",
                fov=2 * np.arctan(spec.height / 2 / spec.focals[1]),
                aspect=spec.width / spec.height,
                scale=1.2,
                thickness=0.06,
                color=rgb(color),
            )
        else:
            self.drawn[body] = self.api.add_cylinder(body, 0.35, 0.6, color=rgb(color))
        nowhere = np.zeros((1, 2, 3))
        self._lines(f"{name}/pole", nowhere, "#404040", 0.08)
        self._lines(f"{name}/view", nowhere, color, THIN)

    def _move_sensor(self, k: int, spec: Spec, pose: Float[np.ndarray, "6"]) -> None:
        name, at, turn = f"sensors/{k + 1}", pose[:3] - self.shift, rotation(pose[3:], np)
        body = self.drawn[f"{name}/device"]
        body.position, body.wxyz = at, SO3.from_matrix(turn).wxyz
        if isinstance(spec, CameraSpec):
            frustum = self.drawn[f"{name}/frustum"]
            frustum.position, frustum.wxyz = at, SO3.from_matrix(turn @ OPTICAL).wxyz
        pole = np.array([[*self._on_ground(pose[None, :2], lift=0.0), at]])
        view = self._on_ground(view_outline(spec, pose, self._ground(pose[None, :2])[0]))
        self.drawn[f"{name}/pole"].points = pole.astype(np.float32)
        self.drawn[f"{name}/view"].points = segments(view).astype(np.float32)

    def _number(self, layout: Layout, poses: Float[np.ndarray, "S 6"], wrong: set[int]) -> None:
        """Draw the numbers of a unit's sensors as one label above it: several would overlap."""
        units = [members for members in layout.members() if members]
        for u, members in enumerate(units):
            word = "  ".join(f"{k + 1} !" if k in wrong else str(k + 1) for k in members)
            at = poses[list(members), :3]
            at = np.append(at[:, :2].mean(0), at[:, 2].max() + ABOVE) - self.shift
            name = f"numbers/{u + 1}"
            if name not in self.drawn:
                self.drawn[name] = self.api.add_label(name, word, anchor="bottom-center")
            self.drawn[name].text, self.drawn[name].position = word, at
        self._forget("numbers/", len(units))

    def _forget(self, prefix: str, kept: int = 0) -> None:
        """Remove what is drawn under names that begin like this, except the first so many."""
        for name in [name for name in self.drawn if name.startswith(prefix)][kept:]:
            self.drawn.pop(name).remove()

    @cached_property
    def _corners(self) -> tuple[Float[np.ndarray, "C 3"], Int[np.ndarray, "L 4"]]:
        """Corners of columns on the ground, and which of them each column has."""
        grid = self.scene.voxels
        index = np.round((grid.columns - grid.center[:2]) / grid.spacing - 0.5).astype(int)
        corner = index[:, None] + [[0, 0], [1, 0], [1, 1], [0, 1]]
        at, which = np.unique(corner.reshape(-1, 2), axis=0, return_inverse=True)
        points = self._on_ground(grid.center[:2] + grid.spacing * at, lift=0.0)
        return points, which.reshape(-1, 4)

    def _squares(self, name: str, own: np.ndarray, color: str, lift: float) -> None:
        """Draw the squares of some columns (L,) so high above the ground [m], as one mesh."""
        if not own.any():
            return
        points, corners = self._corners
        used, which = np.unique(corners[own], return_inverse=True)
        square = which.reshape(-1, 4)
        faces = np.concatenate([square[:, [0, 1, 2]], square[:, [0, 2, 3]]])
        points = points[used] + [0.0, 0.0, lift]
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
                near.append(segments(line + [0, 0, LIFT])[inside[:-1] & inside[1:]])
        if near:
            self._lines("ground/lanes", np.concatenate(near), "#ffffff", 0.06)

    def _on_ground(self, xy: Float[np.ndarray, "N 2"], lift: float = LIFT) -> np.ndarray:
        return np.column_stack([xy, self._ground(np.asarray(xy, float)) + lift]) - self.shift

    def _lines(self, name: str, ends: np.ndarray, color: str, wide: float) -> None:
        at = ends.astype(np.float32)
        self.drawn[name] = self.api.add_line_segments(name, at, colors=rgb(color), thickness=wide)

    def _draw_bodies(self) -> None:
        """Draw the static bodies as they are recorded."""
        by_kind: dict[str, list[np.ndarray]] = {}
        for body in self.scene.statics:
            parts = body_parts(body, self.scene.intersection)
            by_kind.setdefault(body.kind, []).extend(part.triangles for part in parts)
        for kind, triangles in by_kind.items():
            points = np.concatenate(triangles).reshape(-1, 3) - self.shift
            faces = np.arange(len(points), dtype=np.uint32).reshape(-1, 3)
            self.drawn[f"ground/{kind}"] = self.api.add_mesh_simple(
                f"ground/{kind}", points.astype(np.float32), faces, color=rgb(BODY_COLORS[kind]),
                flat_shading=True, side="double", opacity=CROWN if kind == "tree" else None,
            )  # fmt: skip

    def _boxes(
        self,
        name: str,
        center: np.ndarray,
        size: np.ndarray,
        yaw: np.ndarray,
        color: str,
        opacity: float | None = None,
    ) -> None:
        """Draw boxes at ``center`` (N, 3) with ``size`` (N, 3) [m] and ``yaw`` (N,) [rad]."""
        turn = SO3.from_z_radians(yaw).wxyz
        self.drawn[name] = self.api.add_batched_meshes_simple(
            name, _BOX.astype(np.float32), _FACES.astype(np.uint32), turn.astype(np.float32),
            center.astype(np.float32), batched_scales=size.astype(np.float32),
            batched_colors=rgb(color), opacity=opacity, lod="off", flat_shading=True,
            cast_shadow=opacity is None,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class HandleDrag:
    """One event of a drag: the handle is gripped ("start"), moved ("update") or let go ("end").
    ``at`` (3,) is the handle's position in the world [m], ``turn`` its rotation matrix."""

    phase: str
    at: Float[np.ndarray, "3"]
    turn: Float[np.ndarray, "3 3"]

    def on(self, pose: Float[np.ndarray, "6"]) -> Float[np.ndarray, "6"]:
        """The world pose that the drag gives a sensor. The handle was put upright on ``pose``,
        along its yaw; a turn about the forward axis changes nothing: no sensor has a roll."""
        ahead, (roll, pitch) = self.turn[:, 0], pose[3:5]
        pitch += np.arcsin(np.clip(ahead[2], -1, 1))
        return np.array([*self.at, roll, pitch, np.arctan2(ahead[1], ahead[0])])


class Selection3D:
    """The handle, outlines of what the selected sensors look at, wider than others, and points."""

    def __init__(
        self,
        api: viser.SceneApi,
        shift: Float[np.ndarray, "3"],
        dragged: Callable[[HandleDrag], None],
    ) -> None:
        """``shift`` is the scene's centre [m]. ``dragged`` is called on the server's event loop."""
        self._api, self._shift = api, shift
        self.outlines: list[Any] = []
        self.points: Any = None
        self.gizmo = gizmo = api.add_transform_controls(
            "handle", scale=LENGTH, fixed=True, line_width=3.5, depth_test=False
        )

        @gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            if event.client is not None:
                at, turn = np.array(gizmo.position) + shift, SO3(np.array(gizmo.wxyz)).as_matrix()
                dragged(HandleDrag(event.phase, at, turn))

    def put_handle(self, pose: Float[np.ndarray, "6"], *, visible: bool) -> None:
        """Put the handle on a world pose, upright."""
        self.gizmo.wxyz = SO3.from_z_radians(pose[5]).wxyz
        self.gizmo.position = pose[:3] - self._shift
        self.gizmo.visible = visible

    def draw_outlines(self, outlines: Sequence[tuple[Float[np.ndarray, "N 2 3"], str]]) -> None:
        """Draw these line segments [m] in their colours, in place of those before."""
        for k, (points, color) in enumerate(outlines):
            if k == len(self.outlines):
                name = f"selected/{k + 1}"
                line = self._api.add_line_segments(name, points, rgb(color), thickness=WIDE)
                self.outlines.append(line)
            line = self.outlines[k]
            line.points, line.colors = points, np.array(rgb(color), np.uint8)
            line.visible = True
        for line in self.outlines[len(outlines) :]:
            line.visible = False

    def draw_points(self, points: Float[np.ndarray, "N 3"] | None) -> None:
        """Draw a LiDAR's points, given in the world [m], in place of those before; or none."""
        if points is None or not len(points):
            if self.points is not None:
                self.points.remove()
            self.points = None
            return
        at, color = (points - self._shift).astype(np.float32), rgb(SENSOR_COLORS["lidar"])
        if self.points is None:
            self.points = self._api.add_point_cloud(
                "points", at, color, point_size=POINT_SIZE, point_shading="flat"
            )
        else:
            self.points.points = at


def look_from(camera: Any, scene: Scene, back: float = 1.0) -> None:
    """Point a camera at the scene, from the south and above; ``back`` scales its distance."""
    radius = scene.voxels.radius
    camera.position = (0.0, -1.05 * back * radius, 0.95 * back * radius)
    camera.look_at = (0.0, -0.08 * radius, 0.0)


def runs(flags: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Runs of true flags (L, Z) in a column: (column, first level, one past the last level)."""
    edges = np.diff(np.pad(flags.astype(np.int8), ((0, 0), (1, 1))), axis=1)
    column, low = np.nonzero(edges == 1)
    return column, low, np.nonzero(edges == -1)[1]


def segments(line: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 2 3"]:
    """The segments of a line, each by its two ends."""
    return np.stack([line[:-1], line[1:]], 1)


def mixed(one: str, other: str, share: float) -> str:
    """A colour between two, with so much of the other, from 0 to 1."""
    red, green, blue = (1.0 - share) * np.array(to_rgb(one)) + share * np.array(to_rgb(other))
    return to_hex((red, green, blue))


def rgb(color: str) -> tuple[int, int, int]:
    """Red, green and blue of a colour, from 0 to 255."""
    red, green, blue = (round(255 * part) for part in to_rgb(color))
    return red, green, blue
