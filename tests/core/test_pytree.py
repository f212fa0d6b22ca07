"""Dataclasses as pytrees."""

from dataclasses import field, make_dataclass, replace

import jax
import numpy as np

from inspe_jax.core.pytree import pytree


def dataclass_of(name: str) -> type:
    of = {"metadata": {"static": True}}
    rows = ("x", object), ("fixed", int, field(**of)), ("y", object, field(default=None))
    return pytree(make_dataclass(name, rows, frozen=True))


One, Other = dataclass_of("One"), dataclass_of("Other")


def test_there_and_back_with_the_names_of_fields():
    one = One(np.arange(3.0), 7, {"a": 2.0})
    leaves, structure = jax.tree.flatten(one)
    assert len(leaves) == 2
    back = jax.tree.unflatten(structure, leaves)
    assert (type(back), back.fixed, back.y) == (One, 7, {"a": 2.0})
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(one)]
    assert paths == [".x", ".y['a']"]
    assert structure != jax.tree.structure(replace(one, fixed=8))


def test_two_classes_with_the_same_fields_have_structures_that_differ():
    """Else programs traced for one run on the other: JAX's own dataclasses are taken as equal."""
    assert jax.tree.structure(One(1.0, 7)) != jax.tree.structure(Other(1.0, 7))
