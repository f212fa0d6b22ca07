"""Layouts of a given number of each device, from which searches start."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from inspe_jax.core.errors import InspeError
from inspe_jax.mounting.site import Site, farthest_first
from inspe_jax.mounting.strategies import join
from inspe_jax.scene.scene import Scene
from inspe_jax.sensing.catalogue import device
from inspe_jax.sensing.layout import Layout
from inspe_jax.sensing.sensors import Spec


def mix_name(counts: Mapping[str, int]) -> str:
    """A mix in words, such as "4 hesai-xt32 + 2 paper-camera"."""
    return " + ".join(f"{n} {name}" for name, n in counts.items() if n)


def starting_layout(
    scene: Scene, counts: Mapping[str, int], own: Mapping[str, Spec] | None = None
) -> Layout:
    """The layout from which the search of a mix starts, of so many of each device (``counts``).

    Posts are at the junction's corners and roadsides. Each sensor is a unit of its own and looks
    at the centre. LiDARs are placed first; each sensor takes the post that is furthest from those
    already taken. ``own`` has the specs of devices that are not in the catalogue. Raises InspeError
    if there are more sensors than posts, no sensor, or nowhere to put a pole.
    """
    specs = {name: (own or {}).get(name) or device(name).spec for name in counts}
    wanted = [specs[name] for name, n in counts.items() for _ in range(n)]
    if not wanted:
        raise InspeError("a mix needs at least one sensor")
    wanted.sort(key=lambda spec: spec.aimed)
    site = Site(scene.intersection, scene.voxels.radius, depth=30.0, bodies=scene.statics)
    sorts = {"corner": site.corners, "roadside": site.roadsides}
    feet = np.concatenate([*sorts.values()])
    posts = [f"{sort} {i + 1}" for sort, those in sorts.items() for i in range(len(those))]
    order = farthest_first(feet, len(feet))
    if len(wanted) > len(order):
        raise InspeError(
            f"{scene.name}: {len(wanted)} sensors, but only {len(order)} posts at corners and "
            "roadsides; allow fewer sensors"
        )
    views = []
    for spec, at in zip(wanted, order, strict=False):
        post, foot = posts[at], feet[at]
        view = site.camera(post, foot, site.center) if spec.aimed else site.lidar(post, foot)
        views.append((view, spec))
    return replace(join(mix_name(counts), scene.intersection, views), profile=scene.profile.name)
