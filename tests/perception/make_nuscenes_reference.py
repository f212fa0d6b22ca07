"""Makes ``data/nuscenes_reference.npz``: what nuScenes' own code says about random boxes.

Tests read the file alone. To make it again, in a virtual environment of its own, because
``nuscenes-devkit`` needs numpy below 2::

    python -m venv devkit
    devkit/bin/pip install nuscenes-devkit==1.2.0
    devkit/bin/python tests/perception/make_nuscenes_reference.py

Each case has frames of boxes as :class:`inspe_jax.perception.detections.Detections` has them, and
what the devkit's ``DetectionEval.evaluate`` makes of them with the configuration of the detection
challenge, for our four classes. Nothing of ``inspe_jax`` is used.
"""

from pathlib import Path

import numpy as np

NAMES = ("car", "truck", "bicycle", "pedestrian")
"""The devkit's names of our classes, in our order."""

SIZES = np.array([(4.6, 1.85, 1.55), (8.5, 2.5, 3.4), (1.8, 0.65, 1.75), (0.5, 0.5, 1.72)])
ERRORS = ("trans_err", "scale_err", "orient_err", "vel_err")
COLUMNS = {
    "truth_boxes": np.float32,
    "truth_kind": np.int8,
    "truth_frame": np.int16,
    "boxes": np.float32,
    "kind": np.int8,
    "score": np.float32,
    "frame": np.int16,
}
"""What a case consists of: a row for each box of the truth, and for each detection."""

FOLDER = Path(__file__).parent / "data"


def users(rng, count, kinds, reach):
    """Boxes (count, 9) and kinds of random road users, up to ``reach`` [m] from the middle."""
    kind = rng.choice(kinds, count) if len(kinds) else np.zeros(0, int)
    boxes = np.zeros((len(kind), 9))
    boxes[:, :2] = rng.uniform(-reach, reach, (len(kind), 2))
    boxes[:, 3:6] = SIZES[kind] * rng.uniform(0.8, 1.25, (len(kind), 3))
    boxes[:, 2] = boxes[:, 5] / 2
    boxes[:, 6] = rng.uniform(-np.pi, np.pi, len(kind))
    boxes[:, 7:] = rng.normal(0, 4, (len(kind), 2))
    return boxes, kind


def found(rng, boxes, kind, kinds, reach, noise, missed, doubled, false):
    """Detections: road users with noise, of which a share is ``missed`` and one is ``doubled``, and
    false ones of ``kinds``, ``false`` in the mean. Scores fall with the noise, so that curves have
    a shape."""
    share = [missed, 1 - missed - doubled, doubled]
    copies = np.repeat(np.arange(len(kind)), rng.choice(3, len(kind), p=share))
    off = rng.normal(0, noise, (len(copies), 2)) * rng.exponential(1, (len(copies), 1))
    close = boxes[copies].copy()
    close[:, :2] += off
    close[:, 3:6] *= rng.uniform(0.8, 1.2, (len(copies), 3))
    close[:, 6] += rng.normal(0, 0.2, len(copies)) + np.pi * (rng.random(len(copies)) < 0.1)
    close[:, 7:] += rng.normal(0, 1, (len(copies), 2))
    score = np.exp(-np.hypot(*off.T)) * rng.uniform(0.3, 1, len(copies))
    more, other = users(rng, rng.poisson(false), kinds, reach)
    boxes = np.concatenate([close, more])
    kind = np.concatenate([kind[copies], other])
    score = np.concatenate([score, rng.uniform(0, 0.6, len(other))])
    order = rng.permutation(len(kind))
    return boxes[order], kind[order], score[order]


def wrapped(boxes):
    """The same boxes with yaws within ±π, as the package has them."""
    boxes[:, 6] = np.pi - (np.pi - boxes[:, 6]) % (2 * np.pi)
    return boxes


def scene(
    seed,
    frames=8,
    crowd=12,
    kinds=(0, 1, 2, 3),
    seen=None,
    reach=40.0,
    noise=0.7,
    missed=0.2,
    doubled=0.15,
    false=4.0,
    change=None,
):
    """Frames of a case: truth and detections, joined, with the frame of each box.

    ``kinds`` are those of the truth, ``seen`` those of detections; ``change(rng, boxes, score)``
    changes the boxes of a frame in place, where ``score`` is None for truth.
    """
    rng, own = np.random.default_rng([25, seed]), kinds if seen is None else seen
    parts = {name: [] for name in COLUMNS}
    for t in range(frames):
        boxes, kind = users(rng, rng.poisson(crowd), kinds, reach)
        marks = found(rng, boxes, kind, own, reach, noise, missed, doubled, false)
        marks = [part[np.isin(marks[1], own)] for part in marks]
        if change is not None:
            change(rng, boxes, None)
            change(rng, marks[0], marks[2])
        truth = wrapped(boxes), kind, np.full(len(kind), t)
        marks = wrapped(marks[0]), *marks[1:], np.full(len(marks[1]), t)
        for name, part in zip(COLUMNS, (*truth, *marks), strict=True):
            parts[name].append(part)
    return {name: np.concatenate(parts[name]).astype(kind) for name, kind in COLUMNS.items()}


