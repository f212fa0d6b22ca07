"""From a data set to batches for training: a decoded cache on disk, and a loader that reads it.

::

    cache = inspe_jax.dataset.cache("set", "set_cache", pictures=(300, 400))
    loader = Loader(cache, "train", batch=4, seed=0, augment=Augment())
    for step, batch in enumerate(loader.steps()): ...
"""

from inspe_jax.dataset.loading.batch import Batch, Cameras, Lidars, Pillars, Targets
from inspe_jax.dataset.loading.caching import Cache, cache, open_cache
from inspe_jax.dataset.loading.geometry import Augment, Similarity, on_picture
from inspe_jax.dataset.loading.loader import Loader
from inspe_jax.dataset.loading.pillars import PillarGrid, pillar_features, taken

__all__ = [
    "Augment", "Batch", "Cache", "Cameras", "Lidars", "Loader", "PillarGrid", "Pillars",
    "Similarity", "Targets", "cache", "on_picture", "open_cache", "pillar_features", "taken",
]  # fmt: skip
