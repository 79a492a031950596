"""The file of a UNIX socket: what is in its way, who may open it, when it goes."""

from __future__ import annotations

import errno
import os
import socket
import stat
from pathlib import Path

import pytest

from shmio.config.address import MAX_PATH_BYTES
from shmio.config.unix_socket import SocketFile, clear, obstacle
from shmio.errors import EndpointError


def bound(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    return listener


def test_what_a_dead_process_left_is_cleared(tmp_path: Path) -> None:
    path = tmp_path / "s"
    clear(str(path))
    bound(path).close()
    assert path.is_socket()
    assert obstacle(str(path)) is None
    clear(str(path))
    assert not path.exists()


def test_what_a_living_one_has_is_not_taken(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with bound(path) as listener:
        listener.listen(0)
        for _ in range(3):  # its queue is full by then
            with pytest.raises(EndpointError, match=rf"unix:{path}: another program listens there.*ss -xlp"):
                clear(str(path))
    assert path.is_socket()


def test_what_another_user_left_in_a_folder_for_all_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "s"
    bound(path).close()

    def unlink(_: Path, **__: bool) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "unlink", unlink)
    with pytest.raises(EndpointError, match=rf"unix:{path}: .* \(Operation not permitted\): have its owner do it"):
        clear(str(path))


def test_what_is_no_socket_is_left(tmp_path: Path) -> None:
    for name in ("file", "link"):
        path = tmp_path / name
        path.write_text("precious") if name == "file" else path.symlink_to(tmp_path / "file")
        with pytest.raises(EndpointError, match="not a socket: move it away"):
            clear(str(path))
        assert path.read_text() == "precious"
    with pytest.raises(EndpointError, match=r"there is no folder .*nowhere: mkdir -p it"):
        clear(str(tmp_path / "nowhere" / "s"))


@pytest.mark.parametrize(("gid", "mode"), [(None, 0o600), (os.getegid(), 0o660)])
def test_its_user_may_open_it_and_maybe_a_group(tmp_path: Path, gid: int | None, mode: int) -> None:
    path = tmp_path / "s"
    before = os.umask(0)  # as open as it gets
    try:
        file = SocketFile(str(path), gid)
        with file.binding() as place, bound(Path(place)) as listener:
            assert not path.exists()
            (folder,) = tmp_path.iterdir()
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700, "nobody else comes to it before it has its mode"
            listener.listen(1)
        assert stat.S_IMODE(path.stat().st_mode) == mode
        assert path.stat().st_gid == os.getegid()
        assert os.umask(0) == 0, "which all threads share"
    finally:
        os.umask(before)
    assert list(tmp_path.iterdir()) == [path]
    file.remove()
    assert not path.exists()
    file.remove()


def test_its_path_may_be_as_long_as_a_socket_s(tmp_path: Path) -> None:
    path = tmp_path / ("s" * (MAX_PATH_BYTES - len(str(tmp_path)) - 1))
    file = SocketFile(str(path), None)
    with file.binding() as place:
        bound(Path(place)).close()
    assert path.is_socket()


def test_what_has_come_there_meanwhile_stays(tmp_path: Path) -> None:
    path = tmp_path / "s"
    file = SocketFile(str(path), None)
    other = bound(tmp_path / "other")

    def bind_late() -> None:
        with file.binding() as place:
            bound(Path(place)).close()
            (tmp_path / "other").rename(path)

    with other, pytest.raises(EndpointError, match=f"unix:{path}: File exists"):
        bind_late()
    assert path.is_socket()
    file.remove()
    assert path.is_socket()


def test_another_ones_socket_of_that_name_stays(tmp_path: Path) -> None:
    path = tmp_path / "s"
    file = SocketFile(str(path), None)
    with file.binding() as place:
        bound(Path(place)).close()
    path.rename(tmp_path / "old")  # so that its inode is not given to the next
    with bound(path):
        file.remove()
        assert path.is_socket()
