"""TCP proxy with faults on demand between a program and its peer.

An emulator with ``faults = true`` puts the proxy in front of its server; tests and benchmarks put it
in front of any peer.

The proxy has one thread. It uses ``select``, whose time-outs have a resolution of microseconds, instead
of ``epoll``, which has only milliseconds. A method that changes the behaviour returns when the change
is in effect, so that tests need not wait.
"""

from __future__ import annotations

import contextlib
import queue
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Self

from shmio.config.address import Address
from shmio.emulators.ports import reserved_port
from shmio.errors import EndpointError
from shmio.wording import cannot_listen

Edit = Callable[[bytes], bytes | None]
Framing = Callable[[bytes | bytearray], int]

_REST_S = 0.1
"""Time in s for which no connection is accepted after one could not be accepted."""
_CHUNK = 1 << 16
_MAX_CLIENTS = 256  # connections at a time: select() takes no descriptors above 1023
_TIMEOUT_S = 10
_MAX_QUEUED = 4 << 20  # bytes queued in one direction; then the sender has to wait
_RESET = struct.pack("ii", 1, 0)  # SO_LINGER: close with RST


class Link:
    """A client's connection to the proxy, and the connection to the server that the proxy opens for this client."""

    def __init__(self, client: socket.socket, server: socket.socket) -> None:
        self._sockets = (client, server)
        for end in self._sockets:
            end.setblocking(False)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.up = Pipe(self, client, server)
        self.down = Pipe(self, server, client)
        self.pipes = (self.up, self.down)

    @property
    def open(self) -> bool:
        """True while bytes can pass in at least one direction."""
        if self._sockets[0].fileno() >= 0 and all(pipe.finished for pipe in self.pipes):
            self.close()
        return self._sockets[0].fileno() >= 0

    def close(self, *, reset: bool = False) -> None:
        """Close both connections; if ``reset`` is true, by a TCP reset, as when a peer crashes."""
        for end in self._sockets:
            if end.fileno() >= 0 and reset:
                end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET)
            end.close()


class Pipe:
    """One direction of a link."""

    def __init__(self, link: Link, source: socket.socket, sink: socket.socket) -> None:
        self.link = link
        self.source, self.sink = source, sink
        self.partial = bytearray()  # the start of a frame that will be edited once it is complete
        self.due = bytearray()
        self.ended = False
        self.finished = False
        self.last_sent = 0
        self._later: deque[tuple[float, bytes]] = deque()
        self._queued = 0

    @property
    def hungry(self) -> bool:
        """True if the proxy may read more bytes from the sender now."""
        return not self.ended and self._queued < _MAX_QUEUED

    @property
    def next_s(self) -> float:
        """Time in s (monotonic) at which the next bytes are due; infinity if there are none."""
        return self._later[0][0] if self._later else float("inf")

    def enqueue(self, data: bytes, delay_s: float) -> None:
        """Queue bytes that become due after a delay."""
        due_s = time.monotonic() + delay_s
        if self._later:
            due_s = max(due_s, self._later[-1][0])  # a shorter delay must not overtake
        self._later.append((due_s, data))
        self._queued += len(data)

    def collect_due(self, now_s: float) -> None:
        """Move the bytes whose delay has passed to ``due``."""
        while self._later and self._later[0][0] <= now_s:
            self.due += self._later.popleft()[1]

    def end_when_drained(self) -> None:
        """End the stream to the receiver, if the sender has ended its stream and all its bytes are sent."""
        if self.ended and not self.due and not self._later and not self.finished:
            self.finished = True
            with contextlib.suppress(OSError):
                self.sink.shutdown(socket.SHUT_WR)

    def send(self, limit: int | None) -> None:
        """Send bytes that are due, at most ``limit`` (None: without limit)."""
        self.last_sent = 0
        with contextlib.suppress(BlockingIOError):
            self.last_sent = self.sink.send(self.due if limit is None else self.due[:limit])
        del self.due[: self.last_sent]
        self._queued -= self.last_sent


