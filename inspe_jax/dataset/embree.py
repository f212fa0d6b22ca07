"""Triangles and the rays that meet them, by Embree; in single precision about a centre."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from inspe_jax.errors import InspeError


class Hits(NamedTuple):
    """What R rays meet first: how far away [m], which face (−1: nothing) and its unit normal."""

    distance: Float[np.ndarray, " R"]
    face: Int[np.ndarray, " R"]
    normal: Float[np.ndarray, "R 3"]


class Caster:
    """Triangles (F, 3, 3), ready to be asked; nothing is met where there are none."""

    def __init__(self, triangles: Float[np.ndarray, "F 3 3"]) -> None:
        self.count = len(triangles)
        if self.count:
            core, mesh = _library()
            self._scene = core.EmbreeScene()
            mesh.TriangleMesh(self._scene, np.ascontiguousarray(triangles, np.float32))

    def cast(
        self,
        origins: Float[np.ndarray, "*R 3"],
        directions: Float[np.ndarray, "R 3"],
        reach: float | Float[np.ndarray, " R"],
    ) -> Hits:
        """The first face on each ray within ``reach`` [m]; one origin, or one for each ray.

        Normals face the ray. ``distance`` is infinite where nothing is met.
        """
        many = len(directions)
        distance, normal = np.full(many, np.inf), np.zeros((many, 3), np.float32)
        if not (self.count and many):
            return Hits(distance, np.full(many, -1), normal)
        rays = _rays(origins, directions, reach)
        found = self._scene.run(*rays[:2], dists=rays[2], output=True)
        met = np.flatnonzero(found["primID"] >= 0)
        distance[met] = found["tfar"][met]
        across = found["Ng"][met]
        across /= np.sqrt(np.einsum("rk,rk->r", across, across))[:, None]
        behind = np.einsum("rk,rk->r", across, rays[1][met]) > 0
        normal[met] = np.where(behind[:, None], -across, across)
        return Hits(distance, found["primID"], normal)

    def meets(
        self,
        origins: Float[np.ndarray, "R 3"],
        directions: Float[np.ndarray, "R 3"],
        reach: float | Float[np.ndarray, " R"] = 1e4,
    ) -> Bool[np.ndarray, " R"]:
        """Whether anything is met on each ray within ``reach`` [m]."""
        if not (self.count and len(directions)):
            return np.zeros(len(directions), bool)
        rays = _rays(origins, directions, reach)
        return self._scene.run(*rays[:2], dists=rays[2], query="OCCLUDED") >= 0


def _rays(origins: Any, directions: Any, reach: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Origins, directions and reaches, one for each ray, as Embree takes them."""
    to = np.ascontiguousarray(directions, np.float32)
    start = np.ascontiguousarray(np.broadcast_to(origins, to.shape), np.float32)
    return start, to, np.ascontiguousarray(np.broadcast_to(reach, (len(to),)), np.float32)


def _library() -> tuple[Any, Any]:
    try:
        from embreex import mesh_construction, rtcore_scene
    except ImportError as error:
        raise InspeError(
            "recording needs Embree: pip install 'inspe_jax[dataset]' (no wheels for Linux on ARM)"
        ) from error
    return rtcore_scene, mesh_construction
