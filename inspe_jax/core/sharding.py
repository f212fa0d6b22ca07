"""Work split among several devices, where JAX has more than one.

Arrays are split along one axis, each device works on its part by itself, and nothing is sent
between them: what comes back is counted together afterwards.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

_AXIS = "devices"


def devices() -> int:
    """How many devices this process has."""
    return jax.local_device_count()


def divides(length: int) -> bool:
    """Whether there are several devices, and their number divides so many rows evenly."""
    return devices() > 1 and length % devices() == 0


@cache
def _mesh() -> Mesh:
    return Mesh(np.array(jax.local_devices()), (_AXIS,))


def along(axis: int | None) -> PartitionSpec:
    """Arrays split along an axis, or whole on every device where it is None."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, _AXIS)


def put(x: Any, axis: int | None) -> Any:
    """Arrays as :func:`along` has them. The number of devices divides the axis."""
    return jax.device_put(x, NamedSharding(_mesh(), along(axis)))


def split(function: Callable[..., Any], takes: Any, gives: Any) -> Callable[..., Any]:
    """A function that every device runs on its part of the arguments, compiled.

    ``takes`` and ``gives`` are what :func:`along` says of each argument and of each result.
    """
    return jax.jit(
        jax.shard_map(function, mesh=_mesh(), in_specs=takes, out_specs=gives, check_vma=False)
    )
