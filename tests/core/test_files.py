"""Reading files: each once for as long as it does not change, and none beyond its bounds."""

import bz2
import gzip
import io
import os
import pickle
import resource
import zipfile
from contextlib import nullcontext

import numpy as np
import pytest
from pydantic import BaseModel

from inspe_jax.core import files
from inspe_jax.core.errors import LONGEST, InspeError, brief
from inspe_jax.core.words import visible


def test_a_file_is_read_again_only_when_it_changes(tmp_path):
    reads = []

    @files.cached_by_file(4)
    def words(path):
        """The words of a file."""
        reads.append(path.name)
        return path.read_text().split()

    path = tmp_path / "a.txt"
    path.write_text("one two")
    assert words(path) is words(str(path)) is words(path, None)
    path.write_text("one two three")
    os.utime(path, ns=(1, 1))
    assert words(path) == ["one", "two", "three"]
    assert reads == ["a.txt", "a.txt"]
    assert words.__doc__ == "The words of a file."
    path.unlink()
    with pytest.raises(InspeError, match="no such file"):
        words(path)


OTHER = {
    gzip.compress(b"{}"): "is packed with gzip; unpack it: gunzip FILE",
    bz2.compress(b"{}"): "is packed with bzip2; unpack it: bunzip2 FILE",
    b"PK\x03\x04": "is a zip archive",
    b"\0\0\0\r\n\tOSMHeader": "is OpenStreetMap's PBF",
    b'<?xml version="1.0"?>\n<kml xmlns="x"/>': "is KML; make bodies of it: ogr2ogr",
    b"<!-- a map -->\n<osm/>": "is XML of OpenStreetMap or Lanelet2",
    b'{"name": "<kml"}': "",
    b"<!-- netconvert <osm-files value='a.osm'/> -->\n<OpenDRIVE/>": "",
}


def test_a_file_of_another_kind_says_what_it_is(tmp_path):
    path = tmp_path / "bodies.geojson"
    for start, words in OTHER.items():
        path.write_bytes(start)
        with pytest.raises(InspeError, match=words) if words else nullcontext():
            files.check_kind(path)


LAUGHS = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" for k in range(1, 12)
)


@pytest.mark.parametrize(("text", "words"), [
    (LAUGHS, "1,000,000 values, with its aliases"),
    (LAUGHS.replace("[", "{<<: [").replace("]", "]}").replace("x", "{a: 1}"), "its aliases"),
    ("&a [*a]", "its aliases"),
    ("[" * 101 + "]" * 101, "nested more than 100 deep"),
    ("a0: &a0 1\n" + "".join(f"a{k}: &a{k} [*a{k - 1}]\n" for k in range(1, 150)), "100 deep"),
    ("[" * 200_000, "not YAML"),
    ("9" * 5000, "a number of 5,000 digits"),
    ("a: 1\n" * 2, "'a' is given twice, in line 1"),
    ("!!int ''", "not of its tag"),
    ("!!timestamp x", "not of its tag"),
    ("2001-99-99", "month must be"),
    ("? [1]\n: 2", "not YAML"),
    (b"\xff\xfea\0", "not YAML"),
])  # fmt: skip
def test_yaml_that_asks_for_too_much_is_refused_at_once(text, words):
    with pytest.raises(InspeError, match=r"a\.yaml: not YAML: ") as caught:
        files.parse_yaml(text, "a.yaml")
    assert words in str(caught.value)
    assert len(str(caught.value)) < 300


def test_yaml_of_many_keys_aliases_and_merges_is_read():
    keys = files.parse_yaml("".join(f"k{k}: &k{k} {k}\n" for k in range(60_000)), "a.yaml")
    assert keys["k59999"] == 59_999
    assert files.parse_yaml("a: &a {x: 1, y: 2}\nb: {<<: *a, y: 3}", "a")["b"] == {"x": 1, "y": 3}


@pytest.mark.parametrize(("read", "make"), [
    (files.read_yaml, os.mkfifo),
    (files.read_json, os.mkdir),
    (files.read_toml, lambda path: os.symlink("/dev/zero", path)),
])  # fmt: skip
def test_what_is_no_file_is_not_opened(tmp_path, read, make):
    make(tmp_path / "a")
    with pytest.raises(InspeError, match=r"a: is (a folder|not a file on disk); name"):
        read(tmp_path / "a")


def test_files_of_too_many_bytes_and_of_too_deep_text_are_refused(tmp_path):
    path = tmp_path / "a"
    with path.open("wb") as f:
        f.truncate(files.YAML + 1)
    for read in (files.read_yaml, files.read_toml):
        with pytest.raises(InspeError, match="a: has more than 4 MB of content"):
            read(path)
    for read, text, words in (
        (files.read_toml, "a = " + "[" * 5000 + "]" * 5000, "a: not TOML"),
        (files.read_toml, "a = " + "9" * 5000, "a: not TOML"),
        (files.read_json, "[" * 100_000, "a: not JSON"),
        (files.read_json, "9" * 5000, "a: not JSON: a number of 5,000 digits"),
    ):
        path.write_text(text)
        with pytest.raises(InspeError, match=words):
            read(path)


def zipped(*members: tuple[str, bytes]) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return made.getvalue()


