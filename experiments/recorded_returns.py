"""Claim: no LiDAR returns a point from beyond its reach, in any weather, from anything.

Three LiDARs, one at a time, 6 m up at the edge of a busy crossing; clear weather, rain and fog,
which shorten the reach. Counts the returns of the recorded scans on road users and on everything
else, and draws up to which range those on road users come, with the reach of each LiDAR in each
weather. Stops with an error if a return lies beyond the reach by more than its noise.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from common import arguments, output, show, write_results
from matplotlib.figure import Figure

from inspe_jax.scene.procedural.built_ins import built_in
from inspe_jax.scene.scene import Scene, build_scene
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.conditions import Conditions
from inspe_jax.sensing.layout import Layout, Sensor, Unit, make_layout
from inspe_jax.simulation.embedded.ray_sensors import Lidar
from inspe_jax.simulation.embedded.recorder import EmbeddedRecorder

DEVICES = ("velodyne-vlp-16", "paper-lidar-32", "ouster-os1-128")
WEATHER = ("clear", "rain:10", "rain:50", "fog:200", "fog:50")
HEIGHT = 6.0
"""Of the LiDARs [m]."""
BASE = (9.0, 9.0)
"""Of their unit [m]."""


@dataclass(frozen=True)
class Found:
    """The ranges [m] of all points of a LiDAR in a weather, and of those that road users return
    before noise and losses; ``reach`` [m] is the LiDAR's in this weather."""

    device: str
    weather: str
    reach: float
    range: np.ndarray
    range_of_road_users: np.ndarray
    road_users: int


def layout_of(name: str) -> Layout:
    """One LiDAR on a unit."""
    sensor = Sensor("lidar", device(name).spec, 0)
    pose = np.array([[*BASE, HEIGHT, 0.0, 0.0, 0.0]])
    return make_layout([sensor], [Unit("mast", (*BASE, 0.0))], pose, name)


def recorded(scene: Scene, devices: Sequence[str]) -> Iterator[Found]:
    """Every device in every weather."""
    for name in devices:
        layout = layout_of(name)
        for weather in WEATHER:
            around = Conditions.of("midday", weather)
            recorder = EmbeddedRecorder(scene, layout, around)
            (lidar,), hits, scans = recorder.sensors, [], []
            assert isinstance(lidar, Lidar)
            for t in range(scene.traffic.frame_count):
                frame = recorder.frame(t)
                scans.append(frame.stations[0].scans[0])
                actors = recorder.surroundings.actors(t)
                returns = lidar.cast(actors, recorder.surroundings.recording.turn)
                hits.append(returns.distance[returns.box >= 0])
            far = np.concatenate([np.linalg.norm(scan.points[:, :3], axis=1) for scan in scans])
            on_users = sum(int(scan.returns.sum()) for scan in scans if scan.returns is not None)
            reach = lidar.reach
            noise = recorder.surroundings.recording.noise.range
            assert far.max() < reach + 6 * noise, (name, weather, far.max(), reach)
            yield Found(name, weather, reach, far, np.concatenate(hits), on_users)


def row(found: Found, clear: Found) -> dict[str, Any]:
    """Numbers of the table; shares are of those in clear weather."""
    return dict(
        device=found.device,
        weather=found.weather,
        reach=round(found.reach, 1),
        furthest=round(float(found.range.max()), 2),
        points=len(found.range),
        on_road_users=found.road_users,
        share_of_points=round(len(found.range) / len(clear.range), 3),
        share_on_road_users=round(found.road_users / clear.road_users, 3),
    )


def draw(results: list[Found]) -> Figure:
    """Rays that end on road users up to a range, a panel a device, a line a weather; dashed where
    the reach ends."""
    figure = Figure(figsize=(12, 3.8), layout="constrained")
    names = list(dict.fromkeys(found.device for found in results))
    axes = figure.subplots(1, len(names), squeeze=False)[0]
    for ax, name in zip(axes, names, strict=True):
        own = [found for found in results if found.device == name]
        for k, found in enumerate(own):
            far = np.sort(found.range_of_road_users)
            ax.plot(far, np.arange(1, len(far) + 1) / 1e3, color=f"C{k}", lw=1.6)
            words = f"{found.weather}: {found.reach:.0f} m"
            ax.plot(far[-1], len(far) / 1e3, "o", color=f"C{k}", ms=4, label=words)
            ax.axvline(found.reach, color=f"C{k}", ls="--", lw=0.9)
        ax.set(title=name, xlabel="range [m]", ylim=(0, None))
        ax.grid(alpha=0.3)
        ax.legend(title="reach (dashed)", fontsize=7, title_fontsize=7, loc="lower right")
    axes[0].set_ylabel("thousand rays that end on\nroad users up to this range")
    return figure


def main() -> None:
    """Record, print, draw and write."""
    given = arguments(__doc__, "seed")
    frames, devices = (1, DEVICES[:1]) if given.quick else (20, DEVICES)
    settings = dict(radius=80, voxel=1, frames=frames, step=0.5, density="high", seed=given.seed)
    scene = build_scene(built_in("four_way"), **settings)
    results = list(recorded(scene, devices))
    clear = {found.device: found for found in results if found.weather == "clear"}
    rows = [row(found, clear[found.device]) for found in results]
    heads = [key.replace("_", "\n") for key in rows[0]]
    show(heads, [list(entry.values()) for entry in rows], "Points of recorded scans")
    write_results(output(given, "recorded_returns"), rows, settings, draw(results))


if __name__ == "__main__":
    main()
