"""What all sensors of an embedded recorder share."""

from dataclasses import dataclass

from inspe_jax.simulation.embedded.embree import Caster
from inspe_jax.simulation.embedded.headlights import GroundMap
from inspe_jax.simulation.embedded.shading import Shading
from inspe_jax.simulation.embedded.static_world import StaticWorld
from inspe_jax.simulation.recorder import Recording


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The world around the sensors, its light, and what is to be recorded.

    ``static_caster`` casts rays into the triangles of ``static_world``. ``appearance_seed`` is that
    of the road users' shapes and colours. ``ground`` is where their headlights are followed, None
    by day.
    """

    static_world: StaticWorld
    static_caster: Caster
    shading: Shading
    recording: Recording
    appearance_seed: int
    ground: GroundMap | None = None
