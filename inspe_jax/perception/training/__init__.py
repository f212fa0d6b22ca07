"""Trains detectors; a run is a folder, and goes on after a kill as though nothing had happened."""

from inspe_jax.perception.detector import Predictor
from inspe_jax.perception.training.run import TrainingRun, TrainingSettings, open_run
from inspe_jax.perception.training.train import Report, Training, train, train_all

__all__ = [
    "Predictor", "Report", "Training", "TrainingRun", "TrainingSettings", "open_run", "train",
    "train_all",
]  # fmt: skip
