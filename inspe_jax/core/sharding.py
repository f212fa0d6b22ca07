"""Splits work among several devices, if JAX has more than one: arrays along one axis."""

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

_AXIS = "devices"


def devices() -> int:
    """Number of devices of this process."""
    return jax.local_device_count()


@cache
def _mesh() -> Mesh:
    return Mesh(np.array(jax.local_devices()), (_AXIS,))


def along(axis: int | None) -> PartitionSpec:
    """The specification of arrays split along an axis; None means whole on every device."""
    return PartitionSpec() if axis is None else PartitionSpec(*[None] * axis, _AXIS)


def put(x: Any, axis: int | None) -> Any:
    """Arrays on the devices, split as by :func:`along`. The axis is a multiple of the devices."""
    return jax.device_put(x, NamedSharding(_mesh(), along(axis)))


def split(function: Callable[..., Any], takes: Any, gives: Any) -> Callable[..., Any]:
    """A compiled function that every device runs on its part of the arguments; ``takes`` and
    ``gives`` are the :func:`along` of each argument and of each result."""
    return jax.jit(
        jax.shard_map(function, mesh=_mesh(), in_specs=takes, out_specs=gives, check_vma=False)
    )
