"""Claim: the pictures of the README and the guides are real results, and this is how they are made.

Scores the eight corner cameras of the built-in four-way and draws how often each
column is seen; the same as ``inspe score four_way Cam-d1 --plot four_way.png``. Draws what a
pedestrian gets with Cam-d1/L-d1, as ``inspe targets`` does. And, where there is Chromium, takes a
picture of what ``inspe view roundabout Cam-d1`` serves.
"""

import tempfile
from pathlib import Path
from typing import Any

from common import CHROMIUM, METRICS, arguments, browser_on, write_results

import inspe_jax
from inspe_jax.core.sheet import save_figure
from inspe_jax.placement.problem import Case
from inspe_jax.report.figures import plan_view
from inspe_jax.report.targets import targets_view
from inspe_jax.viewer.app import Viewer

SCROLLED = 330
"""The panel is scrolled by so much, to what the selected camera sees [pixel]."""


def main() -> None:
    """Score, draw and write."""
    options = arguments(__doc__, "seed")
    size: dict[str, Any] = (
        dict(radius=15.0, voxel=1.0, frames=3, density=8) if options.quick else {}
    )
    scene = inspe_jax.build_scene(inspe_jax.built_in("four_way"), **size, seed=options.seed)
    layout = inspe_jax.strategy(scene, "Cam-d1")
    scores = inspe_jax.evaluate(scene, layout)
    picture = options.out / "four_way.png"
    save_figure(plan_view(scene, layout, scores), picture)
    row = {name: scores.value(name) for name in METRICS}
    write_results(options.out / "four_way", [row], dict(scene.settings))
    both = inspe_jax.strategy(scene, "Cam-d1/L-d1")
    picture = options.out / "targets.png"
    save_figure(targets_view(scene, both, inspe_jax.target_view(scene, both)), picture)
    print(f"wrote {picture}")
    if CHROMIUM is None:
        print("no Chromium here: view.png is left out")
        return
    scene = inspe_jax.build_scene(inspe_jax.built_in("roundabout"), **size, seed=options.seed)
    with tempfile.TemporaryDirectory() as folder:
        case, layout = Case(scene), inspe_jax.strategy(scene, "Cam-d1")
        viewer = Viewer(case, layout, Path(folder) / "layout.yaml", port=0)
        try:
            with browser_on(viewer.url) as tab:
                tab.get_by_alt_text("Plan view").wait_for(timeout=60_000)
                window = tab.viewport_size
                tab.mouse.move(window["width"] - 150, window["height"] / 2)
                tab.mouse.wheel(0, SCROLLED)
                tab.mouse.move(5, 5)  # nothing is explained there
                tab.wait_for_timeout(3000)
                tab.screenshot(path=options.out / "view.png")
        finally:
            viewer.close()
    print(f"wrote {options.out / 'view.png'}")


if __name__ == "__main__":
    main()
