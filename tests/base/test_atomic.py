"""Files appear completely or not at all, and errors name the final path."""

import errno
from pathlib import Path

import pytest

from ertis_numba.base.atomic_files import atomic_write


def test_failed_write_leaves_no_file(tmp_path):
    def half(part):
        part.write_text("half")
        raise OSError(errno.EIO, "wanted", str(part))

    with pytest.raises(OSError, match="wanted") as caught, atomic_write(tmp_path / "a.txt") as part:
        half(part)
    assert caught.value.filename == str(tmp_path / "a.txt")
    assert list(tmp_path.iterdir()) == []


def test_first_error_is_reported_if_cleanup_fails_too(tmp_path, monkeypatch):
    """A file system that has become read-only behaves so."""

    def refuse(path, *, missing_ok=False):
        assert missing_ok
        raise OSError(errno.EROFS, "cannot be removed", str(path))

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(OSError, match="cannot be written") as caught, atomic_write(tmp_path / "a.txt") as part:
        raise OSError(errno.EROFS, "cannot be written", str(part))
    assert caught.value.filename == str(tmp_path / "a.txt")


def test_full_disk_is_reported_with_the_name_of_the_file(tmp_path):
    """The system does not name the file if an error concerns an open file."""
    with pytest.raises(OSError, match="No space") as caught, atomic_write(tmp_path / "a.txt"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.filename == str(tmp_path / "a.txt")
