"""Adding a map format: a module and a row. Here this file is the module."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from inspe_jax.core.errors import InspeError
from inspe_jax.scene.maps import registry as maps
from inspe_jax.scene.maps.road_map import JunctionInfo
from inspe_jax.scene.procedural.built_ins import crossing

MAP = """\
junctions:
  north: {bearings_deg: [0, 90, 180, 270], lanes: [1, 1, 1, 1]}
  south: {bearings_deg: [10, 130, 250], lanes: [2, 2, 2]}
"""


class ToyMap:
    """Straight roads from the origin, at which all junctions are."""

    georeference = None

    def __init__(self, path):
        self.name = Path(path).name
        self.junctions = yaml.safe_load(Path(path).read_text())["junctions"]

    def list_junctions(self):
        return tuple(
            JunctionInfo(name, (0.0, 0.0, 0.0), len(given["bearings_deg"]), 20.0, 0, 0)
            for name, given in self.junctions.items()
        )

    def road_lines(self):
        bearings = [a for given in self.junctions.values() for a in given["bearings_deg"]]
        ends = 50 * np.column_stack([np.sin(np.radians(bearings)), np.cos(np.radians(bearings))])
        return [np.array([[0, 0], end]) for end in ends]

    def read(self, junction, center, radius):
        """A junction by its name; its parameters are those of a built-in crossing."""
        return crossing(f"{self.name} {junction}", **self.junctions[junction])


@pytest.fixture
def toy_map(monkeypatch, tmp_path):
    monkeypatch.setitem(maps.FORMATS, (".toy.yaml",), f"{__name__}:ToyMap")
    path = tmp_path / "town.toy.yaml"
    path.write_text(MAP)
    return path


def test_a_row_is_all_that_a_map_format_needs(toy_map, tmp_path):
    with pytest.raises(InspeError, match=r"town\.toy: not a map: its name must end in \.xodr"):
        maps.read_map(tmp_path / "town.toy", junction="north")
    assert maps.is_map(toy_map)
    assert [info.id for info in maps.list_junctions(toy_map)] == ["north", "south"]
    assert maps.open_map(toy_map).georeference is None
    assert len(maps.open_map(toy_map).road_lines()) == 7
    place = maps.read_map(toy_map, junction="north", radius=30)
    own = crossing("own", (0, 90, 180, 270), (1, 1, 1, 1))
    assert place.regions.keys() == own.regions.keys()
    assert all(place.regions[r].equals(own.regions[r]) for r in own.regions)
    assert place.name == "town.toy.yaml north"
