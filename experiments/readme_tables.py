"""Writes the tables of experiments/README.md from the CSV beside it.

A table stands between a line ``<!-- NAME -->``, with the name of a function of this module, and a
line ``<!-- end -->``.
"""

import itertools
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from common import METRICS, markdown, read_rows, with_interval
from scipy.stats import ttest_1samp
from table1 import COMPARED, correlation

from inspe_jax.core.files import write_text

HERE = Path(__file__).resolve().parent
README = HERE / "README.md"
PLACEMENTS = [
    *("Cam-c", "Cam-d1", "Cam-d2", "L-c", "L-d1", "L-d2"),
    *("Cam-c/L-c", "Cam-d1/L-d1", "Cam-d2/L-d2"),
]
HELD_OUT = {"places": ("Town03 five-way", "Town04 T"), "time": ()}
"""Intersections at which a detector is measured, by what was held out; all where none is named."""
FOUND = {"L-d1": "coalign", "L-d2": "coalign", "L-c": "coalign", "Cam-d2": "lss-resnet"}
"""Placements from which searches start, and the detector that is trained under each."""
DOWN, HUNG = "Cam-d2, 25° down", "Cam-d2, hung as InSPE's"
DIFFERS = {
    "lss-eff": "lifts by height above the road, not by depth; mean, not sum, of what falls into a "
    "cell; 4 blocks of EfficientNet-B0's 16, not pre-trained; also learns heat on pictures",
    "lss-resnet": "as lss-eff, with 4 blocks of ResNet-101's 33",
    "v2vnet": "messages are not compressed; no perceptron on the last state",
    "v2x-vit": "agents are of one type, so attention by type has one; no delay",
    "coalign": "no pose graph, nor the boxes that it aligns",
    "attfuse": "cameras are agents, too",
    "disconet": "cameras are agents, too, but the teacher has LiDARs alone; one map is taught, not "
    "four; edges of 32 and 8 channels, not 128, 32 and 8",
    "hm-vit": "one of two blocks; modalities share norms, perceptrons and head; no bias by "
    "the offset of cells",
}
"""What a detector has otherwise than the published one, besides what all have."""
USERS = ("car", "truck", "cyclist", "pedestrian")

Row = dict[str, str]


def rows_of(name: str, **having: str) -> list[Row]:
    """The rows of a CSV that have these values."""
    found = read_rows(HERE / f"{name}.csv")
    return [row for row in found if all(row[key] == value for key, value in having.items())]


def numbers(rows: Iterable[Row], key: str) -> np.ndarray:
    """A column of rows."""
    return np.array([float(row[key]) for row in rows])


def values(rows: Iterable[Row], key: str) -> list[str]:
    """What a column has, each once, in its order."""
    return list(dict.fromkeys(row[key] for row in rows))


def slopes() -> str:
    """Cosines of gradients with differences: of the soft score, and of the exact score's mean."""
    cameras = [r for r in rows_of("slopes") if re.search("camera|aca", r["device"])]
    rows = []
    for kind, own in {
        "cameras": cameras,
        "LiDARs": [r for r in rows_of("slopes") if r not in cameras],
    }.items():
        soft = min(numbers(own, key).min() for key in own[0] if key.startswith("step_"))
        exact = numbers(own, "cosine")
        ends = f"{exact.min():.3f}, {np.median(exact):.3f}, {exact.max():.3f}"
        rows.append([kind, f"{len(own)}", f"{soft:.4f}", ends])
    return markdown(["", "devices", "soft score: least", "exact score: least, median, most"], rows)


def phases() -> str:
    """Biases of soft scores against the mean of exact ones over phases: least, median, most."""
    rows = []
    for metric, symbol in METRICS.items():
        own = rows_of("phases", metric=metric)
        cells = [symbol]
        for key in ("bias_0.001", "bias_0.5"):
            bias = numbers(own, key)
            most = own[int(np.argmax(bias))]["device"]
            cells += [f"{bias.min():+.4f}, {np.median(bias):+.4f}, {bias.max():+.4f}", most]
        rows.append(cells)
    return markdown(["", "width 0.001 m", "most", "width 0.5 m", "most"], rows)


