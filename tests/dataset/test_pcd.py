"""PCD files: written and read back, read from other programs, and rejected with one message."""

import contextlib
import struct
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from inspe_jax.core.errors import InspeError
from inspe_jax.dataset.formats.pcd import read_notes, read_pcd, write_pcd

POINTS = st.lists(
    st.tuples(*[st.floats(-500, 500, width=32)] * 3, st.integers(0, 255).map(lambda i: i / 255)),
    max_size=20,
).map(lambda rows: np.array(rows, np.float32).reshape(-1, 4))


def header(data: str = "ascii", **changes: str) -> str:
    """A header of two points; a key changed to "" is left out."""
    keys = dict(VERSION="0.7", FIELDS="x y z rgb", SIZE="4 4 4 4", TYPE="F F F F", COUNT="1 1 1 1")
    keys |= dict(WIDTH="2", HEIGHT="1", VIEWPOINT="0 0 0 1 0 0 0", POINTS="2", DATA=data)
    return "".join(f"{key} {value}\n" for key, value in {**keys, **changes}.items() if value)


def put(folder: Path, content: str | bytes) -> Path:
    path = folder / "a.pcd"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@given(POINTS)
def test_written_points_read_back(points):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.pcd"
        write_pcd(path, points)
        read = read_pcd(path)
        assert read.dtype == np.float32
        np.testing.assert_array_equal(read[:, :3], points[:, :3])
        np.testing.assert_array_equal(np.rint(read[:, 3] * 255), np.rint(points[:, 3] * 255))


def test_bytes_are_as_the_format_says(tmp_path):
    """Intensity 1/2 rounds to 128 of 255, in the third byte of a little-endian 0x00RRGGBB."""
    path = tmp_path / "a.pcd"
    write_pcd(path, [[1.0, -2.0, 3.5, 0.5], [0.0, 0.0, 0.0, 1.0]], note="no beam")
    assert "no beam" in read_notes(path)
    head, body = path.read_bytes().split(b"DATA binary\n")
    assert b"FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\n" in head
    assert b"WIDTH 2\nHEIGHT 1\n" in head
    assert b"POINTS 2\n" in head
    assert body == struct.pack("<3fI3fI", 1, -2, 3.5, 0x00800000, 0, 0, 0, 0xFF0000)


def test_ascii_of_other_programs(tmp_path):
    """``rgb`` as the float with the bits of 0x00800000, to ten digits; also with DOS line ends."""
    text = header() + "1 -2 3.5 1.175494351e-38\n4 5 6 0\n"
    expected = [[1, -2, 3.5, 128 / 255], [4, 5, 6, 0]]
    for end in ("\n", "\r\n"):
        found = read_pcd(put(tmp_path, text.replace("\n", end)))
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_fields_in_any_order_and_more_of_them(tmp_path):
    """A field of three values, padding under a repeated name, doubles and an integer colour."""
    row = np.dtype("<u4, <f8, <f4, <i2, <f8, <f8, u1, u1", align=False)
    rows = np.array([(0x12FF3456, 3, 9, 7, 2, 1, 0, 0), (0, 6, 9, 7, 5, 4, 0, 0)], row)
    keys = dict(SIZE="4 8 4 2 8 8 1 1", TYPE="U F F I F F U U", COUNT="1 1 1 1 1 1 1 1")
    text = header("binary", FIELDS="rgb z n ring y x _ _", **keys)
    expected = [[1, 2, 3, 1], [4, 5, 6, 0]]
    np.testing.assert_array_equal(read_pcd(put(tmp_path, text.encode() + rows.tobytes())), expected)
    text = header(FIELDS="z n y x rgb", SIZE="4 4 4 4 4", TYPE="F F F F U", COUNT="1 3 1 1 1")
    text += f"3 9 9 9 2 1 {0xFF0000}\n6 9 9 9 5 4 0\n"
    np.testing.assert_array_equal(read_pcd(put(tmp_path, text)), expected)


@pytest.mark.parametrize(("text", "expected"), [
    (header(FIELDS="x y z intensity") + "1 2 3 0.25\n4 5 6 1\n", [0.25, 1]),
    (header(FIELDS="x y z", SIZE="4 4 4", TYPE="F F F", COUNT="") + "1 2 3\n4 5 6\n", [0, 0]),
    (header(WIDTH="3", POINTS="3") + "1 2 3 0\nnan nan nan 0\n4 5 6 0\n", [0, 0]),
], ids=["an intensity in place of a colour", "neither", "empty places are left out"])  # fmt: skip
def test_intensities_and_empty_places(tmp_path, text, expected):
    points = np.column_stack([[[1, 2, 3], [4, 5, 6]], expected])
    np.testing.assert_array_equal(read_pcd(put(tmp_path, text)), points)


@pytest.mark.parametrize(("content", "message"), [
    (b"", "ends before DATA"),
    (b"\x89PNG\r\n\x1a\n\x00\x00", "not a PCD file: its header holds"),
    (header("binary_compressed"), "DATA binary_compressed cannot be read"),
    (header(VERSION="0.5"), "VERSION 0.5: must be 0.7"),
    (header(FIELDS=""), "FIELDS is missing"),
    (header(POINTS="two"), "POINTS two: must be whole numbers"),
    (header(POINTS="", WIDTH=""), "POINTS is missing"),
    (header(POINTS="3"), "3 POINTS are not WIDTH 2 x HEIGHT 1"),
    (header(POINTS="-2", WIDTH="-2"), "POINTS is missing or not a number"),
    (header(SIZE="4 4 4"), "do not have the same length"),
    (header(COUNT="1 1 1 99999999999"), "field rgb: TYPE F SIZE 4 COUNT 99999999999"),
    (header(TYPE="F F F X"), "field rgb: TYPE X"),
    (header(FIELDS="x y w rgb") + "1 2 3 0\n4 5 6 0\n", "no field z; the fields are x, y, w"),
    (header(SIZE="4 4 4 8") + "1 2 3 0\n4 5 6 0\n", "field rgb: SIZE 8"),
    (header() + "1 2 3 0\n4 5 6\n", "2 POINTS need 4 numbers each, there are 7"),
    (header() + "1 2 3 0\n4 5 six 0\n", "not numbers"),
    (header("binary") + "too short", "cut short: 2 POINTS need 32 bytes, there are 9"),
])  # fmt: skip
def test_other_files_are_rejected(tmp_path, content, message):
    path = put(tmp_path, content)
    with pytest.raises(InspeError, match=message) as e:
        read_pcd(path)
    assert str(e.value).startswith(str(path))


@given(st.data())
def test_damaged_files_are_rejected_or_read(data):
    """A cut and a changed byte give an InspeError or points, never another error."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.pcd"
        write_pcd(path, np.ones((3, 4)))
        content = bytearray(path.read_bytes())
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
        with contextlib.suppress(InspeError):
            assert read_pcd(path).shape[1] == 4
