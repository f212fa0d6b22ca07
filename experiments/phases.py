"""Claim: as its width falls to 0, the soft score becomes the mean of exact scores over the phases
of the ray grid.

For every device of the catalogue, several sensors at random places on the built-in four-way: each
metric read softly with rays as a density, less its exact mean over draws in which every sensor's
rows and columns begin at a random part of a spacing. Devices that are mounted alike but for where
their grid begins are what the mean is over.
"""

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from common import METRICS, arguments, console, output, show, write_results
from jaxtyping import Float
from rich.progress import track
from slopes import feasible

import inspe_jax
from inspe_jax import Layout
from inspe_jax.sensing.ray_grid import RayGrid

WIDTHS = (1e-3, 0.5)
"""Of soft scores [m]: next to nothing, and what searches use."""


def in_phase(grid: RayGrid, row: float, column: float) -> RayGrid:
    """A grid whose rows and columns begin so much of a spacing later, both from 0 to 1."""
    ends, count = grid.outer_rows, len(grid.rows)
    # Between two rows the count grows by 1, and by a half from the outer end to the first one.
    counted = [0.0, *(np.arange(count) + 0.5), count]
    rows = np.interp(np.arange(count) + row, counted, [ends[0], *grid.rows, ends[1]])
    first = grid.first_column + (column - 0.5) * grid.column_step
    return replace(grid, rows=tuple(rows), first_column=first)


def phased(kind: Any) -> Any:
    """A kind of sensor whose grid of rays begins in a ``phase`` (row, column)."""

    @dataclass(frozen=True)
    class Phased(kind):
        phase: tuple[float, float] = (0.0, 0.0)

        @cached_property
        def grid(self) -> RayGrid:
            return in_phase(kind.grid.func(self), *self.phase)

    return Phased


def drawn(layout: Layout, phases: Float[np.ndarray, "S 2"]) -> Layout:
    """The layout with each sensor's grid in a phase of its own."""
    sensors = []
    for sensor, phase in zip(layout.sensors, phases.tolist(), strict=True):
        spec: Any = sensor.spec
        own = {one.name: getattr(spec, one.name) for one in fields(spec)}
        spec = phased(type(spec))(**own, phase=tuple(phase))
        sensors.append(replace(sensor, spec=spec))
    return replace(layout, sensors=tuple(sensors))


def main() -> None:
    """Compare, print and write."""
    options = arguments(__doc__, "seed", phases=dict(type=int, default=64, help="draws of a mean"))
    quick, draws = options.quick, 4 if options.quick else options.phases
    radius, frames = (12, 4) if quick else (30, 8)
    place = inspe_jax.built_in("four_way")
    scene = inspe_jax.build_scene(place, radius=radius, frames=frames, seed=options.seed)
    rows: list[dict[str, Any]] = []
    for name in track(
        ["paper-lidar-32"] if quick else list(inspe_jax.devices()),
        "phases", console=console, transient=True,
    ):  # fmt: skip
        rng = np.random.default_rng(options.seed)
        layout = feasible(scene, inspe_jax.device(name).spec, 3, rng)
        phases = rng.random((draws, 3, 2))
        strata = rng.permuted(np.tile(np.arange(draws), (3, 1)), axis=1).T
        phases[..., 0] = (strata + phases[..., 0]) / draws  # every part of a spacing equally often
        exact = [inspe_jax.evaluate(scene, drawn(layout, phase)) for phase in phases]
        soft = [inspe_jax.evaluate(scene, layout, softness=width) for width in WIDTHS]
        for metric in METRICS:
            values = np.array([getattr(scores, metric) for scores in exact])
            mean, deviation = float(values.mean()), float(values.std(ddof=1))
            found: dict[str, Any] = dict(device=name, metric=metric, mean=mean, deviation=deviation)
            for width, scores in zip(WIDTHS, soft, strict=True):
                found[f"bias_{width:g}"] = float(getattr(scores, metric)) - mean
            rows.append(found)
    heads = (
        "device",
        "metric",
        "mean",
        "deviation\nof a phase",
        *(f"bias at\n{w:g} m" for w in WIDTHS),
    )
    cells = [
        (r["device"], METRICS[r["metric"]], *(f"{x:.4f}" for x in list(r.values())[2:]))
        for r in rows
    ]
    show(heads, cells, f"Soft scores less exact ones' mean over {draws} phases")
    settings = dict(scene.settings, seed=options.seed, phases=draws)
    write_results(output(options, "phases"), rows, settings)


if __name__ == "__main__":
    main()