def searches() -> str:
    """How near searches come to the best known of each cell, how soon they are within a hundredth,
    and how they end beside the default: of a cell the median over seeds, then over places the mean,
    its interval and the median."""
    moments, found = (3.0, 10.0, 30.0), []
    rows = rows_of("gradient_vs_grid")
    best = {(r["place"], r["mix"]): float(r["score"]) for r in rows_of("best_known")}
    for mix in values(rows, "mix"):
        ends = dict[str, dict[str, float]]()
        for method in values([row for row in rows if row["mix"] == mix], "method"):
            shares, soon, ends[method] = [], [], {}
            own = [row for row in rows if (row["mix"], row["method"]) == (mix, method)]
            for place in values(own, "place"):
                of = best[place, mix]
                told = [rises(row["rises"]) for row in own if row["place"] == place]
                at = [[max(b for s, b in one if s <= t) / of for t in moments] for one in told]
                shares.append(100 * np.median(at, 0))
                near = [next((s for s, b in one if b >= 0.99 * of), np.inf) for one in told]
                soon.append(float(np.median(near)))
                ends[method][place] = shares[-1][-1]
            half, count = float(np.median(soon)), int(np.isfinite(soon).sum())
            first = ends["greedy-adam"]
            less = [end - first[place] for place, end in ends[method].items()]
            beside = "" if method == "greedy-adam" else interval(less)
            mean = np.mean([score for (_, of_mix), score in best.items() if of_mix == mix])
            cells = [f"{x:.1f}" for x in np.mean(shares, 0)] + [beside]
            cells += [f"{half:.0f} s" if np.isfinite(half) else "–", f"{count} of {len(soon)}"]
            found.append([mix, f"{mean:.4f}", method, *cells])
    heads = [f"after {t:g} s" for t in moments] + ["beside the default", "to 99 %", "cells"]
    return markdown(["sensors", "best known", "method", *heads], found)


def interval(differences: Iterable[float], digits: int = 1) -> str:
    """A mean, and its interval of 95 % by Student's t."""
    given = np.array([*differences])
    low, high = ttest_1samp(given, 0.0).confidence_interval()
    return f"{given.mean():+.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


def rises(text: str) -> list[tuple[float, float]]:
    """Seconds and best scores of a search."""
    return [(float(a), float(b)) for a, b in (part.split(":") for part in text.split())]


def detectability() -> str:
    """D and P_sm of placements: median, and the range between the quartiles."""
    columns = [(p, m) for p in ("ideal", "paper") for m in ("D", "P_sm")]
    rows = [
        [layouts]
        + [
            f"{float(row['median']):.3f}, {float(row['iqr']):.3f}"
            for profile, metric in columns
            for row in rows_of("detectability", profile=profile, metric=metric, layouts=layouts)
        ]
        for layouts in ("the nine placements", "all at random")
    ]
    return markdown(["layouts", *(f"{metric}, {profile}" for profile, metric in columns)], rows)


def by_placement(
    heads: Iterable[str], cells: Callable[[str], list[str]], placements: Iterable[str] = PLACEMENTS
) -> str:
    """A table with a row for each of some placements, the nine if none are given."""
    rows = [[placement, *cells(placement)] for placement in placements]
    return markdown(["placement", *heads], rows)


def table2() -> str:
    """The nine placements on the ten intersections: mean ± standard deviation."""
    return by_placement(
        METRICS.values(),
        lambda placement: [
            f"{float(row['mean']):.3f} ± {float(row['std']):.3f}"
            for metric in METRICS
            for row in rows_of("table2", placement=placement, metric=metric)
        ],
    )


def mean_ap(file: str, of: str, placement: str, model: str | None = None) -> float:
    """mAP [%]: the mean over road users, seeds and, unless one is named, detectors."""
    rows = rows_of(file, frames_of=of, placement=placement)
    models = [model] if model else values(rows, "model")
    each = [
        numbers([r for r in rows if (r["model"], r["road_user"]) == (one, user)], "ap").mean()
        for one in models
        for user in USERS
    ]
    return 100 * float(np.mean(each))


def table1() -> str:
    """mAP of the nine placements beside P_sm, D and LiDARs at the same intersections."""
    rows = []
    for placement in PLACEMENTS:
        cells = [placement]
        for of in HELD_OUT:
            own = rows_of("table1_scores", conditions="recorded", frames_of=of, placement=placement)
            mean = {row["metric"]: float(row["mean"]) for row in own}
            cells += [f"{mean[metric]:.3f}" for metric in ("surrogate", "detectability")]
            cells += [f"{mean_ap('table1', of, placement):.1f}"]
        rows.append(
            [*cells, *(f"{mean[name]:,.{k}f}" for name, k in (("sensors", 1), ("area", 2)))]
        )
    heads = [
        f"{what}, {at}" for at in ("other places", "another time") for what in ("P_sm", "D", "mAP")
    ]
    return markdown(["placement", *heads, "sensors, all ten", "area, all ten"], rows)


