"""Requests to a running supervisor, over a UNIX stream socket.

A client sends one request on each connection, and gets one answer. Request and answer are each one
line with a JSON object. The supervisor sends the answer at the time in the last column.

========================================  =================================================  =======================
request                                   answer                                             time of the answer
========================================  =================================================  =======================
``{"do": "stop"}``                        ``{"ok": true}``                                   all have stopped
``{"do": "restart", "name": "cell"}``     ``{"ok": true}``                                   the process runs again
``{"do": "reload"}``                      ``{"ok": true, "done": [lines], …}``               the change is done
``{"do": "reload", "dry_run": true}``     ``{"ok": true, "faults": [lines], …}``             the plan is ready
``{"do": "where"}``                       ``{"ok": true, "config": …, "read_ns": …, …}``     at once
``{"do": "disturb", "answers": "ok"}``    ``{"ok": true}``                                   at once
anything else                             ``{"error": "…"}``                                 at once
========================================  =================================================  =======================

The segment's header contains the socket's path. The supervisor serves only its own user and root.

An emulator with ``faults = true`` has its own socket in the same folder, which accepts only
``disturb``.
"""

from __future__ import annotations

import errno
import logging
import os
import select
import selectors
import socket
import stat
import struct
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple, get_args

import msgspec

from shmio.errors import ControlError, UnreachableError

MAX_PATH_BYTES: Final = 107  # sun_path holds 108 with the final zero, unix(7)
MAX_REQUEST_BYTES: Final = 4096
MAX_ANSWER_BYTES: Final = 65536
MAX_CLIENTS: Final = 8
REQUEST_S: Final = 2.0
"""Time in s within which a client must send its request."""
TURN_S: Final = 0.5
"""Interval in s at which a waiting client checks whether the supervisor is alive."""
CONNECT_S: Final = 0.05
"""Interval in s at which a client tries again to connect while the supervisor has too many clients."""
_EXHAUSTED: Final = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
_log = logging.getLogger("shmio")
_TOO_MANY: Final = "too many control connections at once"
_CREDENTIALS: Final = struct.Struct("iII")  # struct ucred: pid, uid, gid
LINE_CHARS: Final = 2000
_CHECK: Final = "… and {} more: shmio-supervisor check prints them"
_REPLY: Final = "… and {} more"
_MORE: Final = {
    "restart": _REPLY,
    "change": _REPLY,
    "injections": _REPLY,
    "faults": _CHECK,
    "warnings": "… and {} more warnings: shmio-supervisor check prints them",
    "done": "… and {} more: shmio-supervisor logs supervisor -n 500 shows them",
    "problems": "… and {} more: shmio-supervisor logs supervisor -n 500 shows them",
}
"""For each list in an answer, the line that replaces the lines that do not fit.

If an answer is too long, its lists are shortened in the order of these keys. The list ``kept`` has
no key here because it always fits: it has at most 200 names of at most 40 characters.
"""


def socket_path(instance: str) -> str:
    """Return the path of an instance's control socket; create its folder with mode 0700.

    The socket is in the first of these folders that can be used: ``$XDG_RUNTIME_DIR/shmio``,
    ``/run/user/<uid>/shmio`` and ``/tmp/shmio-<uid>``.

    Raises:
        ControlError: No folder can be used: it belongs to another user, or the path is too long.

    """
    return runtime_file(f"{instance}.sock", "the control socket")


def runtime_folders() -> list[Path]:
    """Return the folders that this user's processes may share while they run; the first that can be used is."""
    given = os.environ.get("XDG_RUNTIME_DIR")
    folders = [Path(given) / "shmio"] if given and Path(given).is_absolute() else []
    uid = os.getuid()
    return [*folders, Path(f"/run/user/{uid}/shmio"), Path(f"/tmp/shmio-{uid}")]  # noqa: S108  made with care below


def runtime_file(name: str, purpose: str) -> str:
    """Return the path of a file in the first of :func:`runtime_folders` that can be used, and create that folder.

    Args:
        name: Name of the file. The path also suits a socket.
        purpose: What the file is, for messages.

    Raises:
        ControlError: No folder can be used: it belongs to another user, or the path is too long.

    """
    refused = []
    for folder in runtime_folders():
        path = folder / name
        if len(os.fsencode(path)) > MAX_PATH_BYTES:
            refused.append(f"{folder}: the path is longer than {MAX_PATH_BYTES} bytes")
            continue
        reason = _prepare(folder, os.getuid())
        if reason is None:
            return str(path)
        refused.append(f"{folder}: {reason}")
    raise ControlError(f"no folder can be used for {purpose} ({'; '.join(refused)})")


