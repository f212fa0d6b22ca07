"""Claim: among candidate poses, greedy finds about 95 % of the optimum or more.

One instance small enough to be solved: the built-in four-way in coarse voxels, a camera of
reliability 1 on each of four units, and candidate poses for all of them (feet × heights ×
yaws × pitches). What each candidate has in view and sees is found on all voxels and frames.
An integer program (HiGHS) gives the best k of the candidates, and a bound that no k of them
can exceed; plain greedy, without the exchanges and moves of the method of that name,
is reported as a share of the optimum: 95.7, 99.6 and 94.8 % with seeds 0, 1 and 2. So is every
search. Searches have the candidates' height and the range of their pitches, and are free in
between: they can come to more than 100 %, as the optimum is only that of the candidates.
"""

import time
from typing import Any

import numpy as np
from common import arguments, console, output, show, write_results
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, milp

import inspe_jax
from inspe_jax import Constraints, Layout, Scene, Sensor
from inspe_jax.placement.candidate_table import CandidateKind
from inspe_jax.placement.candidate_table import Table as Candidates
from inspe_jax.placement.candidates import lattice
from inspe_jax.placement.greedy_placement import lazy_greedy
from inspe_jax.placement.problem import Problem
from inspe_jax.placement.sampled_objective import SampledObjective, joined, one_tile_a_slab
from inspe_jax.scoring.metrics import entropy
from inspe_jax.visibility import bitmask

ALL = 10**9
"""More columns and frames than there are."""
HEIGHT = 6.0
PITCHES = np.radians([-25.0, -12.0])
"""Height [m] and pitches of all candidates, and the limits of the searches."""


def instance(quick: bool, seed: int) -> tuple[Scene, Layout]:
    """The scene, and one ideal camera on each unit of the paper's Cam-d1."""
    radius, voxel, frames = (25.0, 2.0, 3) if quick else (50.0, 1.0, 10)
    scene = inspe_jax.build_scene(
        inspe_jax.built_in("four_way"),
        profile="ideal",
        radius=radius,
        voxel=voxel,
        frames=frames,
        seed=seed,
    )
    given = inspe_jax.strategy(scene, "Cam-d1")
    first = [members[0] for members in given.members()]
    sensors = [
        Sensor(f"camera {u}", given.sensors[s].spec.with_performance(1.0), u)
        for u, s in enumerate(first)
    ]
    poses = np.asarray(given.poses)[first]
    return scene, inspe_jax.make_layout(sensors, list(given.units), poses, "four cameras")


def candidates(problem: Problem, quick: bool, seed: int) -> Candidates:
    """Candidate poses, the same for every camera, and all that they see."""
    layout, space = problem.layout, problem.space
    sampled = SampledObjective(problem, problem.sample(np.random.default_rng(seed), ALL, ALL))
    feet = lattice(space, 6 if quick else 16)
    stand = space.can_stand(feet)
    common = np.flatnonzero(stand.all(0))
    yaws = np.radians(np.arange(0, 360, 60))
    foot, height, yaw, pitch = (
        part.ravel() for part in np.meshgrid(common, [HEIGHT], yaws, PITCHES, indexing="ij")
    )
    lens = np.zeros(len(foot))
    kind = CandidateKind(tuple(range(len(layout))), foot, height, yaw, pitch, lens)
    table = Candidates(problem, sampled, feet, stand, [kind])
    for part in range(len(table.parts)):
        table.look(part)
    return table


def best_subset(
    seen: np.ndarray, worth: np.ndarray, k: int, seconds: float
) -> tuple[np.ndarray, float, float]:
    """The k of K candidates that together see most: maximum coverage, as an integer program.

    ``seen`` (K, E) says which elements each candidate sees, ``worth`` (E,) what each is worth.
    Returns the chosen candidates (k,), what they see together, and an upper bound of that for any
    choice, after at most so many ``seconds``. y says whether a candidate is chosen; z whether the
    elements that one set of candidates sees are covered: z ≤ 1 and z ≤ Σ y over the set.
    """
    count, some = len(seen), seen.any(0) & (worth > 0)
    packed = np.packbits(seen[:, some], axis=0).T
    _, first, back = np.unique(packed, axis=0, return_index=True, return_inverse=True)
    sets, together = seen[:, some][:, first], np.bincount(back.ravel(), worth[some])
    gain = np.concatenate([np.zeros(count), together])
    covered = sparse.hstack([-sparse.csr_array(sets.T.astype(float)), sparse.eye_array(len(first))])
    number = (np.arange(len(gain)) < count).astype(float)
    found = milp(
        -gain,
        integrality=number,
        bounds=Bounds(0, 1),
        constraints=[LinearConstraint(covered, -np.inf, 0), LinearConstraint(number, k, k)],
        options=dict(time_limit=seconds, mip_rel_gap=1e-6),
    )
    if found.x is None:
        raise SystemExit(f"no choice was found in {seconds:g} s: {found.message}")
    chosen = np.sort(np.argsort(-found.x[:count], kind="stable")[:k])
    return chosen, float(worth[seen[chosen].any(0)].sum()), float(-found.mip_dual_bound)


