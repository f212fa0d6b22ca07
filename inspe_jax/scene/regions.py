"""The five regions of the ground and the paper's weights for them."""

from collections.abc import Sequence
from enum import IntEnum

from inspe_jax.core.errors import check_known


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


WEIGHTS: dict[Region, float] = {
    Region.DRIVEWAY: 0.22,
    Region.JUNCTION: 0.25,
    Region.CROSSWALK: 0.23,
    Region.SIDEWALK: 0.17,
    Region.SHOULDER: 0.13,
}
"""Region weights w of the paper's coverage; they sum to 1."""

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
