"""A detector, which finds road users in frames: encoders of its modalities, a fusion, a head."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from inspe_jax.core.errors import check_known
from inspe_jax.dataset.loading import Batch, Cache, Loader
from inspe_jax.dataset.loading.loader import Sensor
from inspe_jax.perception import encoders, fusion
from inspe_jax.perception.evaluation import Detections, Evaluation, evaluate, truth_of, within
from inspe_jax.perception.fusion import AgentMaps, FusedMap, Mean, Present
from inspe_jax.perception.head import CenterHead, HeadOutput, Heat, Peaks, peaks
from inspe_jax.perception.inputs import Agents, BevGrid, Inputs, inputs_of

ENCODED, CHANNELS = 32, 48
"""Channels of encoders and of fused maps: half of PointPillars' 64, an eighth of its 384."""

Fusion = Callable[[AgentMaps, Present], FusedMap]


@dataclass(frozen=True)
class Model:
    """A row of the registry: ``images`` are blocks of the encoder of pictures; ``fuse`` makes a
    fusion from channels, modalities of agents (0 LiDAR, 1 camera) and a key. With ``every_scale``
    all three scales are fused; ``joined`` makes one agent of all of a modality (early fusion);
    ``taught`` models learn from a teacher."""

    sensors: tuple[Sensor, ...]
    fuse: Callable[[int, tuple[int, ...], Array], Fusion]
    source: str
    images: encoders.Residual = encoders.InvertedResidual
    every_scale: bool = False
    joined: bool = False
    taught: bool = False


LIDAR: tuple[Sensor, ...] = ("lidar",)
CAMERA: tuple[Sensor, ...] = ("camera",)
BOTH: tuple[Sensor, ...] = ("lidar", "camera")

TEACHER = "early-fusion"

MODELS: dict[str, Model] = {
    "lss-eff": Model(CAMERA, Mean, "Philion and Fidler 2020; Tan and Le 2019", joined=True),
    "lss-resnet": Model(
        CAMERA, Mean, "Philion and Fidler 2020; He et al. 2016", encoders.Bottleneck, joined=True
    ),
    "v2vnet": Model(LIDAR, fusion.V2VNet, "Wang et al. 2020"),
    "v2x-vit": Model(LIDAR, fusion.V2XViT, "Xu et al. 2022"),
    "coalign": Model(LIDAR, fusion.AttFuse, "Lu et al. 2023", every_scale=True),
    "attfuse": Model(BOTH, fusion.AttFuse, "Xu et al. 2022"),
    "disconet": Model(BOTH, fusion.DiscoNet, "Li et al. 2021", taught=True),
    "hm-vit": Model(BOTH, fusion.HMViT, "Xiang et al. 2023"),
    TEACHER: Model(
        LIDAR, Mean, "DiscoNet's teacher: the pillars of all units together", joined=True
    ),
}
"""Detectors by name. Unlike the published ones, all have few channels, one head, exact poses
without delay or warps, and the mean over agents. CoAlign has no pose graph."""


def model_of(name: str) -> Model:
    """The row of a name. Raises InspeError, which lists the models, for another one."""
    check_known(name, MODELS, "model")
    return MODELS[name]


class Predictions(NamedTuple):
    """Heat and values of the head; and for training, the fused map and heat on the pictures."""

    found: HeadOutput
    fused: Float[Array, "B h w C"]
    on_pictures: Float[Array, "n h w K"] | None


