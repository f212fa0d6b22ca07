"""Claim: 18 scenarios of five seconds, of 8 cameras and 4 LiDARs, are recorded in under 10 minutes.

Two intersections, three densities, three lights, the layout Cam-d1/L-d1, at 10 Hz: 900 frames on
two cores. Records them, as `inspe generate` does, each light by itself; says what a frame takes in
seconds and megabytes, and what the paper's 144 000 frames would; and draws what the set holds and
one frame in each light. The set is thrown away unless --keep says where to leave it.
"""

from pathlib import Path
from typing import Any

from common import arguments, kept_folder, output, processes, progress, show, write_results

from inspe_jax.core.parallel import cores
from inspe_jax.dataset import generate, load_generation, open, statistics
from inspe_jax.dataset.figure import statistics_view
from inspe_jax.dataset.frame_figure import frame_view
from inspe_jax.simulation.embedded.light import LIGHTS

PAPER = 144_000
"""Frames of the paper's set."""
STUDY = """
scenes: [{{built_in: four_way}}, {{built_in: roundabout}}]
layouts: [Cam-d1/L-d1]
settings: {{density: {densities}, light: [{light}], {size}}}
rate_hz: 10
"""


def record(light: str, quick: bool, into: Path, workers: int | None) -> dict[str, Any]:
    """All scenarios in one light: frames, seconds and megabytes."""
    study = into / f"{light}.yaml"
    densities = "[8]" if quick else "[low, medium, high]"
    size = "seconds: 0.2, radius: 15, voxel: 1" if quick else "seconds: 5"
    study.write_text(STUDY.format(light=light, densities=densities, size=size))
    with progress(light) as report:
        made = generate(load_generation(study), into / light, workers=workers, progress=report)
    assert not made.failures, made.failures
    assert made.recorded == made.frames, f"{into}: frames were there before; name another folder"
    return dict(
        light=light, scenarios=made.scenarios, frames=made.frames, seconds=made.seconds,
        megabytes=made.size / 1e6,
    )  # fmt: skip


def row(name: str, found: dict[str, Any]) -> list[str]:
    """What recording took, in all and a frame."""
    frames, seconds, size = (found[key] for key in ("frames", "seconds", "megabytes"))
    each = f"{seconds / frames:.2f}", f"{size / frames:.1f}"
    whole = f"{PAPER * seconds / frames / 3600:.0f}", f"{PAPER * size / frames / 1e6:.2f}"
    return [name, str(found["scenarios"]), str(frames), f"{seconds:.0f}", *each, *whole]


def main() -> None:
    """Record, print, draw and write."""
    given = arguments(__doc__, "workers", "keep")
    stem = output(given, "generate_set")
    with kept_folder(given.keep) as into:
        lights = ("midday",) if given.quick else tuple(LIGHTS)
        rows = [record(light, given.quick, into, processes(given)) for light in lights]
        for found in rows:
            scenario = open(into / found["light"]).scenarios[0]
            view = frame_view(scenario, scenario.frames[-1])
            view.savefig(f"{stem}_{found['light']}.png", dpi=100)
        figure = statistics_view(statistics(open(into / "midday")))
    total = {key: sum(found[key] for found in rows) for key in rows[0] if key != "light"}
    show(
        ("", "scenarios", "frames", "seconds", "s each", "MB each", "hours", "TB"),
        [*(row(found["light"], found) for found in rows), row("all", total)],
        f"in the last two columns what {PAPER} frames would take",
    )
    settings = {"quick": given.quick, "workers": processes(given) or cores()}
    write_results(stem, rows, settings, figure, dpi=100)


if __name__ == "__main__":
    main()