def _listener(address: Address) -> socket.socket:
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    return socket.create_server((address.host, address.port), family=family)


def tpkt(data: bytes | bytearray) -> int:
    """Return the length of the ISO-on-TCP frame (RFC 1006) in ``data``; 0 if ``data`` is too short to tell."""
    return data[2] << 8 | data[3] if len(data) >= 4 else 0


def reference_edit(change: Callable[[int], int]) -> Edit:
    """Return an edit that changes the PDU reference of S7 answers.

    ``change`` returns the new reference, given the present one.
    """

    def edit(frame: bytes) -> bytes:
        reference = change(int.from_bytes(frame[11:13], "big")) & 0xFFFF
        return frame[:11] + reference.to_bytes(2, "big") + frame[13:]

    return edit


class Tampering:
    """The function that edits frames at present, and the frames that are on hold.

    Only the proxy's thread may use it, except ``frame_held``, which any thread may use.
    """

    def __init__(self, framing: Framing | None) -> None:
        """Start without an edit. ``framing`` measures frames; if it is None, the result of each ``recv`` is a frame."""
        self._framing = framing
        self._edit: Edit | None = None
        self._held: list[bytes] = []
        self.frame_held = threading.Event()
        """Set while a frame is on hold."""

    def begin(self, edit: Edit, frames: int | None) -> None:
        """Pass the next ``frames`` frames through ``edit``; if ``frames`` is None, all frames until :meth:`end`."""
        left = frames

        def counted(frame: bytes) -> bytes | None:
            nonlocal left
            if left is not None:
                left -= 1
                if not left:
                    self._edit = None
            return edit(frame)

        self._edit = counted

    def keep(self, frame: bytes) -> None:
        """Put a frame on hold. You can pass this method to :meth:`begin` as an edit."""
        self._held.append(frame)
        self.frame_held.set()

    def end(self) -> list[bytes]:
        """End the edit, and return the frames that were on hold."""
        self._edit = None
        self.frame_held.clear()
        held, self._held = self._held, []
        return held

    def passing(self, waiting: bytearray, data: bytes) -> Iterator[bytes]:
        """Append ``data`` to ``waiting``, and yield the bytes to pass on, edited if there is an edit.

        With an edit, an incomplete frame stays in ``waiting`` until its other bytes arrive.
        """
        waiting += data
        while waiting:
            size = len(waiting)
            if self._edit is not None and self._framing is not None:
                size = self._framing(waiting)
                if not 0 < size <= len(waiting):
                    return
            frame = bytes(waiting[:size])
            del waiting[:size]
            passed = frame if self._edit is None else self._edit(frame)
            if passed:
                yield passed


