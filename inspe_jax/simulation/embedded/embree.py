"""Casts rays into triangles with Embree, in single precision."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.core.errors import needs

R3 = Float[np.ndarray, "R 3"]  # a vector for each of R rays or points
Reach = float | Float[np.ndarray, " R"]  # of all rays, or of each [m]
F33 = Float[np.ndarray, "F 3 3"]  # the corners of F triangles


class RayHits(NamedTuple):
    """What R rays hit first: distance [m], index of the face (−1: nothing) and its unit normal."""

    distance: Float[np.ndarray, " R"]
    face: Int[np.ndarray, " R"]
    normal: R3


class Caster:
    """Triangles, perhaps none, ready for rays. Raises InspeError where Embree is missing."""

    def __init__(self, triangles: F33) -> None:
        with needs("recording needs Embree", "dataset", "no wheels for Linux on ARM"):
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        self.count = len(triangles)
        if self.count:
            self._scene = EmbreeScene(robust=True)  # else rays slip through between faces
            TriangleMesh(self._scene, np.ascontiguousarray(triangles, np.float32))

    def cast(self, origins: Float[np.ndarray, "*R 3"], directions: R3, reach: Reach) -> RayHits:
        """The first face on each ray within ``reach`` [m], from one origin, or one for each ray;
        its normal points towards the origin. ``distance`` is infinite where nothing is hit."""
        many = len(directions)
        distance, normal = np.full(many, np.inf, np.float32), np.zeros((many, 3), np.float32)
        if not (self.count and many):
            return RayHits(distance, np.full(many, -1), normal)
        start, to, reach = _rays(origins, directions, reach)
        found = self._scene.run(start, to, dists=reach, output=True)
        hit = np.flatnonzero(found["primID"] >= 0)
        distance[hit] = found["tfar"][hit]
        across = found["Ng"][hit]
        along = np.einsum("rk,rk->r", across, to[hit])
        across /= np.copysign(np.sqrt(np.einsum("rk,rk->r", across, across)), -along)[:, None]
        normal[hit] = across
        return RayHits(distance, found["primID"], normal)

    def meets(
        self, origins: R3, directions: Float[np.ndarray, "*R 3"], reach: Reach
    ) -> Bool[np.ndarray, " R"]:
        """Whether each ray hits anything within ``reach`` [m]; one direction, or one per ray."""
        start, to, reach = _rays(origins, directions, reach)
        if not (self.count and len(to)):
            return np.zeros(len(to), bool)
        return self._scene.run(start, to, dists=reach, query="OCCLUDED") >= 0


def _rays(origins: Any, directions: Any, reach: Any) -> tuple[np.ndarray, ...]:
    start, to = np.broadcast_arrays(origins, directions)
    given = start, to, np.broadcast_to(reach, start.shape[:1])
    return tuple(np.array(x, np.float32, order="C") for x in given)
