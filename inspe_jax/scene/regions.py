"""The five regions of the ground, and their weights."""

from collections.abc import Mapping, Sequence
from enum import IntEnum

from inspe_jax.core.errors import InspeError, check_known, error_at


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

WEIGHT_LIMITS = (1e-3, 1e3)

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
    named. Raises InspeError where a name is of no region, or a weight is out of range."""
    if given is None:
        return PAPER_WEIGHTS
    with error_at("region_weight"):
        regions_of(tuple(given))
    low, high = WEIGHT_LIMITS
    for name, weight in given.items():
        if not (isinstance(weight, int | float) and (weight == 0 or low <= weight <= high)):
            raise InspeError(
                f"region_weight: {name}: must be 0, or a number from {low:g} to {high:g}, "
                f"got {weight!r}"
            )
    return tuple(float(given.get(region.key, 0.0)) for region in Region)
