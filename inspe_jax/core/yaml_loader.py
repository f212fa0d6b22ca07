"""A YAML loader for every file: strict, without code, and bounded before values are made."""

import math
from typing import Any

import yaml

from inspe_jax.core.errors import brief

VALUES, DEPTH, DIGITS = 10**6, 100, 40
"""Most values of a YAML text, with each alias written out; greatest depth of YAML and of XML; most
digits of a whole number."""


class _Loader(yaml.CSafeLoader):
    """A YAML loader for which a key given twice is an error. Nodes are made by recursion, in C: it
    ends at :data:`DEPTH`, before the stack does."""

    level = 0

    def descend_resolver(self, parent: Any, index: Any) -> None:
        """Called before each node is made. Raises YAMLError where they are nested too deep."""
        self.level += 1
        if self.level > DEPTH + 1:  # a scalar is a node too
            raise yaml.YAMLError(f"is nested more than {DEPTH} deep")

    def ascend_resolver(self) -> None:
        """Called once a node is made."""
        self.level -= 1

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """The mapping; raises YAMLError on a key given twice."""
        seen = set[Any]()
        own = (key for key, _ in node.value if key.tag != "tag:yaml.org,2002:merge")
        for key in (self.construct_object(key, deep=True) for key in own):
            if key in seen:
                raise yaml.YAMLError(f"the key {brief(key)} is given twice,{node.start_mark}")
            seen.add(key)
        return super().construct_mapping(node, deep)


def _whole(loader: Any, node: yaml.ScalarNode) -> int:
    check_digits(node.value)
    return loader.construct_yaml_int(node)


_Loader.add_constructor("tag:yaml.org,2002:int", _whole)


def check_digits(text: str) -> str:
    """The text of a whole number. Raises ValueError if it has more than :data:`DIGITS` digits."""
    if len(text) > DIGITS:
        raise ValueError(f"a number of {len(text):,} digits; at most {DIGITS} are read")
    return text


def load_yaml(text: str) -> Any:
    """The content of a YAML text. Raises YAMLError if it is not YAML, has a key twice, or is larger
    than :data:`VALUES` and :data:`DEPTH`; and what PyYAML raises on a value not of its tag."""
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        _measured(node, 1, {})
        return loader.construct_document(node)
    finally:
        loader.dispose()


def _measured(node: Any, level: int, known: dict[int, tuple[float, int]]) -> tuple[float, int]:
    """The values and the depth of a node, whose aliases count as if they were written out."""
    if isinstance(node, yaml.ScalarNode):
        return 1, 0
    values, depth = known.get(id(node), (0, 0))
    if not values and level <= DEPTH:
        known[id(node)] = math.inf, 0  # what contains itself has no end
        pairs = isinstance(node, yaml.MappingNode)
        parts = [part for pair in node.value for part in pair] if pairs else node.value
        sizes = [_measured(part, level + 1, known) for part in parts]
        values = 1 + sum(size for size, _ in sizes)
        depth = 1 + max((deep for _, deep in sizes), default=0)
        known[id(node)] = values, depth
    if values > VALUES:
        raise yaml.YAMLError(
            f"has more than {VALUES:,} values, with its aliases written out,{node.start_mark}"
        )
    if level + depth > DEPTH:
        raise yaml.YAMLError(f"is nested more than {DEPTH} deep,{node.start_mark}")
    return values, depth
