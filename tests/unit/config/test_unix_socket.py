"""The file of a UNIX socket: other files at its path, its permissions, and its removal."""

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


def test_socket_of_a_dead_process_is_removed(tmp_path: Path) -> None:
    path = tmp_path / "s"
    clear(str(path))
    bound(path).close()
    assert path.is_socket()
    assert obstacle(str(path)) is None
    clear(str(path))
    assert not path.exists()


def test_socket_of_a_living_process_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "s"
    with bound(path) as listener:
        listener.listen(0)
        for _ in range(3):  # the later attempts find the queue full
            with pytest.raises(EndpointError, match=rf"unix:{path}: another program listens there.*ss -xlp"):
                clear(str(path))
    assert path.is_socket()


def test_socket_that_cannot_be_removed_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "s"
    bound(path).close()

    def unlink(_: Path, **__: bool) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "unlink", unlink)
    with pytest.raises(
        EndpointError, match=rf"unix:{path}: .* \(Operation not permitted\); ask its owner to remove it"
    ):
        clear(str(path))


def test_file_that_is_no_socket_is_kept(tmp_path: Path) -> None:
    for name in ("file", "link"):
        path = tmp_path / name
        path.write_text("precious") if name == "file" else path.symlink_to(tmp_path / "file")
        with pytest.raises(EndpointError, match="not a socket; move it away"):
            clear(str(path))
        assert path.read_text() == "precious"
    with pytest.raises(EndpointError, match=r"there is no folder .*nowhere; create it"):
        clear(str(tmp_path / "nowhere" / "s"))


@pytest.mark.parametrize(("gid", "mode"), [(None, 0o600), (os.getegid(), 0o660)])
def test_permissions_for_the_user_and_a_group(tmp_path: Path, gid: int | None, mode: int) -> None:
    path = tmp_path / "s"
    before = os.umask(0)  # the most permissive
    try:
        file = SocketFile(str(path), gid)
        with file.binding() as place, bound(Path(place)) as listener:
            assert not path.exists()
            (folder,) = tmp_path.iterdir()
            assert stat.S_IMODE(folder.stat().st_mode) == 0o700, (
                "no other user can reach the socket before it has its mode"
            )
            listener.listen(1)
        assert stat.S_IMODE(path.stat().st_mode) == mode
        assert path.stat().st_gid == os.getegid()
        assert os.umask(0) == 0, "the umask, which all threads share, is unchanged"
    finally:
        os.umask(before)
    assert list(tmp_path.iterdir()) == [path]
    file.remove()
    assert not path.exists()
    file.remove()


def test_path_may_have_the_full_length_of_a_socket_address(tmp_path: Path) -> None:
    path = tmp_path / ("s" * (MAX_PATH_BYTES - len(str(tmp_path)) - 1))
    file = SocketFile(str(path), None)
    with file.binding() as place:
        bound(Path(place)).close()
    assert path.is_socket()


def test_socket_that_appears_during_binding_is_kept(tmp_path: Path) -> None:
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


def test_removal_keeps_the_socket_of_another_process(tmp_path: Path) -> None:
    path = tmp_path / "s"
    file = SocketFile(str(path), None)
    with file.binding() as place:
        bound(Path(place)).close()
    path.rename(tmp_path / "old")  # keeps the inode, so that the next socket gets another
    with bound(path):
        file.remove()
        assert path.is_socket()
