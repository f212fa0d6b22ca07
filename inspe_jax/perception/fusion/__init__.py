"""How the maps of several agents become one.

A fusion takes maps (B, A, H, W, C) and which agents are present (B, A), and gives a map
(B, H, W, C). The papers take what their ego vehicle has after fusion. At an intersection nobody is
the ego: every agent is, in turn, and the mean of what all have is taken. So the order of agents
does not matter. Nor are maps warped from one agent's frame to another's: all are in that of the
intersection.
"""

from inspe_jax.perception.fusion.att_fuse import AttFuse
from inspe_jax.perception.fusion.disco_net import DiscoNet
from inspe_jax.perception.fusion.hm_vit import HMViT
from inspe_jax.perception.fusion.mean import Mean
from inspe_jax.perception.fusion.v2vnet import V2VNet
from inspe_jax.perception.fusion.v2x_vit import V2XViT

__all__ = ["AttFuse", "DiscoNet", "HMViT", "Mean", "V2VNet", "V2XViT"]
