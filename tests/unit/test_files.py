"""Replacing files at once."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from shmio.files import replace_file


def mode_of(file: Path) -> int:
    return file.stat().st_mode & 0o777


def test_a_private_file_is_private_even_if_the_older_one_was_not(tmp_path: Path) -> None:
    file = tmp_path / "settings.json"
    file.write_bytes(b"old")
    file.chmod(0o644)
    replace_file(file, b"new", private=True)
    assert (file.read_bytes(), mode_of(file)) == (b"new", 0o600)
    assert [one.name for one in tmp_path.iterdir()] == ["settings.json"]


def test_other_files_keep_their_permissions(tmp_path: Path) -> None:
    file, fresh = tmp_path / "report.html", tmp_path / "fresh.html"
    file.write_bytes(b"old")
    file.chmod(0o604)
    replace_file(file, b"new", private=False)
    before = os.umask(0o027)
    try:
        replace_file(fresh, b"new", private=False)
    finally:
        os.umask(before)
    assert (mode_of(file), mode_of(fresh)) == (0o604, 0o640)


def test_a_write_that_fails_leaves_the_older_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "report.html"
    file.write_bytes(b"old")

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "replace", refuse)
    with pytest.raises(OSError, match="No space left"):
        replace_file(file, b"new", private=False)
    assert file.read_bytes() == b"old"
    assert [one.name for one in tmp_path.iterdir()] == ["report.html"]
