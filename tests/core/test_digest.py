"""Digests tell contents apart, and not where they came from."""

from dataclasses import replace
from pathlib import Path

import inspe_jax
from inspe_jax.core.digest import digest


def test_a_place_from_a_map_has_the_digest_of_its_content():
    """A saved scene does not keep the file; a search that was stopped goes on with either."""
    place = inspe_jax.built_in("four_way")
    assert digest(replace(place, map=Path("town.xodr"))) == digest(place)
    assert digest(replace(place, name="another")) != digest(place)
