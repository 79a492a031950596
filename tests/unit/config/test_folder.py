"""The check whether this user can write to a folder, which leaves nothing behind."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from shmio.config.folder import Obstacle, unwritable


@pytest.mark.parametrize("place", ["", "new", "new/and/deeper"])
def test_writable_folder_is_left_unchanged(place: str, tmp_path: Path) -> None:
    assert unwritable(tmp_path / place) is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", [errno.EOPNOTSUPP, errno.EISDIR])
def test_named_file_is_tried_where_unnamed_files_are_not_supported(
    kind: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    really, made = os.open, []

    def refuse_unnamed(path: str, flags: int, *rest: int, **named: int) -> int:
        if flags & os.O_TMPFILE == os.O_TMPFILE:
            raise OSError(kind, os.strerror(kind))
        made.append(path)
        return really(path, flags, *rest, **named)

    monkeypatch.setattr(os, "open", refuse_unnamed)
    assert unwritable(tmp_path) is None
    assert len(made) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("number", "told"),
    [
        (errno.ENOSPC, "the disk is full; make room"),
        (errno.EDQUOT, "the disk quota is used up; make room"),
        (errno.EROFS, "it is mounted read-only; remount it"),
        (errno.EACCES, "this user has no permission; let this user write there"),
        (errno.EIO, "Input/output error"),
    ],
)
def test_obstacle_is_reported_with_a_remedy(
    number: int, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> int:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "open", refuse)
    for folder, what in (("", "cannot be written"), ("/new", f"cannot be created in {tmp_path}")):
        found = unwritable(Path(f"{tmp_path}{folder}"))
        assert found is not None
        assert found.reason.startswith(f"{tmp_path}{folder} {what}: {told}")
        assert found.full == ("make room" in told)


def test_file_system_without_files_is_found_even_as_root(tmp_path: Path) -> None:
    for folder in ("/proc", "/proc/logs"):
        assert "its file system accepts no files; choose another folder" in str(unwritable(Path(folder)))
    (tmp_path / "file").touch()
    assert unwritable(tmp_path / "file/logs") == Obstacle(f"{tmp_path}/file is not a directory")