def emulator_socket_path(control: str, name: str) -> str:
    """Return the path of an emulator's control socket, in the folder of the socket ``control``.

    ``control`` is the path of the supervisor's socket. The file name contains a ``+``, so that it
    differs from every instance's socket: no instance's name contains one.
    """
    path = Path(control)
    return str(path.with_name(f"{path.stem}+{name}{path.suffix}"))


def _prepare(folder: Path, uid: int) -> str | None:
    """Create a folder that only this user can enter, without following links.

    Return an error, or None.
    """
    try:
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            if os.fstat(fd).st_uid != uid:
                return "belongs to another user"
            os.fchmod(fd, 0o700)
        finally:
            os.close(fd)
    except OSError as error:
        return error.strerror
    return None


def remove_socket(path: str) -> None:
    """Remove a socket. Keep any other file at this path; binding to the path then fails."""
    with suppress(FileNotFoundError):
        if stat.S_ISSOCK(os.lstat(path).st_mode):
            Path(path).unlink()


Answers = Literal["ok", "delay", "corrupt", "hang", "refuse"]
"""How an emulator answers: correctly, late, with corrupt bytes, never, or by refusing connections."""
ANSWERS: Final[tuple[Answers, ...]] = get_args(Answers)


class _Request(msgspec.Struct, tag_field="do", forbid_unknown_fields=True):
    """Base class of requests."""


class Stop(_Request, tag="stop"):
    """Stop the instance."""


class Restart(_Request, tag="restart"):
    """Restart one process."""

    name: str


class Reload(_Request, tag="reload", omit_defaults=True):
    """Read the configuration again, and apply its changes; with ``dry_run``, only report the changes."""

    dry_run: bool = False


class Where(_Request, tag="where"):
    """Ask for the configuration file, the time at which it was read, the folders, and the addresses."""


Request = Stop | Restart | Reload | Where


class Disturb(_Request, tag="disturb", omit_defaults=True):
    """Change how an emulator answers its clients, until the next such request."""

    answers: Answers
    delay_ms: Annotated[float, msgspec.Meta(ge=0, le=600_000)] = 0.0
    """Delay of each answer in ms, with ``answers = "delay"``."""


class Peer(NamedTuple):
    """The process that has connected: its pid and its user."""

    pid: int
    uid: int


