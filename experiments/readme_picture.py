"""Claim: the README's picture is a real result, and this is how it is made.

Scores the eight corner cameras of the built-in four-way and draws how often each
column is seen; the same as ``inspe score four_way Cam-d1 --plot four_way.png``.
"""

from typing import Any

from common import arguments, write_results

import inspe_jax
from inspe_jax.report.figures import plan_view
from inspe_jax.report.sheet import save_figure


def main() -> None:
    """Score, draw and write."""
    options = arguments(__doc__)
    size: dict[str, Any] = dict(radius=25.0, voxel=1.0, frames=5) if options.quick else {}
    scene = inspe_jax.build_scene(inspe_jax.built_in("four_way"), **size, seed=options.seed)
    layout = inspe_jax.strategy(scene, "Cam-d1")
    scores = inspe_jax.evaluate(scene, layout)
    picture = options.out / "four_way.png"
    save_figure(plan_view(scene, layout, scores), picture)
    names = ("coverage", "occlusion", "information_gain", "surrogate")
    row = {name: getattr(scores, name) for name in names}
    write_results(options.out / "four_way.csv", [row], dict(scene.settings))
    print(f"wrote {picture}, .csv and .json")


if __name__ == "__main__":
    main()
