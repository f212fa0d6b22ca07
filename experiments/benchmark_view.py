"""Claim: a sensor let go has scores in 0.3 s, a plan view in 1 s; the page answers in 0.3 s.

All in the median; the page also while it scores and searches, unless it draws in 3-D by software.

W1 of `benchmark_speed.py`: 152 520 voxels, 12 sensors, 100 frames of 40 road users. Once without a
browser and, where there is Chromium, with one on the same cores: twice, since without a graphics
card its drawing takes most of the time. One leaves out what is drawn in three dimensions, as though
a card did it at once, and one draws it in software.

Scores: sensors are dragged as a browser drags them, by events of the handle: a start, an event
every 50 ms, an end. Timed from the end to the scores on the page's panel, of 20 frames and of all,
with mounting, the shown frame's voxels and all that is drawn; and to the plan view of all frames,
with its blind spots.

Answers: another sensor is chosen, which is what can be done at any time, at rest, while all frames
are scored over and over, and while a search runs, from its button on, with all that it compiles.
With a browser, timed in the page, from a click in the list of sensors to the picture in which all
five numbers of the pose are the chosen sensor's, which the server tells. Without one, from an event
handed to the server's loop to the end of what it asks of the queue.
"""

import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from queue import Queue
from types import SimpleNamespace
from typing import Any

import numpy as np
from benchmark_speed import sensors, workload
from common import CHROMIUM, arguments, browser_on, console, machine, output, show, write_results

from inspe_jax.core.geometry import rotation
from inspe_jax.placement.problem import Case
from inspe_jax.viewer.app import Viewer
from inspe_jax.viewer.browser_view import BrowserView
from inspe_jax.viewer.panel import BLIND_SPOTS, POSE, set_value
from inspe_jax.viewer.scene3d import HandleDrag

Ready = Callable[[], object]
"""Comes back when something can be timed."""

STEPS, EVERY = 5, 0.05
"""Events of one drag, and the time between two [s]."""
PAUSE = (0.3, 1.0)
"""From one answer to the next choice, least and most [s]."""
LONG = 600.0
"""What a search is given, which is stopped before [s]."""
BROWSERS = ("no browser", "a browser, nothing in 3-D", "a browser, 3-D in software")
SCORES = {"few": "20 frames", "all": "all frames", "plan": "plan view of all frames"}
ANSWERS = ("at rest", "while it scores", "while it searches")

LOOK = """wanted => {
    const labels = [...document.querySelectorAll('label')];
    const input = name => labels.find(label => label.textContent === name).control;
    const shown = Object.entries(wanted).map(([name, value]) => [input(name), value]);
    const there = () => shown.every(([box, value]) => Math.abs(box.value - value) < 0.05);
    window.answered = null;
    const clicked = event => {
        if (!event.isTrusted || !event.target.closest('[role="option"]')) return;
        document.removeEventListener('click', clicked, true);
        const look = () => {
            if (there()) window.answered = (performance.now() - event.timeStamp) / 1000;
            else requestAnimationFrame(look);
        };
        look();
    };
    document.addEventListener('click', clicked, true);
}"""
"""In the page: from the next click on an option to the picture in which these numbers stand."""


def view_of(viewer: Viewer) -> BrowserView:
    """What the only browser has of its own."""
    (view,) = viewer.views.values()
    return view


def drag(viewer: Viewer, s: int, rng: np.random.Generator) -> dict[str, float]:
    """Drag one sensor some metres and turn it; seconds to the scores of few and of all frames, and
    to the plan view of all."""
    heard: dict[str, float] = {}
    told, view, spots = viewer.panel.headline, view_of(viewer), viewer.panel.blind_spots
    picture = viewer.display.blind_spots.picture

    view.select(s)
    pose = np.array(viewer.layout.poses[s], float)
    turn, at = rotation(np.array([0.0, 0.0, pose[5]]), np), pose[:3]
    away = np.append(rng.uniform(-3, 3, 2), rng.uniform(-1, 1))
    view.on_drag(HandleDrag("start", at, turn))
    for k in range(1, STEPS + 1):
        view.on_drag(HandleDrag("update", at + away * k / STEPS, turn))
        time.sleep(EVERY)
    before, drawn, began = viewer.layout, picture.content, time.monotonic()
    view.on_drag(HandleDrag("end", at + away, turn))
    while len(heard) < len(SCORES):
        time.sleep(0.002)
        now, scored = time.monotonic() - began, viewer.display.scored
        if viewer.layout is before or scored is None or scored.layout is not viewer.layout:
            continue
        assert scored.scores is not None
        whole = scored.frames == viewer.frames
        if f'data-score="{scored.scores.surrogate}"' in told.content:
            heard.setdefault("few", now)
            if whole:
                heard.setdefault("all", now)
        if "all" in heard and picture.content != drawn and spots.label == BLIND_SPOTS:
            heard.setdefault("plan", now)
    return heard


def on_server(viewer: Viewer, s: int) -> float:
    """Choose a sensor by an event of the server's; seconds until the queue has done it."""
    done: Queue[float] = Queue()

    def event() -> None:
        view_of(viewer).select(s)
        end = partial(viewer.queue.submit, lambda: done.put(time.monotonic()))
        viewer.queue.submit(end)  # what it asks for is shown by what follows

    began = time.monotonic()
    viewer.server.get_event_loop().call_soon_threadsafe(event)
    return done.get() - began


def in_page(tab: Any, viewer: Viewer, s: int) -> float:
    """Choose a sensor in the page's list; seconds until the page shows its pose."""
    pose = viewer.session.numbers(viewer.layout, s)
    tab.get_by_label("Sensor", exact=True).click(force=True)
    tab.evaluate(LOOK, {POSE[key]: round(float(value), 1) for key, value in pose.items()})
    tab.get_by_role("option").nth(s).click()
    tab.wait_for_function("() => window.answered !== null", timeout=120_000)
    return float(tab.evaluate("() => window.answered"))