def correlated(rows: Iterable[Row]) -> list[str]:
    """Correlations with everything, each kind of them with its interval."""
    found: dict[str, list[str]] = {metric: [] for metric in COMPARED}
    for row in rows:
        value, low, high = (float(row[key]) for key in ("value", "low", "high"))
        found[row["metric"]].append(with_interval(value, low, high))
    return [", ".join(cells) for cells in found.values()]


def correlations() -> str:
    """Correlations of mAP over the nine placements and random ones, Pearson's and Spearman's."""
    own = [("places", "recorded"), ("time", "recorded"), ("paper", "usual"), ("places", "usual")]
    rows = []
    for (of, conditions), less in [*itertools.product(own, ("", "kind of sensors"))][:-1]:
        chosen = dict(frames_of=of, conditions=conditions, less=less, road_user="all")
        words = of + ", midday" * (conditions == "usual") + f", less {less}" * bool(less)
        rows.append([words, *correlated(rows_of("table1_correlations", **chosen))])
    for less in ("place", "place and number"):
        found = rows_of("random_placements_correlations", less=less, road_user="mean")
        rows.append([f"random, less {less}", *correlated(found)])
    return markdown(["mAP at", *COMPARED.values()], rows)


def found_placements() -> str:
    """P_sm and mAP of placements by hand and as searches found them."""
    scores = rows_of("found_placements_scores")

    def line(
        placement: str, file: str, model: str, layout: str, key: str, method: str = "greedy-adam"
    ) -> list[str]:
        cells = [placement]
        for of, at in HELD_OUT.items():
            own = [r for r in scores if (r["layout"], r["method"]) == (layout, method)]
            own = [r for r in own if not at or r["scene"] in at]
            cells += [f"{numbers(own, key).mean():.3f}"]
            cells += [f"{mean_ap(file, of, placement, model):.1f}"]
        return cells

    rows, gains = [], []
    for name, model in FOUND.items():
        found = f"found from {name}"
        rows.append(line(name, "table1", model, name, "surrogate_before"))
        rows.append(line(found, "found_placements", model, name, "surrogate"))
        gains.append([
            mean_ap("found_placements", of, found, model) - mean_ap("table1", of, name, model)
            for of in HELD_OUT
        ])  # fmt: skip
    own = "found_placements", FOUND["Cam-d2"]
    rows += [
        line(DOWN, *own, DOWN, "surrogate", "none"),
        line(HUNG, *own, HUNG, "surrogate", "none"),
        line(f"found from {HUNG}", *own, HUNG, "surrogate"),
        line(f"found without gradient from {HUNG}", *own, HUNG, "surrogate", "greedy"),
    ]
    *lidars, cameras = np.array(gains)
    intervals = [interval(gain) for gain in np.transpose(lidars)]
    rows.append(["gain with LiDARs, 95 % interval", "", intervals[0], "", intervals[1]])
    rows.append(["gain with cameras", "", f"{cameras[0]:+.1f}", "", f"{cameras[1]:+.1f}"])
    heads = ["P_sm at midday, other places", "mAP", "P_sm at midday, another time", "mAP"]
    return markdown(["placement", *heads], rows)


def random_gains() -> str:
    """What searches gain in P_sm, D and mAP, by what they search for: means of three starts."""
    all_rows = rows_of("random_placements")
    places = values(all_rows, "place")
    own = {(row["place"], row["layout"]): row for row in all_rows}
    rows = []
    for goal in ("P_sm", "D"):
        cells = [goal]
        for place, (key, digits) in itertools.product(
            places, (("surrogate", 3), ("detectability", 3), ("mean_ap", 1))
        ):
            pairs = (
                (own[place, x], own[place, f"found for {goal} from {x}"])
                for x in ("L-c", "L-d2", "L-d1")
            )
            gains = [float(new[key]) - float(old[key]) for old, new in pairs]
            cells.append(f"{np.mean(gains):+.{digits}f}")
        rows.append(cells)
    heads = [f"{what}, {place.split()[0]}" for place in places for what in ("P_sm", "D", "mAP")]
    return markdown(["searched", *heads], rows)


def fishers(values: Iterable[float]) -> str:
    """The mean of correlations by Fisher's z, and its interval of 95 % by Student's t."""
    z = np.arctanh(np.clip([*values], -0.999, 0.999))
    ends = ttest_1samp(z, 0.0).confidence_interval()
    return with_interval(*np.tanh([z.mean(), *ends]))


