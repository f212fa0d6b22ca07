"""A radar: its beam fills a field of view, and its resolution says what it tells apart in it.

To coverage, occlusion and information gain it is a field of view: its rays lie so close that they
leave out no voxel of 0.2 m, the smallest of a profile, and what hides a voxel from other sensors
hides it from a radar. These three say where it looks. They do not say what it finds there: it tells
no voxels of half a metre apart. That is what detectability and localisation are for
(:mod:`inspe_jax.scoring.radar_evidence`).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from inspe_jax.core.pytree import pytree
from inspe_jax.sensing.ray_grid import RayGrid
from inspe_jax.sensing.rays import SphericalRays
from inspe_jax.sensing.sensors import Spec
from inspe_jax.sensing.signals import Signal

GAP = 0.2
"""Largest distance between neighbouring rays at the reach [m]: the edge of the smallest voxel."""
STEPS = np.radians(0.02), np.radians(0.25)
"""Least and largest angle between neighbouring rays [rad]; the least is ``GAP`` at 573 m."""
_STEEP = np.radians(60)  # edges that are steeper than this have rays further apart


@pytree
@dataclass(frozen=True)
class RadarRays(SphericalRays):
    """A radar's beam as rays, of which each stands for the same solid angle."""

    signal = Signal("radar", echo=True)


@dataclass(frozen=True)
class RadarSpec(Spec):
    """A radar that measures range, azimuth and radial speed.

    ``reach`` [m] is how far it finds a car, by its data sheet. ``azimuth_fov`` and
    ``elevation_fov`` are the angles from edge to edge [rad]. Two road users that differ by less
    than ``range_resolution`` [m], ``azimuth_resolution`` [rad] and ``speed_resolution`` [m/s] are
    one to it. What has less radial speed than ``min_speed`` [m/s] is lost among the echoes of all
    that stands; 0 for a radar that finds standing vehicles too.

    Not modelled: echoes by way of walls and of the road beneath vehicles, what a track remembers of
    a road user that stops, false alarms, other radars, and a gain that falls towards the edges.
    """

    name: str
    reach: float
    azimuth_fov: float
    elevation_fov: float
    range_resolution: float
    azimuth_resolution: float
    speed_resolution: float
    min_speed: float
    reliability: float = 1.0

    kind = "radar"
    title = "radar"
    aimed = True
    pitch_limits_deg = (-30.0, 10.0)
    candidate_pitches_deg = (-15.0, -5.0)

    @cached_property
    def grid(self) -> RayGrid:
        """Rays at even azimuths and even sines of elevation, in the middle of their share."""
        most = np.clip(GAP / self.reach, *STEPS)
        # Rows are furthest apart at the edges: 2 tan(elevation_fov / 2) / rows.
        spans = self.azimuth_fov, 2 * np.tan(min(self.elevation_fov / 2, _STEEP))
        columns, rows = (max(2, int(np.ceil(span / most - 1e-9))) for span in spans)
        step = self.azimuth_fov / columns
        sine = np.sin(self.elevation_fov / 2) * ((np.arange(rows) + 0.5) * 2 / rows - 1)
        return RayGrid(
            tuple(np.arcsin(sine).tolist()),
            -self.azimuth_fov / 2 + step / 2,
            step,
            columns,
            bool(np.isclose(self.azimuth_fov, 2 * np.pi)),
            self.reach,
            RadarRays,
            (self.range_resolution, self.azimuth_resolution, self.speed_resolution, self.min_speed),
        )

    @property
    def azimuth_limits(self) -> tuple[float, float]:
        """Right and left edge of its beam [rad]."""
        return -self.azimuth_fov / 2, self.azimuth_fov / 2

    @property
    def field_of_view(self) -> tuple[float, float]:
        """Angle from edge to edge, horizontal and vertical [rad]."""
        return self.azimuth_fov, self.elevation_fov

    @property
    def resolution(self) -> str:
        """Of range and azimuth."""
        return f"{self.range_resolution:g} m, {np.degrees(self.azimuth_resolution):.3g}°"
