"""The five regions of the ground, and their weights."""

from collections.abc import Mapping, Sequence
from enum import IntEnum

import numpy as np

from inspe_jax.core.errors import InspeError, check_known


class Region(IntEnum):
    """What a piece of ground is for. The value is the label of a column.

    >>> inspe_jax.Region.CROSSWALK.key, inspe_jax.Region(1).key
    ('crosswalk', 'junction')
    """

    DRIVEWAY = 0
    JUNCTION = 1
    CROSSWALK = 2
    SIDEWALK = 3
    SHOULDER = 4

    @property
    def key(self) -> str:
        """Lower-case name, as written in files and tables."""
        return self.name.lower()


PAPER_WEIGHTS = (0.22, 0.25, 0.23, 0.17, 0.13)
"""Region weights w of the paper's coverage, by label; they sum to 1."""

PRECEDENCE: tuple[Region, ...] = (
    Region.CROSSWALK,
    Region.JUNCTION,
    Region.DRIVEWAY,
    Region.SHOULDER,
    Region.SIDEWALK,
)
"""Where regions overlap, a column gets the label that comes first here."""


def regions_of(names: Sequence[str]) -> tuple[Region, ...]:
    """Regions by their names. Raises InspeError where a name is of no region."""
    known = {region.key: region for region in Region}
    names = (names,) if isinstance(names, str) else names
    for name in names:
        check_known(name, known, "region")
    return tuple(known[name] for name in names)


def weights_of_regions(given: Mapping[str, float] | None) -> tuple[float, ...]:
    """Region weights by label; the paper's where none is given, and 0 of regions that are not
    named. Raises InspeError where a name is of no region, or weights are below 0 or none is
    above."""
    if given is None:
        return PAPER_WEIGHTS
    regions_of(tuple(given))
    if not (min(given.values(), default=0.0) >= 0 and 0 < sum(given.values()) < np.inf):
        raise InspeError(f"region weights: must be at least 0, and one above 0, got {dict(given)}")
    return tuple(float(given.get(region.key, 0.0)) for region in Region)
