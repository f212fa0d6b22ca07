"""Asks nuScenes' own code again what it says about the boxes of ``data/nuscenes_reference.npz``,
which tests read. It needs an environment of its own, with nuscenes-devkit==1.2.0 and numpy below 2.

Each case has frames of random boxes as :class:`inspe_jax.perception.evaluation.Detections` has
them, and what the devkit's ``DetectionEval.evaluate`` makes of them with the configuration of the
detection challenge, for our four classes. Nothing of ``inspe_jax`` is used.
"""

from pathlib import Path

import numpy as np

NAMES = ("car", "truck", "bicycle", "pedestrian")
"""The devkit's names of our classes, in our order."""

FILE = Path(__file__).parent / "data" / "nuscenes_reference.npz"


def evaluated(case):
    """What the devkit says: AP by class and distance, and its means."""
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
    metrics, _ = run.evaluate()
    return {
        "ap": [[metrics.get_label_ap(name, d) for d in run.cfg.dist_ths] for name in NAMES],
        "class_ap": [metrics.mean_dist_aps[name] for name in NAMES],
        "mean_ap": metrics.mean_ap,
    }


def main():
    with np.load(FILE) as file:
        content = dict(file)
    for name in {key.partition("/")[0] for key in content}:
        own = [key for key in content if key.startswith(f"{name}/")]
        said = evaluated({key.partition("/")[2]: content[key] for key in own})
        content |= {f"{name}/{key}": np.asarray(value, float) for key, value in said.items()}
    np.savez_compressed(FILE, **content)


if __name__ == "__main__":
    main()