def header(*shape: int) -> bytes:
    text = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        text, {"shape": shape, "fortran_order": False, "descr": "<f8"}
    )
    return text.getvalue()


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(("members", "words"), [
    ([("a.npy", header(2**18) + bytes(2**21))], "has more than 1 MB of arrays"),
    ([("a.npy", header(0)), ("other", bytes(2**21))], "has more than 1 MB of arrays"),
    ([("a.npy", header(10**15))], "not this"),
    ([("a.npy", header(-1))], "not this"),
    ([("a.npy", header(0)), ("a.npy", header(0))], "not this"),
    ([("b.npy", header(0))], "not this"),
])  # fmt: skip
def test_arrays_are_bounded_before_they_are_unpacked(tmp_path, members, words, monkeypatch):
    monkeypatch.setattr(files, "ARRAYS", 2**20)
    (tmp_path / "a.npz").write_bytes(zipped(*members))
    with (
        pytest.raises(InspeError, match=rf"a\.npz: .*{words}"),
        files.open_arrays(tmp_path / "a.npz", "not this") as arrays,
    ):
        arrays["a"]


@pytest.mark.parametrize(("text", "words"), [
    (b"<osm>" + b"<a>" * 200_000, "nested more than 100 deep"),
    (gzip.compress(b"<osm>" + b" " * 2**27, 1), "has more than 67 MB of unpacked text"),
    (gzip.compress(b"<osm/>")[:-9], "not well-formed XML"),
    (b"<" + b"x" * 60_000 + b"/>", "the root element is <x+>, not <osm>"),
    (b"<osm>", "not well-formed XML"),
    (b"<!DOCTYPE a [<!ENTITY a SYSTEM 'b'>]><osm>&a;</osm>", "has XML entities of its own"),
    (b"<!DOCTYPE a SYSTEM 'b'><osm>&a;</osm>", "has XML entities of its own"),
], ids=["deep", "bomb", "cut", "root", "open", "entity", "outside"])  # fmt: skip
def test_xml_is_bounded_before_its_tree_is_made(text, words, tmp_path):
    (tmp_path / "a").write_bytes(text)
    read = gzip.open if text[:2] == b"\x1f\x8b" else open
    with read(tmp_path / "a", "rb") as file, pytest.raises(InspeError, match=words) as caught:
        files.check_xml(file, "a.osm", "osm")
    assert len(str(caught.value)) < 200


class Row(BaseModel):
    """A model of what a user writes."""

    model_config = files.STRICT
    height: float = 0.0
    count: int = 0
    names: list[str] = []


@pytest.mark.parametrize(("text", "words"), [
    ("height: 1e9", "height: must be a number (in YAML without quotes, and 1.0e+9, not 1e9)"),
    ("count: '5'", "count: must be a whole number (without quotes), got '5'"),
    (f"height: '{'x' * 60_000}'", "1e9), got 'xxx"),
    (f"names: '{'x' * 60_000}'", "names: must be a list, got 'xxx"),
    (f"{'x' * 900}: 1", "unknown key; allowed: count, height, names"),
])  # fmt: skip
def test_a_wrong_value_is_quoted_shortly(text, words):
    with pytest.raises(InspeError) as caught:
        files.check_model(Row, files.parse_yaml(text, "a"), "a.yaml")
    assert words in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_messages_are_of_bounded_length_and_of_visible_characters():
    for text in ("x" * 60_000, "a\u202e" * 2000):
        error = InspeError(f"begin {text} end")
        assert len(str(error)) <= LONGEST
        assert pickle.loads(pickle.dumps(error)).args == error.args  # as between processes
    assert str(InspeError("begin " + "x" * 60_000 + " end")).endswith("x end")
    assert str(InspeError("a\u202eb\x1b[2J\nc")) == "a\\u202eb\\x1b[2J\nc"
    assert brief(16**5000) == "a number of thousands of digits"
    bomb = files.parse_yaml(LAUGHS[: LAUGHS.index("a5:")], "a")
    assert len(brief(bomb)) <= 80
    assert visible("Müller 7\u202e12") == "Müller 7\\u202e12"


CELLS = ["=cmd|' /C calc'!A0", "+1+cmd", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "＝1", "'=1", "''@x"]


def test_text_of_a_table_is_no_formula_and_numbers_stay():
    """OWASP's list. What is read back is what was written."""
    plain = ["-1.5", "+2", "-inf", "a=b", "-", "it's", "'quoted'", "", "-1e-7"]
    rows = [{"name": cell, "=head()": -1.5} for cell in CELLS + plain]
    text = files.csv_text(rows)
    lines = [line.lstrip('"') for line in text.split("\n")[1:]]
    assert text.startswith("name,'=head()\n")
    assert not any(line.startswith(tuple("=@\t\r＝")) for line in lines)
    assert {"'-2+3,-1.5", "-1.5,-1.5", "+2,-1.5"} < set(lines)
    assert [row["name"] for row in files.parse_csv(text.encode(), "a")] == CELLS + plain
    assert files.parse_csv(text.encode(), "a")[0]["=head()"] == "-1.5"


def test_a_disk_that_is_full_is_named_with_the_file(tmp_path):
    """A limit on the size of files fails as a full disk does: in the middle of a write."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises(InspeError, match=r"a\.yaml: cannot be written: File too large"):
            files.write_text(tmp_path / "a.yaml", "x" * 5000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())
