"""Claim: the gradient of the soft score is its slope, and points where the exact score rises.

For every device of the catalogue, several sensors at random places on the built-in four-way. Two
questions are asked, with rays read as a density and with rays read exactly:

1. Does the gradient agree with central differences of the soft score over steps from 1e-2 to 1e-6,
   in double precision?
2. Does it agree with differences of the exact score? That is a staircase, so both are means over
   poses near by, drawn within half a metre and 3°.

Agreement is the cosine between the two, over all coordinates of all sensors, where 1 m counts as
much as 0.1 rad. A coordinate that a sensor does not feel, as the yaw of a spinning LiDAR, has
nothing to agree on, and counts little.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from agreement import random_layout
from common import arguments, write_results
from jaxtyping import Float
from rich.console import Console
from rich.progress import track
from rich.table import Table

import inspe_jax
from inspe_jax import Layout, Scene, Softness
from inspe_jax.core.parallel import at_precision

console = Console()

STEPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
"""Steps of central differences, in units of :data:`SCALE`."""
SCALE = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
"""What one step of each coordinate is: metres and radians."""
WIDE = 0.5
"""Steps of the differences of the exact score, and how far poses near by are, in scales."""
SOFTNESS = 0.5
READINGS = ("density", "exact")

Slopes = Float[np.ndarray, "S 6"]


def cosine(one: Slopes, other: Slopes) -> float:
    """The cosine of the angle between two slopes, in units of :data:`SCALE`."""
    a, b = (one * SCALE).ravel(), (other * SCALE).ravel()
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def score(scene: Scene, layout: Layout, rays: str) -> Any:
    """P_sm of poses, read softly."""
    softness = Softness(SOFTNESS, SOFTNESS, rays)

    def of(poses: Any) -> Any:
        return inspe_jax.evaluate(scene, layout.with_poses(poses), softness=softness).surrogate

    return of


def moved(poses: Slopes, step: float) -> Float[np.ndarray, "S*12 S 6"]:
    """The poses with every coordinate moved forward and back, one after the other."""
    rows = []
    for s in range(len(poses)):
        for k in range(6):
            for sign in (1, -1):
                rows.append(poses.copy())
                rows[-1][s, k] += sign * step * SCALE[k]
    return np.array(rows)


def differences(values: Any, step: float) -> Slopes:
    """Central differences from the scores of :func:`moved`."""
    pairs = np.asarray(values, float).reshape(-1, 6, 2)
    return (pairs[..., 0] - pairs[..., 1]) / (2 * step * SCALE)


def against_soft(scene: Scene, layout: Layout, rays: str) -> list[float]:
    """The cosine with differences of the soft score, for each of :data:`STEPS`."""
    poses = np.asarray(layout.poses, float)
    with at_precision(True):
        # Not compiled as a whole: what is compiled within serves every device of a kind.
        of = score(scene, layout, rays)
        slope = np.asarray(jax.grad(of)(jnp.asarray(poses)))
        found = []
        for step in STEPS:
            values = [float(of(jnp.asarray(row))) for row in moved(poses, step)]
            found.append(cosine(slope, differences(values, step)))
    return found


def against_exact(
    scene: Scene, layout: Layout, rays: str, near: Float[np.ndarray, "K S 6"]
) -> float:
    """The cosine with differences of the exact score, both the mean over poses ``near`` by."""
    rows = np.concatenate([moved(poses, WIDE) for poses in near])
    values = inspe_jax.evaluate_many(scene, layout, rows).surrogate.reshape(len(near), -1)
    exact = np.mean([differences(row, WIDE) for row in values], 0)
    slope = jax.grad(score(scene, layout, rays))
    return cosine(np.mean([slope(jnp.asarray(poses, float)) for poses in near], 0), exact)


def feasible(scene: Scene, spec: Any, count: int, rng: np.random.Generator) -> Layout:
    """Sensors at random places: cameras turned at random, without roll; LiDARs level."""
    layout = random_layout(scene, [spec] * count, rng)
    poses = np.array(layout.poses, float)
    poses[:, 2] = np.maximum(poses[:, 2], 2.0)
    poses[:, 3 : 4 if spec.aimed else 5] = 0.0
    return replace(layout, poses=poses)


def main() -> None:
    """Compare, print and write."""
    options = arguments(__doc__)
    quick = options.quick
    build = partial(inspe_jax.build_scene, inspe_jax.built_in("four_way"), seed=options.seed)
    small = build(radius=20, frames=4, voxel=0.4, spacing=2.0)
    size: dict[str, Any] = dict(radius=20, voxel=0.4, spacing=2.0) if quick else dict(radius=30)
    whole = build(frames=4 if quick else 8, **size)
    names = ["paper-lidar-32"] if quick else list(inspe_jax.devices())
    readings = READINGS[:1] if quick else READINGS
    count, near = (2, 2) if quick else (4, 16)

    rows: list[dict[str, Any]] = []
    for name in track(names, "differences", console=console, transient=True):
        spec = inspe_jax.device(name).spec
        rng = np.random.default_rng(options.seed)
        few, layout = (feasible(scene, spec, count, rng) for scene in (small, whole))
        shifts = rng.uniform(-WIDE, WIDE, (near, count, 6)) * SCALE
        for rays in readings:
            soft = against_soft(small, few, rays)
            exact = against_exact(whole, layout, rays, np.asarray(layout.poses, float) + shifts)
            steps = {f"step_{step:g}": value for step, value in zip(STEPS, soft, strict=True)}
            rows.append(dict(device=name, rays=rays, **steps, exact=exact))

    table = Table(
        "device", "rays", *(f"{step:g}" for step in STEPS), "exact score",
        title=f"Cosine of the gradient with differences, softness {SOFTNESS} m",
    )  # fmt: skip
    table.columns[0].min_width = max(map(len, names))
    for row in rows:
        numbers = [row[f"step_{step:g}"] for step in STEPS] + [row["exact"]]
        table.add_row(row["device"], row["rays"], *(f"{number:.4f}" for number in numbers))
    console.print(table)
    stem = options.out / ("slopes_quick" if quick else "slopes")
    settings = dict(whole.settings, seed=options.seed, near=near, softness=SOFTNESS)
    write_results(stem.with_suffix(".csv"), rows, settings)
    console.print(f"wrote {stem}.csv and .json", highlight=False)


if __name__ == "__main__":
    main()