def real_deployments() -> str:
    """Scores beside what was measured: S110, SensorSpacing, and the pitch of InSPE's cameras."""
    scores = {"detectability": "D", "information_gain": "IG", "surrogate": "P_sm"}
    spacing = rows_of("real_deployments_spacing")
    vehicles = numbers(rows_of("real_deployments_spacing", score="sensors"), "vehicles")

    def of(score: str, **having: str) -> np.ndarray:
        return numbers(rows_of("real_deployments", profile="paper", **having), score)

    def over(score: str, key: str) -> np.ndarray:
        return numbers([row for row in spacing if row["score"] == score], key)

    def places(x: np.ndarray) -> str:
        same = [0] * len(x)
        return with_interval(*correlation(x, over("sensors", "mean_ap"), same, "spearman"))

    def down(score: str, level: str = "at 0°", **having: str) -> np.ndarray:
        """What cameras gain that are turned down."""
        is_down = {"InSPE": "as hung"}.get(having.get("deployment", ""), "at -30.6°")
        return of(score, cameras=is_down, **having) - of(score, cameras=level, **having)

    def s110(score: str, kinds: str) -> list[np.ndarray]:
        """With the depth of the profile, and by pixels."""
        own = dict(deployment="S110", sensors=kinds)
        return [
            of(score, cameras=cameras, **own) for cameras in ("as hung", "depth of the paper's")
        ]

    rows = []
    for kinds, count, ap in (("cameras", 4, 35.0), ("LiDARs", 1, 84.9), ("both", 5, 87.0)):
        own = ["; ".join(f"{x.mean():.2f}" for x in s110(name, kinds)) for name in scores]
        rows.append([f"S110, {kinds}: mAP {ap}", *own, f"sensors: {count}"])
    pairs = (zip(s110(name, "LiDARs"), s110(name, "cameras"), strict=True) for name in scores)
    gained = ["; ".join(interval(a - b, 2) for a, b in both) for both in pairs]
    rows.append(["S110, LiDAR less cameras: mAP +49.8", *gained, "sensors: -3"])
    beside, *others = (fishers(over(x, "correlation")) for x in ("spacing", *scores))
    rows.append(["AP over spacings: correlation", *others, f"the spacing: {beside}"])
    rows.append(["… given the spacing", *(fishers(over(x, "given_spacing")) for x in scores), ""])
    least = over("spacing", "lost")
    beside, *others = (interval(over(x, "lost") - least) for x in ("sensors", *scores))
    rows.append(["AP lost by its choice, less by the widest", *others, f"any: {beside}"])
    others = [places(over(x, "mean")) for x in scores]
    rows.append(["AP over places: correlation", *others, f"vehicles: {places(vehicles)}"])
    inspe = dict(deployment="InSPE", sensors="cameras")
    means = [of(x, cameras="as hung", **inspe).mean() for x in scores]
    own = [f"{m:.3f}; {interval(down(x, **inspe), 3)}" for m, x in zip(means, scores, strict=True)]
    rows.append(["cameras of InSPE's author, 30.6° down; less level", *own, ""])
    mean = [np.mean([down(x, sensors=name) for name in PLACEMENTS[:3]], 0) for x in scores]
    rows.append(
        ["Cam-c, -d1 and -d2, ten places: down less level", *(interval(x, 3) for x in mean), ""]
    )
    return markdown(["", *scores.values(), "baseline"], rows)


def mcity() -> str:
    """Shares of road users found at Mcity, and predicted, by part of the way; Brier scores."""
    columns, rows = ("step", "D", "D fitted", "D fitted, range"), []
    parts = values(rows_of("real_deployments_mcity"), "part")
    for part in (part for part in parts if not part.endswith((" arm", " another"))):
        own = rows_of("real_deployments_mcity", part=part)
        found = numbers(own, "found")
        some = len(own) > 2 and np.ptp(found) > 0
        ends = ttest_1samp(found, 0.0).confidence_interval() if some else [np.nan] * 2
        words = with_interval(found.mean(), *np.clip(ends, 0, 1))
        count = f"{len(own)}, {numbers(own, 'instants').sum():.0f}"
        means = (numbers(own, key).mean() for key in columns)
        cells = [count, words, *("–" if np.isnan(x) else f"{x:.2f}" for x in means)]
        if part != parts[-1]:
            rows.append([part, *cells])
            continue
        step, *miss = (numbers(own, f"Brier, {key}") for key in columns)
        less = (f"{x.mean():.3f}, {interval(x - step, 3)}" for x in miss)
        rows.append(
            [f"{part}: Brier score, less the step's", count, "", f"{step.mean():.3f}", *less]
        )
    return markdown(["", "passes, instants", "found", *columns], rows)


