"""A layout's files: what another run has written is never replaced unasked."""

import os
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.sensing.layout import load_layout, save_layout
from inspe_jax.viewer.store import LayoutStore


@pytest.fixture
def path(tmp_path):
    return tmp_path / "moved.yaml"


def raised(layout, by):
    return replace(layout, poses=np.array(layout.poses) + [0, 0, by, 0, 0, 0])


def heights(path):
    return load_layout(path).poses[:, 2]


def test_a_new_file_is_written_without_a_question(path, layout):
    store = LayoutStore(path, layout)
    assert store.earlier == []
    higher = raised(layout, 1.0)
    store.keep(higher)
    kept = store.unsaved
    assert kept.is_file()
    assert not store.would_replace(higher)
    store.save(higher)
    assert not store.would_replace(layout)  # it is this run's own
    assert not kept.exists()
    assert store.holds(higher)
    np.testing.assert_allclose(heights(path), higher.poses[:, 2])


def test_what_was_saved_earlier_is_offered_and_not_replaced_unasked(path, layout):
    """Start, save, end; start again: the first layout opens, and what was saved is better."""
    better, other = raised(layout, 1.0), raised(layout, 2.0)
    LayoutStore(path, layout).save(better)
    store = LayoutStore(path, layout)
    assert store.earlier == [path]
    assert store.would_replace(other)
    store.save(other, store.beside)
    assert store.path.name == "moved-2.yaml"
    np.testing.assert_allclose(heights(path), better.poses[:, 2])
    np.testing.assert_allclose(heights(store.path), other.poses[:, 2])
    assert not store.would_replace(other)
    assert store.beside.name == "moved-2-2.yaml"
    again = LayoutStore(path, layout)
    assert {at.name for at in again.earlier} == {"moved.yaml", "moved-2.yaml"}
    opened = again.open(path)
    np.testing.assert_allclose(opened.poses, better.poses, atol=1e-8)
    assert again.holds(opened)
    assert not again.would_replace(opened)
    assert again.would_replace(layout)  # taken back: the better one would be lost


def test_what_is_opened_from_its_own_file_is_saved_there_unless_somebody_changed_it(path, layout):
    save_layout(layout, path)
    store, moved = LayoutStore(path, load_layout(path)), raised(layout, 1.0)
    assert store.earlier == []
    assert not store.would_replace(moved)
    path.write_text(path.read_text() + "# a word of mine\n")
    assert store.would_replace(moved)


def test_what_an_earlier_run_did_not_save_is_kept_until_what_became_of_it_is(path, layout):
    first, second = raised(layout, 1.0), raised(layout, 2.0)
    before = LayoutStore(path, layout)
    before.keep(first)
    store = LayoutStore(path, layout)
    kept = before.unsaved
    assert store.earlier == [kept]
    store.keep(second)
    assert store.unsaved != kept
    np.testing.assert_allclose(heights(kept), first.poses[:, 2])
    opened = store.open(store.earlier[0])
    np.testing.assert_allclose(opened.poses, first.poses, atol=1e-8)
    assert not store.holds(opened)
    store.keep(layout)  # taken back
    store.save(layout)
    assert kept.is_file()
    store.save(opened)
    assert not kept.exists()  # it is in the layout's file now
    assert heights(path)[0] == pytest.approx(first.poses[0, 2])


def test_the_newest_of_what_earlier_runs_left_is_offered(path, layout):
    """Also what they kept beside what others had left; not what is no layout's name."""
    names = ["moved.unsaved.yaml", "moved.unsaved-2.yaml", "moved-3.yaml", "moved.yaml", "a.yaml"]
    for age, name in enumerate(names):
        at = path.with_name(name)
        save_layout(raised(layout, 1.0 + age), at)
        os.utime(at, (1e9 - age, 1e9 - age))
    offered = [at.name for at in LayoutStore(path, layout).earlier]
    assert offered == names[:4]


@pytest.mark.parametrize("begun", [False, True])
def test_what_is_said_to_be_kept_is_what_was_written(path, layout, monkeypatch, begun):
    """On a full disk, or where the folder is read-only for a moment; then it is kept again."""
    store, moved = LayoutStore(path, layout), raised(layout, 2.0)
    if begun:
        store.keep(raised(layout, 1.0))

    why = "moved.unsaved.yaml: No space left on device"
    with monkeypatch.context() as full:
        full.setattr("inspe_jax.viewer.store.save_layout", Mock(side_effect=InspeError(why)))
        with pytest.raises(InspeError, match="No space left"):
            store.keep(moved)
        assert store.kept(moved) is None
        assert store.words(moved) == f"{path}, not saved yet, and kept in no file: {why}"
    assert [found.name for found in path.parent.iterdir()] == ["moved.unsaved.yaml"] * begun
    store.keep(moved)
    assert store.words(moved) == f"{path}, not saved yet, kept in {store.unsaved}"
    np.testing.assert_allclose(heights(store.kept(moved)), moved.poses[:, 2])
    store.save(moved)
    assert store.words(moved) == str(path)
    assert store.kept(moved) is None


def test_runs_at_the_same_time_keep_to_files_of_their_own(path, layout):
    """One goes back and forth, so that its file goes and comes, while another begins."""
    first, second = LayoutStore(path, layout), LayoutStore(path, layout)
    first.keep(raised(layout, 1.0))
    first.keep(layout)
    second.keep(raised(layout, 2.0))
    first.keep(raised(layout, 3.0))
    first.keep(layout)
    np.testing.assert_allclose(heights(second.unsaved), raised(layout, 2.0).poses[:, 2])
    second.unsaved.write_text("mine now")
    second.keep(layout)
    assert second.path.with_name("moved.unsaved.yaml").read_text() == "mine now"


def test_a_link_is_followed_and_a_folder_s_name_is_kept(path, layout, tmp_path, monkeypatch):
    target = tmp_path / "elsewhere.yaml"
    path.symlink_to(target)
    LayoutStore(path, layout).save(layout)
    assert path.is_symlink()
    assert target.is_file()
    monkeypatch.chdir(tmp_path)
    store = LayoutStore("here.yaml", layout)
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    store.save(layout)
    assert (tmp_path / "here.yaml").is_file()


def test_a_file_that_is_no_layout_is_neither_replaced_nor_opened(path, layout):
    path.write_text("shopping: [milk]\n")
    store = LayoutStore(path, layout)
    assert store.would_replace(layout)
    with pytest.raises(InspeError, match=r"moved.yaml: .*shopping|moved.yaml: .*unknown key"):
        store.open(store.earlier[0])


def test_a_report_stands_beside_another_run_s(path, layout):
    path.with_suffix(".html").write_text("mine")
    store = LayoutStore(path, layout)
    pages = [store.write_page(text) for text in ("first", "second")]  # its own it replaces
    assert [page.name for page in pages] == ["moved-2.html"] * 2
    assert path.with_suffix(".html").read_text() == "mine"
    assert path.with_name("moved-2.html").read_text() == "second"