def answers(
    viewer: Viewer, tab: Any, count: int, rng: np.random.Generator, ready: Ready
) -> Iterator[float]:
    """Choose one sensor after another, of another unit each time, whenever it is ready."""
    for _ in range(count):
        time.sleep(rng.uniform(*PAUSE))
        s = (view_of(viewer).selection[-1] + 5) % len(viewer.layout)
        ready()
        yield on_server(viewer, s) if tab is None else in_page(tab, viewer, s)


@contextmanager
def scoring(viewer: Viewer) -> Iterator[Ready]:
    """The layout is scored over and over; gives what waits until that of all frames has begun."""
    scorer, begun, on = viewer.scorer, threading.Event(), True
    sighted, scored, waiting = scorer._sighted, scorer._scored, scorer._queue._waiting

    def hear_sight(*found: Any) -> None:
        sighted(*found)
        begun.set()  # all frames are next

    def hear_scores(found: Any) -> None:
        scored(found)
        if found.frames == viewer.frames and "whole" not in waiting:  # few may be all
            begun.clear()
            if on:
                scorer.score(viewer.layout, whole=True)

    scorer._sighted, scorer._scored = hear_sight, hear_scores
    scorer.score(viewer.layout, whole=True)
    try:
        yield begun.wait
    finally:
        on = False
        wait_until(lambda: not begun.is_set() and not waiting)
        scorer._sighted, scorer._scored = sighted, scored


@contextmanager
def searching(viewer: Viewer, tab: Any) -> Iterator[Ready]:
    """A search runs, begun as by its button; gives what makes sure that it still does."""

    def check() -> None:
        assert viewer.searching

    set_value(viewer.panel.seconds, LONG)
    if tab is None:
        viewer.optimise()
    else:
        tab.get_by_role("button", name="Optimise from here").click()
    wait_until(lambda: viewer.searching)
    try:
        yield check
    finally:
        viewer.queue.submit(viewer.searcher.stop)
        wait_until(lambda: not viewer.searching)


def wait_until(true: Callable[[], bool]) -> None:
    """Look often whether it is."""
    while not true():
        time.sleep(0.01)


def measured(
    viewer: Viewer, tab: Any, counts: dict[str, int], rng: np.random.Generator
) -> Iterator[dict[str, Any]]:
    """What was ``timed``, and how long it took, in ``seconds``; ``after`` how many it was done."""
    drag(viewer, 0, rng)  # compiles
    began = time.monotonic()
    for k in range(counts["drags"]):
        found = drag(viewer, k % len(viewer.layout), rng)
        for key, name in SCORES.items():
            yield dict(timed=name, after=time.monotonic() - began, seconds=found[key])
    time.sleep(2.0)  # until all is drawn
    states: list[AbstractContextManager[Ready]]
    states = [nullcontext(lambda: None), scoring(viewer), searching(viewer, tab)]
    for name, state in zip(ANSWERS, states, strict=True):
        began = time.monotonic()
        with state as ready:
            for seconds in answers(viewer, tab, counts[name], rng, ready):
                yield dict(timed=name, after=time.monotonic() - began, seconds=seconds)


def times_of(rows: list[dict[str, Any]]) -> dict[tuple[str, str], list[float]]:
    """All times of what was timed, without a browser and with one."""
    found: dict[tuple[str, str], list[float]] = {}
    for row in rows:
        found.setdefault((row["timed"], row["browser"]), []).append(row["seconds"])
    return found


def main() -> None:
    """Run and report."""
    given = arguments(__doc__, "seed")
    scene = workload("quick" if given.quick else "W1", given.seed)
    layout = sensors(scene)
    many = (1, 1, 1, 1) if given.quick else (30, 20, 20, 40)  # searches compile long
    counts = dict(zip(("drags", *ANSWERS), many, strict=True))
    rows: list[dict[str, Any]] = []
    looked = BROWSERS[:1] if CHROMIUM is None or given.quick else BROWSERS
    if looked != BROWSERS:
        console.print("no browser" if CHROMIUM is None else "left out when quick: a browser")
    for browser in looked:
        rng = np.random.default_rng(given.seed)
        with tempfile.TemporaryDirectory() as folder:
            viewer = Viewer(Case(scene), layout, Path(folder) / "w1.yaml", port=0)
            try:
                looking, drawn = browser != BROWSERS[0], browser == BROWSERS[2]
                if not looking:  # the page's own panel and scene stand for a browser's
                    own = SimpleNamespace(
                        client_id=-1, gui=viewer.server.gui, scene=viewer.server.scene
                    )
                    viewer.queue.submit(partial(viewer.open_view, own))
                with browser_on(viewer.url, drawn=drawn) if looking else nullcontext() as tab:
                    wait_until(partial(bool, viewer.views))
                    timed = measured(viewer, tab, counts, rng)
                    rows += [{"browser": browser, **row} for row in timed]
            finally:
                viewer.close()
    found, cells = times_of(rows), []
    for name in (*SCORES.values(), *ANSWERS):
        times = [found[name, browser] for browser in looked]
        cells.append((name, *(f"{np.median(of):.3f} ({max(of):.3f})" for of in times)))
    show(("", *looked), cells, "median (most), in seconds")
    console.print(" · ".join(f"{key} {value}" for key, value in machine().items()))
    settings = {"seed": given.seed, "quick": given.quick, **counts}
    write_results(output(given, "benchmark_view"), rows, settings)


if __name__ == "__main__":
    main()