class Answer:
    """Sends the answer to one request; has no effect if the client has disconnected."""

    def __init__(self, server: ControlServer, client: socket.socket, peer: Peer) -> None:
        self._server = server
        self._client = client
        self.peer = peer
        """The process that sent the request."""
        self.ended: Callable[[str], object] = lambda _: None
        """Called with each answer: why the request failed, or "" if it succeeded."""

    def ok(self, **values: object) -> None:
        """Answer that the request succeeded, with ``values``; shorten lists of lines that do not fit."""
        self.ended("")
        self._server.answer(self._client, _shorten({"ok": True, **values}, MAX_ANSWER_BYTES - 1))

    def error(self, message: str) -> None:
        """Answer that the request failed."""
        self.ended(message)
        self._server.answer(self._client, {"error": _cut_lines(message, MAX_ANSWER_BYTES // 8)})


class ControlServer:
    """The supervisor's side of the control socket. No method waits for a client.

    The server registers its sockets with the supervisor's selector. When a socket is ready, the
    supervisor calls the function that is the data of the socket's selector key.
    """

    def __init__(
        self,
        path: str,
        selector: selectors.BaseSelector,
        handle: Callable[[Any, Answer], None],
        denied: Callable[[Peer], object] = lambda _: None,
        requests: Any = Request,
    ) -> None:
        """Bind the socket.

        The caller must have locked the instance. An existing socket is then that of a dead
        supervisor, and is removed.

        Args:
            path: The socket's path.
            selector: The supervisor's selector.
            handle: Called with each request.
            denied: Called for each connection of a user who may not control the instance.
            requests: The type of the requests.

        Raises:
            ControlError: The socket cannot be created.

        """
        self._path = path
        self._selector = selector
        self._handle = handle
        self._denied = denied
        self._requests = requests
        self._clients: dict[socket.socket, tuple[bytearray, float | None]] = {}
        self._resting = False
        """True from when a client could not be accepted until the next :meth:`expire`."""
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            remove_socket(path)
            self._listener.bind(path)
            self._inode = os.lstat(path).st_ino
            Path(path).chmod(0o600)
            self._listener.listen(MAX_CLIENTS)
        except OSError as error:
            self._listener.close()
            raise ControlError(f"cannot create the control socket {path}: {error.strerror}") from None
        selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def _accept(self) -> None:
        """Accept the clients that wait, at least one, and no more than there is room for."""
        for _ in range(MAX_CLIENTS):
            if not self._accept_one() or len(self._clients) >= MAX_CLIENTS:
                return

    def _accept_one(self) -> bool:
        """Accept a client; return False if none waits."""
        try:
            client, _ = self._listener.accept()
        except OSError as error:
            if error.errno in _EXHAUSTED:  # the client waits on, so the selector would report it without end
                _log.error("the control socket accepts nobody now: %s", error.strerror)
                self._selector.unregister(self._listener)
                self._resting = True
            return False
        client.setblocking(False)
        peer = _peer(client)
        if peer.uid not in (0, os.getuid()):
            self._denied(peer)
            _send(client, {"error": "only the supervisor's own user and root may control it"})
            client.close()
        elif not self._has_room():
            _send(client, {"error": _TOO_MANY})
            client.close()
        else:
            self._clients[client] = bytearray(), time.monotonic() + REQUEST_S
            self._selector.register(client, selectors.EVENT_READ, lambda: self._receive(client))
        return True

    def _has_room(self) -> bool:
        """Return whether another client can connect.

        If needed, first disconnect a silent client: of the program that has most of them, the one silent longest.
        """
        if len(self._clients) >= MAX_CLIENTS:
            silent = {client: _peer(client).pid for client, (_, due) in self._clients.items() if due is not None}
            if silent:
                most, _ = Counter(silent.values()).most_common(1)[0]
                longest = next(client for client, pid in silent.items() if pid == most)
                self.answer(longest, {"error": _TOO_MANY})
        return len(self._clients) < MAX_CLIENTS

    def _receive(self, client: socket.socket) -> None:
        if client not in self._clients:  # dropped in the same round of the selector
            return
        data, deadline = self._clients[client]
        try:
            received = client.recv(MAX_REQUEST_BYTES)
        except BlockingIOError:
            return
        except OSError:
            received = b""
        if not received or deadline is None:  # the client has gone, or sent more than one request
            self._drop(client)
            return
        data += received
        line, end, rest = data.partition(b"\n")
        if len(data) > MAX_REQUEST_BYTES or rest:
            self.answer(
                client, {"error": f"expected one request of at most {MAX_REQUEST_BYTES} bytes, ended by a newline"}
            )
        elif end:
            self._clients[client] = data, None
            self._decode(client, bytes(line))

    def _decode(self, client: socket.socket, line: bytes) -> None:
        try:
            request = msgspec.json.decode(line, type=self._requests)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            self.answer(client, {"error": f"the request is invalid: {error}"})
        else:
            if _hung_up(client):  # the client gave up while the supervisor was delayed
                self._drop(client)
                return
            self._handle(request, Answer(self, client, _peer(client)))

    def answer(self, client: socket.socket, message: dict[str, object]) -> None:
        """Send the answer and close the connection.

        Bytes that do not fit into the socket's buffer are lost.
        """
        if client in self._clients:
            _send(client, message)
            self._drop(client)

    def expire(self) -> None:
        """Disconnect clients that have sent no request within ``REQUEST_S``. Accept clients again after a failure."""
        if self._resting:
            self._resting = False
            self._selector.register(self._listener, selectors.EVENT_READ, self._accept)
        now = time.monotonic()
        for client, (_, deadline) in list(self._clients.items()):
            if deadline is not None and now > deadline:
                self.answer(client, {"error": f"no request arrived within {REQUEST_S:g} s"})

    def _drop(self, client: socket.socket) -> None:
        del self._clients[client]
        self._selector.unregister(client)
        client.close()

    def sweep(self) -> None:
        """Remove what processes that were killed have left beside the socket: their sockets, and the broker's folder.

        Leave all to a successor that has created its own socket.
        """
        own = Path(self._path)
        with suppress(OSError):
            if os.lstat(own).st_ino != self._inode:
                return
            broker = own.with_name(f"{own.stem}.mq")
            for path in (*own.parent.glob(f"{own.stem}+*{own.suffix}"), *broker.glob("*")):
                path.unlink(missing_ok=True)
            broker.rmdir()

    def retire(self) -> None:
        """Remove the socket, so that a new supervisor can create its own.

        Clients that are already connected still get their answers.
        """
        if self._listener.fileno() < 0:
            return
        if not self._resting:
            self._selector.unregister(self._listener)
        self._resting = False
        with suppress(OSError):
            if os.lstat(self._path).st_ino == self._inode:  # not the socket of a successor
                remove_socket(self._path)
        self._listener.close()  # closed last: until then no other file can get its inode number

    def close(self) -> None:
        """Remove the socket, and disconnect all clients."""
        self.retire()
        for client in list(self._clients):
            self._drop(client)


def request(
    path: str, message: _Request, timeout_s: float, lost: Callable[[], str | None] = lambda: None
) -> dict[str, Any]:
    """Send a request to the supervisor at ``path``, and return its answer.

    Args:
        path: The control socket.
        message: The request.
        timeout_s: Longest time to wait, in s.
        lost: Called every ``TURN_S``; returns the reason to stop waiting, or None.

    Raises:
        ControlError: There is no such socket, no answer came within ``timeout_s``, or the
            supervisor refuses.

    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        deadline = time.monotonic() + timeout_s
        received = bytearray()
        try:
            _connect(client, path, deadline, lost)
            client.sendall(msgspec.json.encode(message) + b"\n")
            while not received.endswith(b"\n"):
                data = _wait(client, deadline, lost)
                if not data or len(received) > MAX_ANSWER_BYTES:
                    raise ControlError("the supervisor ended without an answer")
                received += data
        except TimeoutError:
            raise ControlError(f"the supervisor has not answered within {timeout_s:g} s") from None
        except OSError as error:
            where = f" at {path}: {error.strerror}" if path else ": the instance names no control socket"
            raise UnreachableError(f"the supervisor cannot be reached{where}") from None
    try:
        answer = msgspec.json.decode(received, type=dict[str, Any])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        raise ControlError("invalid supervisor reply (version mismatch?)") from None
    if "error" in answer:
        raise ControlError(str(answer["error"]))
    return answer


def _connect(client: socket.socket, path: str, deadline: float, lost: Callable[[], str | None]) -> None:
    """Connect as soon as the supervisor accepts another client.

    Raises:
        TimeoutError: The supervisor did not accept the client by the deadline.
        ControlError: ``lost`` returned a reason.

    """
    while True:
        client.settimeout(max(0.001, deadline - time.monotonic()))
        try:
            client.connect(path)
        except BlockingIOError:  # the backlog is full, and a UNIX socket does not wait
            if reason := lost():
                raise ControlError(reason) from None
            if time.monotonic() >= deadline:
                raise TimeoutError from None
            time.sleep(CONNECT_S)
        else:
            return


def _wait(client: socket.socket, deadline: float, lost: Callable[[], str | None]) -> bytes:
    """Return the next bytes of the answer.

    Raises:
        TimeoutError: No bytes came by the deadline.
        ControlError: ``lost`` returned a reason.

    """
    while True:
        client.settimeout(max(0.001, min(TURN_S, deadline - time.monotonic())))
        try:
            return client.recv(MAX_ANSWER_BYTES)
        except TimeoutError:
            if reason := lost():
                raise ControlError(reason) from None
            if time.monotonic() >= deadline:
                raise


def _peer(client: socket.socket) -> Peer:
    pid, uid, _ = _CREDENTIALS.unpack(client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return Peer(pid, uid)


def _hung_up(client: socket.socket) -> bool:
    """Return whether the client has closed its end of the connection."""
    poll = select.poll()
    poll.register(client, select.POLLIN)
    return any(events & select.POLLHUP for _, events in poll.poll(0))


def _send(client: socket.socket, message: dict[str, object]) -> None:
    with suppress(OSError):
        client.send(msgspec.json.encode(message) + b"\n", socket.MSG_NOSIGNAL | socket.MSG_DONTWAIT)


def _cut(line: str) -> str:
    """Return a line, shortened to ``LINE_CHARS`` characters."""
    return line if len(line) <= LINE_CHARS else line[: LINE_CHARS - 1] + "…"


def _cut_lines(text: str, most_chars: int) -> str:
    """Return a text with long lines shortened.

    Lines beyond ``most_chars`` characters are replaced by a line with their number.
    """
    lines = text.split("\n")
    kept: list[str] = []
    for line in map(_cut, lines):
        most_chars -= len(line) + 1
        if most_chars < 0:
            return "\n".join([*kept, f"{len(lines) - len(kept)} more lines"])
        kept.append(line)
    return "\n".join(kept)


def _shorten(answer: dict[str, object], most_bytes: int) -> dict[str, object]:
    """Return the answer with its lists shortened so that its JSON has at most ``most_bytes`` bytes.

    In each list, a line with the number of the left-out lines replaces them.
    """
    short = dict(answer)
    shortened = {key: [_cut(line) for line in lines] for key in _MORE if isinstance(lines := answer.get(key), list)}
    short.update(shortened)
    for key, lines in shortened.items():
        excess = len(msgspec.json.encode(short)) - most_bytes
        if excess <= 0:
            break
        if lines:
            short[key] = _first_lines(lines, excess, _MORE[key])
    return short


def _first_lines(lines: list[str], excess: int, more: str) -> list[str]:
    """Return the first lines, and a line for the rest, at least ``excess`` bytes shorter in all."""
    excess += len(msgspec.json.encode(more)) + 8  # the number, and a comma
    count = len(lines)
    while count and excess > 0:
        count -= 1
        excess -= len(msgspec.json.encode(lines[count])) + 1
    return [*lines[:count], more.format(len(lines) - count)]
