"""Reading files: each once for as long as it does not change."""

import os

import pytest

from inspe_jax.core.errors import InspeError
from inspe_jax.core.files import cached_by_file


def test_a_file_is_read_again_only_when_it_changes(tmp_path):
    reads = []

    @cached_by_file(4)
    def words(path):
        """The words of a file."""
        reads.append(path.name)
        return path.read_text().split()

    path = tmp_path / "a.txt"
    path.write_text("one two")
    assert words(path) is words(str(path))
    path.write_text("one two three")
    os.utime(path, ns=(1, 1))
    assert words(path) == ["one", "two", "three"]
    assert reads == ["a.txt", "a.txt"]
    assert words.__doc__ == "The words of a file."
    path.unlink()
    with pytest.raises(InspeError, match="no such file"):
        words(path)
