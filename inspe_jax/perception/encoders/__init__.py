"""From points or pictures to maps in bird's-eye view, one an agent."""

from inspe_jax.perception.encoders.lift_splat import LiftSplat
from inspe_jax.perception.encoders.pillars import PillarEncoder
from inspe_jax.perception.encoders.pyramid import Neck, Pyramid

__all__ = ["LiftSplat", "Neck", "PillarEncoder", "Pyramid"]