def equal_scores(rng, boxes, score):
    """Scores of one decimal, so that many are equal, also 0 and 1."""
    if score is not None:
        score[:] = np.round(1.2 * score, 1).clip(0, 1)


def on_a_grid(rng, boxes, score):
    """Places in whole half metres, so that distances are equal to each other and to thresholds."""
    boxes[:, :2] = np.round(2 * boxes[:, :2]) / 2
    equal_scores(rng, boxes, score)


def at_half_a_turn(rng, boxes, score):
    """Yaws near ±π on both sides of it."""
    boxes[:, 6] = np.pi + rng.normal(0, 0.1, len(boxes))


CASES = {
    "usual": lambda: scene(0),
    "crowded": lambda: scene(1, crowd=30, reach=12.0, noise=1.0, doubled=0.4, missed=0.1),
    "poor": lambda: scene(2, missed=0.85, doubled=0.0, noise=2.0, false=20.0),
    "equal_scores": lambda: scene(3, change=equal_scores),
    "on_a_grid": lambda: scene(4, crowd=25, reach=8.0, change=on_a_grid),
    "half_a_turn": lambda: scene(5, change=at_half_a_turn),
    "no_trucks": lambda: scene(6, kinds=(0, 2, 3), seen=(0, 1, 2, 3)),
    "none_found": lambda: scene(7, seen=(0, 2)),
    "empty_frames": lambda: scene(8, frames=20, crowd=1.0, false=0.5),
}


def evaluated(case):
    """What the devkit says: its measures by class and together, and its curves."""
    from nuscenes.eval.common.config import config_factory
    from nuscenes.eval.common.data_classes import EvalBoxes
    from nuscenes.eval.detection.data_classes import DetectionBox
    from nuscenes.eval.detection.evaluate import DetectionEval

    def box_of(t, x, name, score):
        return DetectionBox(
            sample_token=str(t),
            translation=tuple(x[:3].tolist()),
            size=tuple(x[[4, 3, 5]].tolist()),  # theirs is width, length, height
            rotation=(np.cos(x[6] / 2), 0.0, 0.0, np.sin(x[6] / 2)),
            velocity=tuple(x[7:].tolist()),
            detection_name=name,
            detection_score=score,
        )

    def boxes_of(prefix):
        boxes, kind, frame = (case[prefix + key] for key in ("boxes", "kind", "frame"))
        score = np.full(len(kind), -1.0) if prefix else case["score"]
        of = EvalBoxes()
        for t in range(1 + max(case["frame"].max(), case["truth_frame"].max())):
            own = np.flatnonzero(frame == t)
            here = zip(boxes[own].astype(float), kind[own], score[own], strict=True)
            of.add_boxes(str(t), [box_of(t, x, NAMES[k], float(s)) for x, k, s in here])
        return of

    run = object.__new__(DetectionEval)  # its constructor wants nuScenes' own data
    run.cfg, run.verbose = config_factory("detection_cvpr_2019"), False
    run.cfg.class_names = NAMES
    run.gt_boxes, run.pred_boxes = boxes_of("truth_"), boxes_of("")
    metrics, curves = run.evaluate()
    table = [[curves[name, d] for d in run.cfg.dist_ths] for name in NAMES]
    return {
        "ap": [[metrics.get_label_ap(name, d) for d in run.cfg.dist_ths] for name in NAMES],
        "class_ap": [metrics.mean_dist_aps[name] for name in NAMES],
        "mean_ap": metrics.mean_ap,
        "errors": [[metrics.get_label_tp(name, key) for key in ERRORS] for name in NAMES],
        "mean_errors": [metrics.tp_errors[key] for key in ERRORS],
        "nds": metrics.nd_score,
        "precision": [[curve.precision for curve in row] for row in table],
        "confidence": [[curve.confidence for curve in row] for row in table],
    }


def main():
    """Write the file, and say what is in it."""
    content = {}
    for name, make in CASES.items():
        case = make()
        said = {key: np.asarray(value, float) for key, value in evaluated(case).items()}
        content |= {f"{name}/{key}": value for key, value in {**case, **said}.items()}
        counts = f"{len(case['truth_kind'])} road users, {len(case['kind'])} detections"
        print(f"{name:13} {counts}, mAP {said['mean_ap']:.4f}, NDS {said['nds']:.4f}")
    path = FOLDER / "nuscenes_reference.npz"
    np.savez_compressed(path, **content)
    print(f"{path.name}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