def statics() -> str:
    """P_sm of the distributed placements without and with static bodies."""
    scenes = values(rows_of("statics"), "scene")
    return by_placement(
        scenes,
        lambda placement: [
            f"{float(row['surrogate_none']):.3f}, {float(row['surrogate_bodies']):.3f}"
            for scene in scenes
            for row in rows_of("statics", scene=scene, placement=placement)
        ],
        (placement for placement in PLACEMENTS if "-d" in placement),
    )


def terrain() -> str:
    """What the ground takes from P_sm at each steep scene: the most of the nine placements."""
    rows = []
    for scene in values(rows_of("terrain"), "scene")[2:]:  # after two made-up crests
        own = rows_of("terrain", scene=scene)
        steep, high = (float(own[0][key]) for key in ("steepest", "range"))
        if steep < 0.1:
            continue
        lost = numbers(own, "surrogate_none") - numbers(own, "surrogate_ground")
        times = np.median(numbers(own, "time_ratio"))
        rows.append([scene, f"{steep:.0%}", f"{high:.1f} m", f"{lost.max():.3f}", f"{times:.2f}"])
    heads = ["scene", "steepest", "lowest to highest", "most that P_sm loses", "× the time"]
    return markdown(heads, rows)


def recorded_returns() -> str:
    """Furthest point in each weather, and the share of points on road users that is left."""
    weathers = values(rows_of("recorded_returns"), "weather")
    rows = [
        [device]
        + [
            f"{float(row['furthest']):.1f} of {float(row['reach']):.1f} m, "
            f"{100 * float(row['share_on_road_users']):.1f} %"
            for weather in weathers
            for row in rows_of("recorded_returns", device=device, weather=weather)
        ]
        for device in values(rows_of("recorded_returns"), "device")
    ]
    return markdown(["device", *weathers], rows)


def loading() -> str:
    """Frames a second: the median of several rounds (least to most)."""
    readers = {"from the set": ("set", "0"), "cache": ("cache", "0"), "2 workers": ("cache", "2")}
    rows = []
    kinds = [kind for kind in values(rows_of("loading"), "kind") if "0.8 m" not in kind]
    for kind in kinds:
        cells = [kind]
        for reader, workers in readers.values():
            own = rows_of("loading", kind=kind, reader=reader, workers=workers)
            ends = [[float(row[key]) for key in ("median", "least", "most")] for row in own]
            cells.append("".join("{:.0f} ({:.0f}–{:.0f})".format(*each) for each in ends))
        rows.append(cells)
    return markdown(["", *readers], rows)


def training_step() -> str:
    """A step of each detector: its data, its time, and memory."""
    rows = []
    for row in rows_of("training_step"):
        times = f"{row['loading_ms']} ms", f"{float(row['step_ms']) / 1000:.2f} s"
        about = [row["model"], row["after"], DIFFERS[row["model"]], f"{int(row['parameters']):,}"]
        rows.append([*about, *times, f"{float(row['memory_gib']):.1f} GiB"])
    heads = ["detector", "after", "but", "parameters", "a batch", "a step", "memory"]
    return markdown(heads, rows)


def road_users() -> str:
    """Road users in a frame, of those that a density asks for."""
    rows = []
    for density in ("high", "medium", "low"):
        cells = [density]
        for user in USERS:
            own = rows_of("training_set", density=density, road_user=user, turn_s="0.1")
            mean = numbers(own, "boxes").sum() / numbers(own, "frames").sum()
            cells.append(f"{mean:.1f} of {own[0]['asked']}")
        rows.append(cells)
    return markdown(["density", *(f"{user}s" for user in USERS)], rows)


TABLES: tuple[Callable[[], str], ...] = (
    slopes, phases, searches, detectability, table2, table1, correlations, found_placements,
    random_gains, real_deployments, mcity, statics, terrain, recorded_returns, loading,
    training_step, road_users,
)  # fmt: skip


def with_tables(text: str) -> str:
    """A text with its tables as the CSV has them. Each table stands in it once."""
    for table in TABLES:
        begin = f"<!-- {table.__name__} -->\n"
        pattern = re.compile(re.escape(begin) + r".*?(?=<!-- end -->)", re.DOTALL)
        new = begin + table() + "\n"
        text, count = pattern.subn(new.replace("\\", r"\\"), text)
        if count != 1:
            raise ValueError(f"{table.__name__}: {count} places in the text")
    return text


if __name__ == "__main__":
    write_text(README, with_tables(README.read_text(encoding="utf-8")))