class FaultProxy:
    """TCP proxy between clients and one server. Use it as a context manager, or call ``stop``.

    A fault lasts until another method ends it. ``pass_all`` ends all faults except the delay.
    Faults of frames apply to the direction from the server to the client.
    """

    def __init__(
        self,
        target: Address,
        *,
        listen: Address | None = None,
        up_s: float = 0.0,
        down_s: float = 0.0,
        framing: Framing | None = tpkt,
    ) -> None:
        """Listen for connections to ``target``.

        Args:
            target: Address of the server.
            listen: Address to listen on; None for a free loopback port.
            up_s: Delay of each byte to the server, in s. The delay does not limit the throughput.
            down_s: Delay of each byte from the server, in s.
            framing: Function that returns the length of a frame. If None, the result of each
                ``recv`` is a frame.

        Raises:
            EndpointError: ``listen`` is not available.

        """
        self._target = target
        self._up_s, self._down_s = up_s, down_s
        self._tampering = Tampering(framing)
        self._frozen = False
        self._left_bytes: int | None = None
        self._links: list[Link] = []
        self._waiting: list[socket.socket] = []
        self.accepted = 0
        """Number of connections accepted so far."""
        self._cleanup = contextlib.ExitStack()
        try:
            self.address = self._cleanup.enter_context(reserved_port(*((listen.host, listen.port) if listen else ())))
            """Address to which clients connect."""
            self._listener: socket.socket | None = _listener(self.address)
        except OSError as error:
            self._cleanup.close()
            raise EndpointError(cannot_listen(listen, error)) from None
        self._running = True
        self._rests_until_s = 0.0
        self._todo: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._wake_out, self._wake_in = socket.socketpair()
        self._thread = threading.Thread(target=self._run, name="fault-proxy", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Close everything and end the thread."""
        if self._thread.is_alive():
            self._do(self._end)
            self._thread.join(_TIMEOUT_S)
        self._wake_in.close()  # not in the thread, because callers of _do use them after its end
        self._wake_out.close()

    # -- faults --------------------------------------------------------------------------------------------------------

    def delay(self, up_s: float, down_s: float) -> None:
        """Change the delay of bytes that arrive from now on.

        ``up_s`` is the delay of bytes to the server, ``down_s`` of bytes from the server, in s.
        """

        def change() -> None:
            self._up_s, self._down_s = up_s, down_s

        self._do(change)

    def pass_all(self) -> None:
        """End all faults except the delay, and discard frames on hold."""

        def change() -> None:
            self._tampering.end()
            self._left_bytes = None
            self._melt()
            self._listen()

        self._do(change)

    def cut(self, *, reset: bool = False) -> None:
        """Close all connections now.

        If ``reset`` is true, close them by a TCP reset, as when a peer crashes.
        """

        def change() -> None:
            for link in self._links:
                link.close(reset=reset)

        self._do(change)

    def cut_after(self, count: int) -> None:
        """Pass ``count`` more bytes to the clients, then cut all connections."""

        def change() -> None:
            self._left_bytes = count

        self._do(change)

    def freeze(self) -> None:
        """Pass no bytes, but keep connections and accept new ones, like a peer that hangs."""

        def change() -> None:
            self._frozen = True

        self._do(change)

    def thaw(self) -> None:
        """Pass bytes again after ``freeze``, beginning with those that have waited."""
        self._do(self._melt)

    def refuse(self) -> None:
        """Cut all connections and refuse new ones, like a peer whose program does not run."""

        def change() -> None:
            for link in self._links:
                link.close(reset=True)
            if self._listener is not None:
                self._listener.close()
                self._listener = None

        self._do(change)

    def admit(self) -> None:
        """Accept connections again after ``refuse``."""
        self._do(self._listen)

    def edit(self, change_frame: Edit, *, frames: int | None = None) -> None:
        """Pass frames through ``change_frame``, which returns the frame to send, or None to drop it.

        The edit ends after ``frames`` frames; if ``frames`` is None, it lasts until another method
        ends it.
        """
        self._do(lambda: self._tampering.begin(change_frame, frames))

    def garble(self, data: bytes) -> None:
        """Send ``data`` in place of the next frame."""
        self.edit(lambda _: data, frames=1)

    def rewrite_reference(self, change: Callable[[int], int], *, frames: int | None = None) -> None:
        """Change the PDU reference of S7 answers.

        ``change`` returns the new reference, given the present one. ``frames`` is as for
        :meth:`edit`.
        """
        self.edit(reference_edit(change), frames=frames)

    def hold(self, *, frames: int | None = None) -> None:
        """Put frames on hold until :meth:`release`, so that answers come late.

        ``frames`` is as for :meth:`edit`.
        """
        self.edit(self._tampering.keep, frames=frames)

    def wait_held(self, timeout_s: float = _TIMEOUT_S) -> bool:
        """Wait until a frame is on hold. Return False if no frame came in time."""
        return self._tampering.frame_held.wait(timeout_s)

    def release(self) -> None:
        """Send the frames on hold to the newest connection, even if they came on an older one."""

        def change() -> None:
            for frame in self._tampering.end():
                if self._links:
                    self._links[-1].down.enqueue(frame, 0.0)

        self._do(change)

    # -- the thread ----------------------------------------------------------------------------------------------------

    def _do(self, action: Callable[[], None]) -> None:
        """Run ``action`` in the proxy's thread, and wait until it is done."""
        done = threading.Event()

        def act() -> None:
            action()
            done.set()

        self._todo.put(act)
        self._wake_in.send(b"!")
        if not done.wait(_TIMEOUT_S):
            raise RuntimeError("the proxy's thread does not answer")

    def _end(self) -> None:
        self._running = False

    def _melt(self) -> None:
        self._frozen = False
        waiting, self._waiting = self._waiting, []
        for client in waiting:
            self._connect(client)

    def _listen(self) -> None:
        if self._listener is None:
            self._listener = _listener(self.address)

    def _run(self) -> None:
        with self._cleanup:
            self._cleanup.callback(self._close_all)
            while self._running:
                self._links = [link for link in self._links if link.open]
                self._run_once()

    def _close_all(self) -> None:
        for link in self._links:
            link.close()
        for plain in (self._listener, *self._waiting):
            if plain is not None:
                plain.close()

    def _run_once(self) -> None:
        """Wait for the next event, and handle it."""
        pipes = [] if self._frozen else [pipe for link in self._links for pipe in link.pipes]
        readers = {pipe.source: pipe for pipe in pipes if pipe.hungry}
        writers = {pipe.sink: pipe for pipe in pipes if pipe.due}
        accepts = self._listener is not None and time.monotonic() >= self._rests_until_s
        always = [self._wake_out, self._listener] if accepts and self._listener else [self._wake_out]
        rests_s = float("inf") if accepts or self._listener is None else self._rests_until_s
        next_s = min((pipe.next_s for pipe in pipes), default=float("inf"))
        next_s = min(next_s, rests_s)
        timeout_s = None if next_s == float("inf") else max(0.0, next_s - time.monotonic())
        readable, writable, _ = select.select([*always, *readers], list(writers), [], timeout_s)
        for ready in readable:
            if ready is self._wake_out:
                self._wake_out.recv(_CHUNK)
            elif ready is self._listener:
                self._accept(ready)
            else:
                self._read(readers[ready])
        for pipe in pipes:
            pipe.collect_due(time.monotonic())
            if pipe.due and (pipe.sink in writable or pipe.sink not in writers):
                self._write(pipe)
            pipe.end_when_drained()
        with contextlib.suppress(queue.Empty):
            while True:
                self._todo.get_nowait()()

    def _accept(self, listener: socket.socket) -> None:
        try:
            client, _ = listener.accept()
        except OSError:  # the client has left, or no descriptor is free
            self._rests_until_s = time.monotonic() + _REST_S
            return
        if len(self._links) + len(self._waiting) >= _MAX_CLIENTS:
            client.close()
            return
        self.accepted += 1
        if self._frozen:
            self._waiting.append(client)
        else:
            self._connect(client)

    def _connect(self, client: socket.socket) -> None:
        try:
            server = socket.create_connection((self._target.host, self._target.port), timeout=_TIMEOUT_S)
        except OSError:
            client.close()
            return
        self._links.append(Link(client, server))

    def _read(self, pipe: Pipe) -> None:
        try:
            data = pipe.source.recv(_CHUNK)
        except BlockingIOError:
            return
        except OSError:
            pipe.link.close(reset=True)
            return
        if not data:
            pipe.ended = True
        elif pipe is pipe.link.up:
            pipe.enqueue(data, self._up_s)
        else:
            for frame in self._tampering.passing(pipe.partial, data):
                pipe.enqueue(frame, self._down_s)

    def _write(self, pipe: Pipe) -> None:
        limited = self._left_bytes is not None and pipe is pipe.link.down
        try:
            pipe.send(self._left_bytes if limited else None)
        except OSError:
            pipe.link.close(reset=True)
            return
        if limited and self._left_bytes is not None:
            self._left_bytes -= pipe.last_sent
            if self._left_bytes <= 0:
                self._left_bytes = None
                for link in self._links:
                    link.close()
