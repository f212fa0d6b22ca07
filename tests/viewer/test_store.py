"""A layout's files: what another run has written is never replaced unasked."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import world

from inspe_jax.errors import InspeError
from inspe_jax.placement.problem import Case
from inspe_jax.sensing.layout import load_layout, save_layout
from inspe_jax.viewer.store import Store


@pytest.fixture
def path(tmp_path):
    return tmp_path / "moved.yaml"


def raised(layout, by):
    return replace(layout, poses=np.array(layout.poses) + [0, 0, by, 0, 0, 0])


def heights(path):
    return load_layout(path).poses[:, 2]


def test_a_new_file_is_written_without_a_question(path, layout):
    store = Store(path, layout)
    assert store.earlier == ()
    higher = raised(layout, 1.0)
    store.keep(higher)
    assert store.unsaved.is_file()
    assert not store.would_replace()
    store.save(higher)
    assert not store.would_replace()  # it is this run's own
    assert not store.unsaved.exists()
    assert store.holds(higher)
    np.testing.assert_allclose(heights(path), higher.poses[:, 2])


def test_what_was_saved_earlier_is_offered_and_not_replaced_unasked(path, layout):
    """Start, save, end; start again: the first layout opens, and what was saved is better."""
    better, other = raised(layout, 1.0), raised(layout, 2.0)
    Store(path, layout).save(better)
    store = Store(path, layout)
    assert [earlier.path for earlier in store.earlier] == [path]
    assert "moved.yaml" in store.earlier[0].words
    assert store.would_replace()
    store.save(other, store.beside)
    assert store.path.name == "moved-2.yaml"
    np.testing.assert_allclose(heights(path), better.poses[:, 2])
    np.testing.assert_allclose(heights(store.path), other.poses[:, 2])
    assert not store.would_replace()
    assert store.beside.name == "moved-2-2.yaml"


def test_what_was_saved_earlier_can_be_gone_on_from(path, layout):
    better = raised(layout, 1.0)
    Store(path, layout).save(better)
    store = Store(path, layout)
    opened = store.open(store.earlier[0])
    np.testing.assert_allclose(opened.poses, better.poses, atol=1e-8)
    assert store.holds(opened)
    assert not store.would_replace()


def test_what_is_opened_from_its_own_file_is_saved_there(path, layout):
    save_layout(layout, path)
    store = Store(path, load_layout(path))
    assert store.earlier == ()
    assert not store.would_replace()


def test_a_file_that_somebody_changed_meanwhile_is_not_replaced_unasked(path, layout):
    store = Store(path, layout)
    store.save(raised(layout, 1.0))
    path.write_text(path.read_text() + "# a word of mine\n")
    assert store.would_replace()


def test_what_an_earlier_run_did_not_save_is_kept_until_what_became_of_it_is(path, layout):
    first, second = raised(layout, 1.0), raised(layout, 2.0)
    before = Store(path, layout)
    before.keep(first)
    store = Store(path, layout)
    assert [earlier.path for earlier in store.earlier] == [before.unsaved]
    store.keep(second)
    assert store.unsaved != before.unsaved
    np.testing.assert_allclose(heights(before.unsaved), first.poses[:, 2])
    opened = store.open(store.earlier[0])
    np.testing.assert_allclose(opened.poses, first.poses, atol=1e-8)
    assert not store.holds(opened)
    store.keep(layout)  # taken back
    assert before.unsaved.is_file()
    store.save(opened)
    assert not before.unsaved.exists()
    assert not store.unsaved.exists()


def test_a_file_that_is_no_layout_is_neither_replaced_nor_opened(path, layout):
    path.write_text("shopping: [milk]\n")
    store = Store(path, layout)
    assert store.would_replace()
    with pytest.raises(InspeError, match=r"moved.yaml: .*shopping|moved.yaml: .*unknown key"):
        store.open(store.earlier[0])


def test_a_report_stands_beside_another_run_s(path, layout):
    scene = world(radius=14.0, voxel=2.0, frames=2, count=2)
    path.with_suffix(".html").write_text("mine")
    store, told = Store(path, layout), []
    for _ in range(2):  # its own it replaces
        assert store.report(Case(scene), layout, (0.3, 0.5, 0.2), 0, lambda *x: told.append(x))
        store.close()
    assert [(page.name, wrong) for page, wrong in told] == [("moved-2.html", None)] * 2
    assert path.with_suffix(".html").read_text() == "mine"
