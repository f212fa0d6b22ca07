"""Data sets of recorded frames: generate, write, read and load them, as OPV2V's or others'."""

from typing import Any

from inspe_jax.core.lazily import lazily
from inspe_jax.dataset.folders import Dataset, Scenario
from inspe_jax.dataset.folders import open_dataset as open
from inspe_jax.dataset.formats.other_readers import FileOptions
from inspe_jax.dataset.formats.protocol_file import write_protocol
from inspe_jax.dataset.formats.registry import write_frame
from inspe_jax.dataset.generate import GenerationResult, generate
from inspe_jax.dataset.loading import Augment, Cache, Loader, PillarGrid, cache, open_cache
from inspe_jax.dataset.manifest import Check, check
from inspe_jax.dataset.plan import Generation, ScenarioPlan
from inspe_jax.dataset.protocol import load_generation
from inspe_jax.dataset.statistics import Statistics, statistics
from inspe_jax.simulation.frame import Frame, Image, RoadUserBox, Scan, Station
from inspe_jax.simulation.recorder import Server

__all__ = [
    "Augment", "Cache", "Check", "Dataset", "EmbeddedRecorder", "FileOptions", "Frame",
    "Generation", "GenerationResult", "Image", "Loader", "PillarGrid", "RoadUserBox", "Scan",
    "Scenario", "ScenarioPlan", "Server", "Station", "Statistics", "cache", "check", "frame_view",
    "generate", "load_generation", "open", "open_cache", "statistics", "write_frame",
    "write_protocol",
]  # fmt: skip
_get = lazily(
    __name__,
    {
        "dataset.frame_figure": ("frame_view",),
        "simulation.embedded.recorder": ("EmbeddedRecorder",),
    },
)


def __getattr__(name: str) -> Any:
    return _get(name)


def __dir__() -> list[str]:
    return __all__
