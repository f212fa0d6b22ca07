"""Soft scores and their gradients on all cores: each takes one tile after the other.

XLA runs a loop over tiles on one core. So a program that a user compiles with ``jax.jit`` calls the
cores (``jax.pure_callback``), which run programs of one tile; these serve all scenes.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.core.compiling import on_behalf_of, this_thread
from inspe_jax.core.digest import digest
from inspe_jax.core.parallel import Job, cores, jit_job, run, shapes_of
from inspe_jax.scoring.driver import (
    MetricValues,
    TileReadings,
    kept_for_gradient,
    measure_tiles,
    read_tiles,
    summarise_readings,
)
from inspe_jax.scoring.numbers import Numbers
from inspe_jax.scoring.options import ScoreOptions
from inspe_jax.scoring.tiled_scene import TiledScene
from inspe_jax.sensing.sensor_array import SensorArray

UNUSED = 2
"""Of so many scores what their gradients need is kept until these are asked for. Of more at once,
as under ``jax.vmap``, it is found again."""


def measure_softly(
    reading: Numbers,
    tiled: TiledScene,
    poses: Float[Array | np.ndarray, "S 6"],
    sensors: SensorArray,
    voxel: float,
    options: ScoreOptions,
) -> MetricValues:
    """:func:`~inspe_jax.scoring.driver.measure_tiles`, read softly.

    On all cores; in double precision, on one core and on other devices it is one program.
    """
    double = jax.config.jax_enable_x64  # type: ignore[attr-defined]
    if double or cores() == 1 or jax.default_backend() != "cpu":
        return measure_tiles(reading, tiled.bucketed, poses, sensors, voxel, options=options)
    return _measured(_Work(tiled, sensors, voxel, options), reading, poses)


class _Work:
    """The soft metrics of sensors on a scene and their gradient, of arrays that are not traced."""

    def __init__(
        self, tiled: TiledScene, sensors: SensorArray, voxel: float, options: ScoreOptions
    ) -> None:
        self.tiled, self.sensors, self.voxel = tiled, sensors, voxel
        self.kept, self.options = kept_for_gradient(tiled, sensors), options
        self._slopes: dict[str, Any] = {}

    @property
    def shapes(self) -> Any:
        """The shapes of the metrics."""
        tiles, failures = self.tiled.tiles, self.sensors.failures
        row, column, one = (
            jax.ShapeDtypeStruct(shape, np.float32)
            for shape in (
                (1 if failures is None else 1 + len(failures.first),),
                (tiles.tile.there.size // tiles.slabs,),
                (),
            )
        )
        values: Any = {metric.name: row for metric in self.options.metrics}
        return MetricValues(values, column, one, column)  # type: ignore[arg-type]

    def value(self, reading: Numbers, poses: Any) -> MetricValues:
        """The metrics."""
        return _on_host(_summary(*self._summed(self._of_each_tile(_read, reading, poses), reading)))

    def forward(self, reading: Numbers, poses: Any) -> MetricValues:
        """The metrics, while what the gradient needs is kept for :meth:`backward`."""
        found, slopes = zip(*self._of_each_tile(_read_with_slope, reading, poses), strict=True)
        summed = self._summed(found, reading)
        self._slopes[digest((reading, poses))] = slopes, summed
        for old in list(self._slopes)[:-UNUSED]:
            self._slopes.pop(old, None)
        return _on_host(_summary(*summed))

    def backward(self, reading: Numbers, poses: Any, after: Any, wanted: MetricValues) -> Any:
        """The gradient in the poses of the metrics, weighted by what is ``wanted``. It comes
        ``after`` a result of :meth:`forward`, as else XLA might call this first."""
        while (kept := self._slopes.pop(digest((reading, poses)), None)) is None:
            self.forward(reading, poses)
        slopes, summed = kept
        of_tiles = _on_host(_slope_of_summary(*summed, _on_host(wanted)))
        jobs: list[Job] = []
        for (rows, _), slope in zip(self.tiled.apart, slopes, strict=True):
            own = jax.tree.map(lambda leaf: leaf[rows], of_tiles)  # noqa: B023
            key = _pulled, jax.tree.structure(slope), shapes_of(slope)
            jobs.append((key, partial(_pulled, slope, own)))
        return np.sum(run(jobs), 0)

    def _of_each_tile(self, work: Callable[..., Any], reading: Numbers, poses: Any) -> list[Any]:
        """What ``work`` gives of each tile."""
        reading, *arrays = _on_host((reading, poses, self.sensors, self.voxel))
        jobs: list[Job] = []
        for _, tile in self.tiled.apart:
            given = tile, *arrays
            kind = jax.tree.structure((reading, given))
            key = work, self.kept, self.options, kind, shapes_of(given)
            jobs.append((key, partial(work, reading, *given, self.kept, self.options)))
        return run(jobs)

    def _summed(self, parts: Any, reading: Numbers) -> tuple:
        """What was read of all tiles, and what else their summary needs."""

        def joined(*leaves: Any) -> np.ndarray:
            first = np.asarray(leaves[0])
            whole = np.zeros((len(self.tiled.tiles.tile.there), *first.shape[1:]), first.dtype)
            for (rows, _), leaf in zip(self.tiled.apart, leaves, strict=True):
                whole[rows] = leaf
            return whole

        found = jax.tree.map(joined, *parts)
        failures, width = self.sensors.failures, _on_host(reading.width)
        return found, self.tiled.bucketed, failures, width, self.options


def _called(work: Callable[..., Any], shapes: Any, *given: Any) -> Any:
    """``work(*given)``, by the program that is being traced if one is."""
    if not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(given)):
        return work(*given)
    here = this_thread()

    def call(*given: Any) -> Any:
        # A callback has a device of its own, for which all would be compiled once more.
        with on_behalf_of(here), jax.default_device(None):
            return work(*given)

    return jax.pure_callback(call, shapes, *given, vmap_method="sequential")


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def _measured(work: _Work, reading: Numbers, poses: Float[Array, "S 6"]) -> MetricValues:
    return _called(work.value, work.shapes, reading, poses)


def _forward(work: _Work, reading: Numbers, poses: Array) -> tuple[MetricValues, tuple]:
    found = _called(work.forward, work.shapes, reading, poses)
    return found, (reading, poses, found.entropy)


def _backward(work: _Work, kept: tuple, wanted: MetricValues) -> tuple[None, Array]:
    shape = jax.ShapeDtypeStruct(kept[1].shape, kept[1].dtype)
    return None, _called(work.backward, shape, *kept, wanted)


_measured.defvjp(_forward, _backward)


_read = jit_job(read_tiles, static_argnums=(5, 6))
_summary = jax.jit(summarise_readings, static_argnums=4)


@partial(jit_job, static_argnums=(5, 6))
def _read_with_slope(
    reading: Numbers, tiled: TiledScene, poses: Float[Array, "S 6"], *given: Any
) -> tuple[TileReadings, Any]:
    return jax.vjp(lambda poses: read_tiles(reading, tiled, poses, *given), poses)


@partial(jax.jit, static_argnums=4)
def _slope_of_summary(found: TileReadings, *given: Any) -> TileReadings:
    *rest, wanted = given
    return jax.vjp(lambda found: summarise_readings(found, *rest), found)[1](wanted)[0]


@jit_job
def _pulled(slope: Callable[..., Any], wanted: Any) -> Any:
    """The gradient of what has a ``slope``, weighted by what is ``wanted``."""
    return slope(wanted)[0]


def _on_host(arrays: Any) -> Any:
    return jax.tree.map(np.asarray, arrays)
