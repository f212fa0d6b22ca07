"""Claim: the gradient of the soft score is its slope, and points where the exact score rises.

For every device of the catalogue, several sensors at random places on the built-in four-way. Two
questions are asked, with rays read as a density (and, with ``--exact-rays``, read exactly):

1. Does the gradient agree with central differences of the soft score over steps from 1e-2 to 1e-6,
   in double precision?
2. Does it agree with the slope of the exact score? That is a staircase, so both are slopes of means
   over a box of poses, within half a metre and 3° in every coordinate. The slope of the exact
   score's mean along a coordinate is the mean of its differences between the two faces of the box,
   over the other coordinates, drawn at random; that of the soft score is the mean of its gradient.
   Both are drawn at the same poses.

Agreement is the cosine between the two, over all coordinates of all sensors, where 1 m counts as
much as 0.1 rad. A coordinate that a sensor does not feel, as the yaw of a spinning LiDAR, has
nothing to agree on, and counts little.

A mean over few poses has noise, and noise makes a cosine smaller: two equal slopes of size g, of
which one is measured with noise of size n, have the cosine 1/√(1 + (n/g)²). So scalar products are
taken between different poses only, a U-statistic (Hoeffding 1948), in which noise is 0 on the mean;
such a cosine may exceed 1 by chance. Its standard error is that of the jackknife over poses. The
cosine of the two means is given, too.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from agreement import random_layout
from common import arguments, console, output, show, write_results
from jaxtyping import Float
from rich.progress import track

import inspe_jax
from inspe_jax import Layout, Scene, Softness
from inspe_jax.core.parallel import at_precision

STEPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
"""Steps of central differences, in units of :data:`SCALE`."""
SCALE = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1])
"""What one step of each coordinate is: metres and radians."""
WIDE = 0.5
"""Half the box of poses, in scales."""
SOFTNESS = 0.5
READINGS = ("density", "exact")

Slopes = Float[np.ndarray, "S 6"]


def cosine(one: Slopes, other: Slopes) -> float:
    """The cosine of the angle between two slopes, in units of :data:`SCALE`."""
    a, b = (one * SCALE).ravel(), (other * SCALE).ravel()
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def score(scene: Scene, layout: Layout, rays: str, width: float) -> Any:
    """P_sm of poses, read softly with ``width`` [m]."""
    softness = Softness(width, width, rays)

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


def against_soft(scene: Scene, layout: Layout, rays: str, width: float) -> list[float]:
    """The cosine with differences of the soft score, for each of :data:`STEPS`."""
    poses = np.asarray(layout.poses, float)
    with at_precision(True):
        # Not compiled as a whole: what is compiled within serves every device of a kind.
        of = score(scene, layout, rays, width)
        slope = np.asarray(jax.grad(of)(jnp.asarray(poses)))
        found = []
        for step in STEPS:
            values = [float(of(jnp.asarray(row))) for row in moved(poses, step)]
            found.append(cosine(slope, differences(values, step)))
    return found


def faces(poses: Slopes, shift: Slopes) -> Float[np.ndarray, "S*12 S 6"]:
    """Poses on the faces of the box: every coordinate :data:`WIDE` forward and back from where it
    is, with all others shifted."""
    rows = moved(poses + shift, WIDE)
    for row, pair in enumerate(rows.reshape(-1, 2, *poses.shape)):
        s, k = divmod(row, 6)
        pair[:, s, k] -= shift[s, k]
    return rows


def cosine_of_means(a: Float[np.ndarray, "K n"], b: Float[np.ndarray, "K n"]) -> float:
    """The cosine of the means of ``a`` and ``b``, from products of different rows only."""
    found = []
    for one, other in ((a, b), (a, a), (b, b)):
        found.append(one.sum(0) @ other.sum(0) - (one * other).sum())
    across, ours, theirs = found
    return float(across / np.sqrt(max(ours, 1e-30) * max(theirs, 1e-30)))


def against_exact(
    scene: Scene, layout: Layout, rays: str, shifts: Float[np.ndarray, "K S 6"], width: float
) -> dict[str, float]:
    """How the slopes of soft and exact score agree, both the mean over K poses.

    ``cosine`` is free of the poses' noise and has the error ``cosine_error``; ``plain_cosine`` is
    that of the means. ``noise`` is the standard error of the exact score's slope over its size.
    """
    poses = np.asarray(layout.poses, float)
    gradient = jax.grad(score(scene, layout, rays, width))
    soft, exact = [], []
    for shift in shifts:
        values = inspe_jax.evaluate_many(scene, layout, faces(poses, shift)).surrogate
        exact.append((differences(values, WIDE) * SCALE).ravel())
        soft.append((np.asarray(gradient(jnp.asarray(poses + shift, float))) * SCALE).ravel())
    a, b = np.array(soft), np.array(exact)
    count = len(a)
    without = np.array(
        [cosine_of_means(*(np.delete(x, k, 0) for x in (a, b))) for k in range(count)]
    )
    error = np.sqrt((count - 1) * without.var())
    noise = np.sqrt(b.var(0, ddof=1).sum() / count) / np.linalg.norm(b.mean(0))
    plain = a.mean(0) @ b.mean(0) / (np.linalg.norm(a.mean(0)) * np.linalg.norm(b.mean(0)))
    return dict(
        cosine=cosine_of_means(a, b),
        cosine_error=float(error),
        plain_cosine=float(plain),
        noise=float(noise),
    )


def feasible(scene: Scene, spec: Any, count: int, rng: np.random.Generator) -> Layout:
    """Sensors at random places: cameras turned at random, without roll; LiDARs level."""
    layout = random_layout(scene, [spec] * count, rng)
    poses = np.array(layout.poses, float)
    poses[:, 2] = np.maximum(poses[:, 2], 2.0)
    poses[:, 3 : 4 if spec.aimed else 5] = 0.0
    return replace(layout, poses=poses)


def main() -> None:
    """Compare, print and write."""
    options = arguments(
        __doc__,
        "seed",
        poses=dict(type=int, default=16, help="poses of the second question's means"),
        softness=dict(type=float, default=SOFTNESS, help="width [m]"),
        exact_rays=dict(action="store_true", help="also with rays read exactly"),
        device=dict(action="append", help="only this device; repeat it for more"),
    )
    quick, width = options.quick, options.softness
    build = partial(inspe_jax.build_scene, inspe_jax.built_in("four_way"), seed=options.seed)
    small = build(radius=12 if quick else 20, frames=4, voxel=0.4, spacing=2.0)
    whole = small if quick else build(frames=8, radius=30)
    names = options.device or (["paper-lidar-32"] if quick else list(inspe_jax.devices()))
    readings = READINGS if options.exact_rays else READINGS[:1]
    least, count, near = (1, 2, 2) if quick else (2, 4, options.poses)

    rows: list[dict[str, Any]] = []
    for name in track(names, "differences", console=console, transient=True):
        spec = inspe_jax.device(name).spec
        rng = np.random.default_rng(options.seed)
        few, layout = (
            feasible(scene, spec, n, rng) for scene, n in ((small, least), (whole, count))
        )
        shifts = rng.uniform(-WIDE, WIDE, (near, count, 6)) * SCALE
        for rays in readings:
            soft = against_soft(small, few, rays, width)
            steps = {f"step_{step:g}": value for step, value in zip(STEPS, soft, strict=True)}
            found = against_exact(whole, layout, rays, shifts, width)
            rows.append(dict(device=name, rays=rays, **steps, **found))

    shown = []
    for row in rows:
        worst = min(row[f"step_{step:g}"] for step in STEPS)
        name = row["device"] if row["rays"] == "density" else f"{row['device']}, exact rays"
        cells = f"{row['cosine']:.3f} ± {row['cosine_error']:.3f}", f"{row['plain_cosine']:.3f}"
        shown.append((name, f"{worst:.4f}", *cells, f"{row['noise']:.2f}"))
    title = f"Cosine of the gradient with differences, softness {width} m, {near} poses"
    show(("device", "worst\nstep", "exact score", "plain", "noise"), shown, title)
    settings = dict(whole.settings, seed=options.seed, near=near, softness=width)
    write_results(output(options, "slopes"), rows, settings)


if __name__ == "__main__":
    main()
