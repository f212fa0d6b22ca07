"""A mesh of a place as triangles, which recordings show whole."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

LOW = 0.4
"""What of a mesh rises less over the ground is part of it, as kerbs are [m]."""


@dataclass(frozen=True, eq=False)  # arrays inside: identity is equality
class Mesh:
    """Triangles (F, 3, 3) relative to ``origin`` (3,) in the world [m], in single precision.

    ``colour`` (F, 3) is that of each face in sRGB, 0 to 255.
    """

    origin: Float[np.ndarray, "3"]
    triangles: Float[np.ndarray, "F 3 3"]
    colour: UInt8[np.ndarray, "F 3"]

    @property
    def world(self) -> Float[np.ndarray, "F 3 3"]:
        """The triangles in the world [m], in double precision."""
        return self.triangles.astype(float) + self.origin
