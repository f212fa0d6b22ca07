"""Digests tell contents apart, and not where they came from."""

from dataclasses import field, make_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from worlds import CAMERA, crossing

from inspe_jax.core.digest import OPTIONAL, digest
from inspe_jax.placement.constraints import Constraints


def test_digests_tell_contents_apart():
    """Of a place, not from which map: a saved scene does not keep the file."""
    place, yaws = crossing(), [Constraints(yaw={name: (0.0, 1.0)}) for name in "ab"]
    moved, named = replace(place, mounting=place.mounting.buffer(1e-6)), replace(place, name="b")
    others = [place, moved, named, crossing(slope=0.01), CAMERA, replace(CAMERA, reliability=0.8)]
    others += [None, Constraints(), *yaws, {"a": 1}, {"a": 1.0}, ["a", "bc"], ["ab", "c"]]
    others += [np.zeros((2, 3)), np.zeros((3, 2)), np.zeros((2, 3), np.float32), np.zeros(6, int)]
    assert len(set(map(digest, others))) == len(others)
    assert digest(crossing()) == digest(replace(place, map=Path("town.xodr"))) == digest(place)
    later = make_dataclass(
        "One", [("a", int, 1), ("b", Any, field(default=None, metadata=OPTIONAL))]
    )
    first = make_dataclass("One", [("a", int, 1)])
    assert digest(later()) == digest(first()) != digest(later(b=2))
    with pytest.raises(TypeError, match="has no digest"):
        digest(lambda: 0)
