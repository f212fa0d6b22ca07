"""The cache of a small set, for the tests of the loader."""

import pytest
from loading_sets import HEIGHT, WIDTH, write_set

from inspe_jax import dataset
from inspe_jax.dataset.loading import Cache


@pytest.fixture(scope="package")
def loading_set(tmp_path_factory) -> dataset.Dataset:
    return dataset.open(write_set(tmp_path_factory.mktemp("loading") / "set"))


@pytest.fixture(scope="package")
def cached(loading_set) -> Cache:
    told = []
    found = dataset.cache(
        loading_set,
        loading_set.path.with_name("cache"),
        pictures=(HEIGHT, WIDTH),
        workers=1,
        progress=lambda *now: told.append(now),
    )
    assert told == [(0, 10), (3, 10), (7, 10), (10, 10)]
    return found
