"""Trains detectors; a run is a folder, and goes on after a kill as though nothing had happened."""

from inspe_jax.perception.training.many import Training, train_all
from inspe_jax.perception.training.predict import Predictor
from inspe_jax.perception.training.run import Run, open_run
from inspe_jax.perception.training.settings import Settings
from inspe_jax.perception.training.train import Report, train

__all__ = ["Predictor", "Report", "Run", "Settings", "Training", "open_run", "train", "train_all"]