def elements(table: Candidates) -> tuple[np.ndarray, np.ndarray]:
    """What each of K candidates sees, (K, E), and what each element is worth, (E,).

    Elements are the voxels in view and the voxels seen in each frame. The worth is P_sm written by
    hand: cameras of reliability 1 resolve all that they have in view, so IG is of a union, too.
    """
    kind, count = table.kinds[0], table.kinds[0].looked
    (rows,), (tiled,) = joined(kind.rows), map(one_tile_a_slab, table.sampled.sample.scenes)
    (chunk,), levels = tiled.chunks, tiled.tiles.level_count
    assert levels <= bitmask.WORD, "elements are of one slab of levels"
    seen, view, there, solid = (
        bitmask.unpack(np.asarray(x)[..., None], levels)
        for x in (
            rows.seen[:count, 0],
            rows.view[:count, 0],
            chunk.tile.there[0],
            np.asarray(chunk.solid)[0],
        )
    )
    weight = np.asarray(tiled.weight, float)[:, None] * there
    free = (there & ~solid).astype(float)
    left = np.asarray(entropy(tiled.occupancy[0])).T
    in_view = 0.3 * weight / weight.sum() + 0.2 * left / left.sum()
    in_frames = 0.5 * free / free.sum((1, 2), keepdims=True) / len(free)
    each = np.concatenate([part.reshape(count, -1) for part in (view, seen)], 1)
    return each, np.concatenate([in_view.ravel(), in_frames.ravel()])


def discrete(table: Candidates, seconds: float) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The optimum and greedy's choice: a row each; and the instance's figures."""
    problem, sampled = table.problem, table.sampled
    scene = problem.cases[0].scene
    k, count = len(problem.layout), table.kinds[0].looked
    seen, worth = elements(table)
    began = time.perf_counter()
    chosen, value, bound = best_subset(seen, worth, k, seconds)
    solved = time.perf_counter()
    picks, again = lazy_greedy(table)
    done = time.perf_counter()
    start = problem.space.start(problem.layout)[0]
    best = dict(enumerate(chosen.tolist()))
    scored = sampled.value(table.rows(best))
    assert abs(value - scored) < 1e-4, f"the elements are worth {value}, the set {scored}"
    rows = [
        dict(method=name, seed="", score=problem.exact(table.layout(start, chosen)), seconds=took)
        for name, chosen, took in (
            ("optimum of the candidates", best, solved - began),
            ("plain greedy", picks, done - solved),
        )
    ]
    figures = dict(
        candidates=count,
        cameras=k,
        voxels=scene.voxels.count,
        frames=scene.traffic.frame_count,
        bound=bound,
        gap=bound - value,
        gains_worked_out=count + again,
        gains_of_plain_greedy=sum(count - n for n in range(k)),
    )
    return rows, figures


def searches(scene: Scene, layout: Layout, quick: bool) -> list[dict[str, Any]]:
    """Searches from the given layout, under the candidates' limits: a row each and seed."""
    limits = Constraints(
        heights=(HEIGHT, HEIGHT),
        pitch={"camera": (PITCHES.min(), PITCHES.max()), "lidar": (-0.5, 0.5)},
    )
    methods = ("greedy",) if quick else tuple(inspe_jax.methods())
    seconds, seeds = (0.5, 1) if quick else (10.0, 5)
    with console.status("searching") as status:
        found = inspe_jax.compare(
            scene, layout, methods, seconds=seconds, seeds=seeds, constraints=limits,
            progress=lambda name, seed, _, best: status.update(f"{name} {seed}: best {best:.4f}"),
        )  # fmt: skip
    return [dict(method=r.method, seed=r.seed, score=r.objective, seconds=r.seconds) for r in found]


def main() -> None:
    """Solve, compare, print and write."""
    options = arguments(__doc__, "seed")
    scene, layout = instance(options.quick, options.seed)
    problem = Problem(scene, layout)
    with console.status("looking at candidates"):
        table = candidates(problem, options.quick, options.seed)
    with console.status("solving the integer program"):
        rows, figures = discrete(table, 60.0 if options.quick else 600.0)
    rows += searches(scene, layout, options.quick)
    optimum = rows[0]["score"]
    for row in rows:
        row["share"] = row["score"] / optimum

    show(
        ("method", "seed", "P_sm", "share of\noptimum", "seconds"),
        [
            (r["method"], r["seed"])
            + (f"{r['score']:.4f}", f"{r['share']:.2%}", f"{r['seconds']:.2f}")
            for r in rows
        ],
        f"{figures['cameras']} of {figures['candidates']} candidate poses on {scene.name}",
    )
    console.print(
        f"no choice exceeds {figures['bound']:.6f}; lazy evaluation worked out "
        f"{figures['gains_worked_out']} gains, plain greedy {figures['gains_of_plain_greedy']}"
    )
    settings = dict(scene.settings, seed=options.seed, **figures)
    write_results(output(options, "discrete_reference"), rows, settings)


if __name__ == "__main__":
    main()