class Detector(eqx.Module):
    """What a row of :data:`MODELS` says, with parameters drawn by ``key``."""

    pillars: encoders.PillarEncoder | None
    pictures: encoders.LiftSplat | None
    pyramids: list[encoders.Pyramid]
    necks: list[encoders.Neck]
    fusions: list[Any]
    head: CenterHead
    model: Model = eqx.field(static=True)

    def __init__(self, model: Model, agents: Agents, grid: BevGrid, key: Array) -> None:
        a, b, c, d, e, f = jax.random.split(key, 6)
        lidars = agents.lidars if "lidar" in model.sensors else 0
        cameras = agents.cameras if "camera" in model.sensors else 0
        if model.joined:
            lidars, cameras = min(lidars, 1), min(cameras, 1)
        self.model = model
        self.pillars = encoders.PillarEncoder(grid.pillars(), ENCODED, a) if lidars else None
        self.pictures = None
        if cameras:
            self.pictures = encoders.LiftSplat(model.images, grid, cameras, ENCODED, b)
        modalities = (0,) * lidars + (1,) * cameras
        pyramids = len(set(modalities))
        self.pyramids = [encoders.Pyramid(ENCODED, own) for own in jax.random.split(c, pyramids)]
        # Where every scale is fused, one neck comes after the fusion; else, one a modality before.
        necks = jax.random.split(d, 1 if model.every_scale else pyramids)
        self.necks = [encoders.Neck(CHANNELS, own) for own in necks]
        fused = encoders.WIDTHS if model.every_scale else (CHANNELS,)
        self.fusions = [
            model.fuse(channels, modalities, own)
            for channels, own in zip(fused, jax.random.split(e, len(fused)), strict=True)
        ]
        self.head = CenterHead(CHANNELS, f)

    def __call__(self, inputs: Inputs) -> Predictions:
        encoded, present, on_pictures = self.encoded(inputs)
        fused = self.fused(encoded, present)
        return Predictions(self.head(fused), fused, on_pictures)

    def fused(self, encoded: list[AgentMaps], present: Present) -> FusedMap:
        """The map of all agents together."""
        maps = [pyramid(x) for pyramid, x in zip(self.pyramids, encoded, strict=True)]
        if self.model.every_scale:
            scales = [jnp.concatenate(scale, 1) for scale in zip(*maps, strict=True)]
            pairs = zip(self.fusions, scales, strict=True)
            return self.necks[0](tuple(fusion(x, present) for fusion, x in pairs))
        necked = [neck(x) for neck, x in zip(self.necks, maps, strict=True)]
        found: Array = self.fusions[0](jnp.concatenate(necked, 1), present)
        return found

    def encoded(self, inputs: Inputs) -> tuple[list[AgentMaps], Present, Heat | None]:
        """The maps of each modality's agents, which agents are present, and heat on pictures."""
        maps, present, on_pictures = [], jnp.asarray(inputs.present), None
        joined = self.model.joined
        if self.pillars is not None:
            assert inputs.pillars is not None
            found = self.pillars(inputs.pillars)
            maps.append(found.max(1, keepdims=True) if joined else found)
        if self.pictures is not None:
            splatted, on_pictures = self.pictures(inputs)
            maps.append(splatted)
        return maps, present.any(1, keepdims=True) if joined else present, on_pictures


LEAST_SCORE = 0.01
"""Detections with a lower score are dropped; nuScenes counts nothing below a precision of 0.1."""


def loader_of(name: str, cache: Cache, split: str, grid: BevGrid, **how: Any) -> Loader:
    """A loader of what a model takes; ``how`` are further arguments of the loader."""
    return Loader(
        cache, split, sensors=model_of(name).sensors, points=grid.pillars(), half=grid.half, **how
    )


@eqx.filter_jit
def _peaks(detector: Detector, inputs: Inputs, grid: BevGrid) -> Peaks:
    """Compiled once for a model and frames of one shape, whatever the weights."""
    return peaks(detector(inputs).found, grid)


class Predictor:
    """A detector, for frames."""

    def __init__(self, detector: Detector, agents: Agents, grid: BevGrid) -> None:
        self.detector, self.agents, self.grid = detector, agents, grid

    def __call__(self, batch: Batch) -> list[Detections]:
        """The detections in each frame of a batch that is ``valid``."""
        found: Peaks = _peaks(self.detector, inputs_of(batch, self.agents), self.grid)
        boxes, kind, score = map(np.asarray, found)
        kind, enough = kind.astype(np.int32), score >= LEAST_SCORE
        return [
            Detections(*(part[b][enough[b]] for part in (boxes, kind, score)))
            for b in np.flatnonzero(batch.valid).tolist()
        ]

    def evaluate(
        self,
        loader: Loader,
        most: int | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Evaluation:
        """The measures over a loader's batches, or over about ``most`` frames, evenly: against all
        road users within the loader's ``half``, and those that the detector's sensors see. Raises
        :class:`~inspe_jax.perception.evaluation.NoTruth`."""
        found, truth, seen = list[Detections](), list[Detections](), list[Detections]()
        half, count = loader.half, len(loader)
        some = count if most is None else min(count, -(-most // loader.batch))
        spread = np.linspace(0, count - 1, some).round().astype(int).tolist()
        batches = loader if some == count else (loader[k] for k in spread)
        for done, batch in enumerate(batches, 1):
            found += [frame if half is None else within(frame, half) for frame in self(batch)]
            for b in np.flatnonzero(batch.valid).tolist():
                truth.append(truth_of(batch.targets, b))
                seen.append(truth_of(batch.targets, b, self.detector.model.sensors))
            if progress:
                progress(done, some)
        return evaluate(found, truth, seen)
