"""How the lanes of an OpenDRIVE map are linked."""

import xml.etree.ElementTree as ET
from collections import defaultdict
from collections.abc import Iterator, Mapping

from inspe_jax.scene.maps.opendrive.geometry import number
from inspe_jax.scene.maps.opendrive.road_network import Lane, OpenDriveRoad, identity
from inspe_jax.scene.maps.road_map import Id

LaneKey = tuple[Id, int, int]
"""A road, the index of one of its sections, and a lane there."""


class LaneGraph:
    """The lanes of roads, and which ``follows`` and ``leads`` to which, as traffic runs; the
    declared ``junctions`` with their types; and the connections that are ``left_out``, with why."""

    def __init__(self, roads: Mapping[Id, OpenDriveRoad], root: ET.Element) -> None:
        self.roads = roads
        self.junctions: dict[Id, str] = {}
        self.left_out: list[str] = []
        self.follows: dict[LaneKey, list[LaneKey]] = {}
        self.leads: dict[LaneKey, list[LaneKey]] = defaultdict(list)
        through = self._through(root)
        for road in roads.values():
            for index, section in enumerate(road.sections):
                for lane, one in section.lanes.items():
                    key = (road.id, index, lane)
                    self.follows[key] = list(dict.fromkeys(self._after(key, one, through)))
                    for other in self.follows[key]:
                        self.leads[other].append(key)

    def _through(self, root: ET.Element) -> dict[tuple[Id, Id, int], list[tuple[Id, int]]]:
        """By junction, incoming road and lane, the roads and lanes that lead on."""
        found, linked, bare = defaultdict(list), set[Id](), list[tuple[Id, Id, Id]]()
        for junction in root.iterfind("junction"):
            name = identity(junction.get("id", ""))
            self.junctions[name] = junction.get("type", "default")
            for one in junction.iterfind("connection"):
                to = identity(one.get("connectingRoad") or one.get("linkedRoad") or "")
                if to not in self.roads:
                    continue
                came = identity(one.get("incomingRoad", ""))
                try:
                    ends = [(number(x, "from"), number(x, "to")) for x in one.iter("laneLink")]
                except ValueError as error:
                    self.left_out.append(f"connection {one.get('id')} of junction {name} ({error})")
                    continue
                if not ends:
                    bare.append((name, came, to))
                    continue
                linked.add(to)
                for start, end in ends:
                    found[name, came, int(start)].append((to, int(end)))
        # Of connections without lanes, the links of the connecting road's own lanes count.
        for road in (road for road in self.roads.values() if road.junction != -1):
            if road.id in linked:
                continue
            for place, at in (("start", 0), ("end", -1)):
                kind, other, _ = road.links.get(place, ("", -1, ""))
                for name, lane in road.sections[at].lanes.items() if kind == "road" else ():
                    for before in lane.links[place] if lane.onward == (place == "start") else ():
                        found[road.junction, other, before].append((road.id, name))
                        linked.add(road.id)
        for name, came, to in bare:
            if to not in linked:
                for same in {lane for section in self.roads[to].sections for lane in section.lanes}:
                    found[name, came, same].append((to, same))
        return found

    def _after(
        self, key: LaneKey, lane: Lane, through: Mapping[tuple[Id, Id, int], list[tuple[Id, int]]]
    ) -> Iterator[LaneKey]:
        road, end = self.roads[key[0]], "end" if lane.onward else "start"
        index = key[1] + (1 if lane.onward else -1)
        if 0 <= index < len(road.sections):
            for name in lane.links[end] or [key[2]]:
                if name in road.sections[index].lanes:
                    yield road.id, index, name
            return
        kind, other, contact = road.links.get(end, ("", -1, ""))
        if kind == "junction":
            options, contact = through.get((other, road.id, key[2]), []), ""
        else:
            options = [(other, name) for name in lane.links[end]] if other in self.roads else []
        for beyond, name in options:
            for first, at in (("start", 0), ("end", len(self.roads[beyond].sections) - 1)):
                entered = self.roads[beyond].sections[at].lanes.get(name)
                if entered and entered.onward == (first == "start") and contact in ("", first):
                    yield beyond, at, name
