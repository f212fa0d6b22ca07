"""What the static world looks like: albedo and label at the points where rays hit it."""

import numpy as np

from inspe_jax.simulation.embedded import materials
from inspe_jax.simulation.embedded.static_world import StaticWorld
from inspe_jax.simulation.embedded.surface import noise

_LABELS = np.array([0, 2, 3, 3, 9, 9, 6, 4, 20, 14, 15, 20])
"""CARLA's semantic labels of :data:`~inspe_jax.simulation.embedded.materials.MATERIALS`; the ground
has those of its own labels."""
GROUND_LABELS = np.array([1, 1, 1, 2, 25, 10, 24])
"""CARLA's semantic labels of the regions of the ground, and of grass and paint."""


def static_look(
    static_world: StaticWorld, face: np.ndarray, point: np.ndarray, normal: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(linear albedo, CARLA's label) of the static world at points where rays hit its faces."""
    material = np.where(face >= 0, static_world.material[face], -1)
    body = np.where(face >= 0, static_world.body[face], 0)
    albedo, semantic = np.zeros((len(face), 3), np.float32), _LABELS[material]
    ground = material == materials.GROUND
    world = point[:, :2] + static_world.center[:2]
    albedo[ground] = static_world.surface.albedo(world[ground])
    semantic[ground] = GROUND_LABELS[static_world.surface.label(world[ground])]
    for kind, colour in _PLAIN.items():
        albedo[material == kind] = colour
    rough = material == materials.WALL
    stone = 0.7 + 0.6 * noise(point[rough][:, :2] * 3.1 + point[rough][:, 2:] * 4.3)
    albedo[rough] = np.array([0.34, 0.31, 0.27]) * stone[:, None]
    box = material == materials.FURNITURE
    albedo[box] = _FURNITURE[body[box] % len(_FURNITURE)]
    own = np.isin(material, materials.COLOURED)
    albedo[own] = static_world.colour[face[own]]
    crown = material == materials.CROWN
    leaf = 0.6 + 0.8 * noise(point[crown][:, :2] * 2.5 + point[crown][:, 2:] * 1.7)
    tint = 0.8 + 0.4 * (body[crown] * 0.618 % 1.0)
    albedo[crown] = np.array([0.065, 0.11, 0.035]) * (leaf * tint)[:, None]
    wall = material == materials.BUILDING
    albedo[wall] = _facade_colours(point[wall], normal[wall], body[wall])
    return albedo, semantic


_PLAIN = {
    materials.KERB: (0.34, 0.34, 0.34),
    materials.ROOF: (0.16, 0.12, 0.11),
    materials.TRUNK: (0.11, 0.075, 0.05),
    materials.POLE: (0.28, 0.29, 0.30),
}
_FURNITURE = np.array([[0.18, 0.20, 0.20], [0.12, 0.17, 0.13], [0.30, 0.30, 0.29]])
_WALLS = np.array(
    [[0.42, 0.36, 0.30], [0.34, 0.17, 0.12], [0.50, 0.48, 0.44], [0.30, 0.31, 0.33]]
    + [[0.46, 0.38, 0.24]]
)


def _facade_colours(point: np.ndarray, normal: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Linear albedo of walls: plaster or brick with rows of windows, one every 2.8 m and 3 m."""
    along = point[:, 1] * normal[:, 0] - point[:, 0] * normal[:, 1]
    across, up = along % 2.8, (point[:, 2] + 0.4) % 3.0
    pane = (across > 0.8) & (across < 2.1) & (up > 1.0) & (up < 2.4)
    frame = (across > 0.7) & (across < 2.2) & (up > 0.9) & (up < 2.5)
    plaster = 0.9 + 0.2 * noise(np.column_stack([along, point[:, 2]]) * 1.3)
    colour = _WALLS[body % len(_WALLS)] * plaster[:, None]
    colour = np.where(frame[:, None], 0.55, colour)
    return np.where(pane[:, None], [0.05, 0.06, 0.075], colour)
