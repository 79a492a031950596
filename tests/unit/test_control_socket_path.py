"""The path of the control socket, and folders that are unsuitable for it."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from shmio.control import MAX_PATH_BYTES, socket_path
from shmio.errors import ControlError


@pytest.fixture(autouse=True)
def no_other_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def test_the_socket_is_in_the_users_runtime_folder(tmp_path: Path) -> None:
    assert socket_path("a50") == str(tmp_path / "shmio" / "a50.sock")
    assert stat.S_IMODE((tmp_path / "shmio").stat().st_mode) == 0o700


def test_an_open_folder_is_made_private(tmp_path: Path) -> None:
    (tmp_path / "shmio").mkdir(mode=0o777)
    socket_path("a50")
    assert stat.S_IMODE((tmp_path / "shmio").stat().st_mode) == 0o700


def test_a_symbolic_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "shmio").symlink_to(tmp_path / "elsewhere")
    assert not socket_path("a50").startswith(str(tmp_path))
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_folder_whose_path_is_too_long_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    deep = tmp_path / ("d" * 100)
    deep.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(deep))
    path = socket_path("a50")
    assert not path.startswith(str(deep))
    assert len(path.encode()) <= MAX_PATH_BYTES


def test_no_suitable_folder_is_an_error_with_the_reason() -> None:
    with pytest.raises(ControlError, match="longer than 107 bytes"):
        socket_path("a" * 120)
