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

_FAN = float(np.radians(60.0))  # between sensors that are aimed from one pole [rad]


def mix_name(counts: Mapping[str, int]) -> str:
    """A mix in words, such as "4 hesai-xt32 + 2 paper-camera"."""
    return " + ".join(f"{n} {name}" for name, n in counts.items() if n)


def starting_layout(
    scene: Scene,
    counts: Mapping[str, int],
    own: Mapping[str, Spec] | None = None,
    poles: int | None = None,
) -> Layout:
    """The layout from which the search of a mix starts: so many of each device, ``counts``, at
    corners and roadsides, each a unit that looks at the centre, LiDARs first, far apart.

    With so many ``poles`` at most, further sensors join the first, in turn; those that are aimed
    look 60° aside of each other. ``own`` has specs of devices that are not in the catalogue.
    """
    specs = {name: (own or {}).get(name) or device(name).spec for name in counts}
    wanted = [specs[name] for name, n in counts.items() for _ in range(n)]
    if not wanted:
        raise InspeError("a mix needs at least one sensor")
    if poles is not None and poles < 1:
        raise InspeError(f"poles {poles}: a mix needs at least one")
    wanted.sort(key=lambda spec: spec.aimed)
    site = Site(scene.intersection, scene.voxels.radius, depth=30.0, bodies=scene.statics)
    sorts = {"corner": site.corners, "roadside": site.roadsides}
    feet = np.concatenate([*sorts.values()])
    posts = [f"{sort} {i + 1}" for sort, those in sorts.items() for i in range(len(those))]
    order = farthest_first(feet, len(feet))
    count = min(len(wanted) if poles is None else poles, len(wanted))
    if count > len(order):
        raise InspeError(
            f"{scene.name}: {count} sensors on poles of their own, but only {len(order)} posts at "
            "corners and roadsides; allow fewer sensors, or fewer poles for them"
        )
    views = []
    for k, spec in enumerate(wanted):
        post, foot, yaw = posts[order[k % count]], feet[order[k % count]], None
        if before := sum(other.aimed for other in wanted[k % count : k : count]):
            aside = _FAN * ((before + 1) // 2) * (-1) ** before
            yaw = site.azimuth(2 * site.center - foot) + aside
        aimed = spec.aimed
        view = site.camera(post, foot, site.center, yaw=yaw) if aimed else site.lidar(post, foot)
        views.append((view, spec))
    return replace(join(mix_name(counts), scene.intersection, views), profile=scene.profile.name)
