"""nuScenes' measures of detections against ground truth."""

from inspe_jax.perception.evaluation.evaluate import evaluate
from inspe_jax.perception.evaluation.matching import matched
from inspe_jax.perception.evaluation.metrics import DISTANCES, ERRORS, Curve, Evaluation

__all__ = ["DISTANCES", "ERRORS", "Curve", "Evaluation", "evaluate", "matched"]
