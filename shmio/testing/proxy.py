"""A TCP relay that misbehaves on demand: the network between a program and its peer, for tests and benchmarks.

One thread and ``select`` (whose time-outs, unlike those of ``epoll``, resolve microseconds). Every method that changes
the behaviour returns when the change has taken place, so tests need not wait.
"""

from __future__ import annotations

import contextlib
import queue
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import Self

from shmio.config.address import Address
from shmio.testing.ports import reserved_port
from shmio.testing.relay import Link, Pipe
from shmio.testing.tampering import Edit, Framing, Tampering, reference_edit, tpkt

_CHUNK = 1 << 16
_TIMEOUT_S = 10


class FaultProxy:
    """Relays between clients and one server. Use ``with``, or ``stop`` at the end.

    Faults last until changed; ``pass_all`` takes back all but the delay. Those on frames are of the direction from
    server to client.
    """

    def __init__(
        self, target: Address, *, up_s: float = 0.0, down_s: float = 0.0, framing: Framing | None = tpkt
    ) -> None:
        """Listen on a free port of the loopback, for connections to ``target``.

        ``up_s``, ``down_s``: delay of each byte toward the server and back; throughput is not limited.
        ``framing``: tells where a frame ends; None: what one ``recv`` returns is a frame.
        """
        self._target = target
        self._up_s, self._down_s = up_s, down_s
        self._tampering = Tampering(framing)
        self._frozen = False
        self._left_bytes: int | None = None
        self._links: list[Link] = []
        self._waiting: list[socket.socket] = []
        self.accepted = 0
        """Connections taken so far."""
        self._cleanup = contextlib.ExitStack()
        self.address = self._cleanup.enter_context(reserved_port())
        """Where clients connect to."""
        self._listener: socket.socket | None = socket.create_server((self.address.host, self.address.port))
        self._running = True
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
        self._wake_in.close()  # here, since whoever calls _do still holds them when the thread is through
        self._wake_out.close()

    # -- faults --------------------------------------------------------------------------------------------------------

    def delay(self, up_s: float, down_s: float) -> None:
        """Change the delay of what comes from now on."""

        def change() -> None:
            self._up_s, self._down_s = up_s, down_s

        self._do(change)

    def pass_all(self) -> None:
        """End all faults but the delay, which has its own method. Frames on hold are discarded."""

        def change() -> None:
            self._tampering.end()
            self._left_bytes = None
            self._melt()
            self._listen()

        self._do(change)

    def cut(self, *, reset: bool = False) -> None:
        """Close all connections now: in good order, or with ``reset`` as a crashed peer does."""

        def change() -> None:
            for link in self._links:
                link.close(reset=reset)

        self._do(change)

    def cut_after(self, count: int) -> None:
        """Let ``count`` more bytes through to the clients, then cut."""

        def change() -> None:
            self._left_bytes = count

        self._do(change)

    def freeze(self) -> None:
        """Relay nothing, but keep connections and take new ones: a peer that hangs, or an unplugged cable."""

        def change() -> None:
            self._frozen = True

        self._do(change)

    def thaw(self) -> None:
        """Go on where ``freeze`` stopped."""
        self._do(self._melt)

    def refuse(self) -> None:
        """Cut all connections and refuse new ones, keeping the port: a peer whose program is not running."""

        def change() -> None:
            for link in self._links:
                link.close(reset=True)
            if self._listener is not None:
                self._listener.close()
                self._listener = None

        self._do(change)

    def admit(self) -> None:
        """Take connections again after ``refuse``."""
        self._do(self._listen)

    def edit(self, change_frame: Edit, *, frames: int | None = None) -> None:
        """Pass frames through a function; None drops one. ``frames``: end after so many."""
        self._do(lambda: self._tampering.begin(change_frame, frames))

    def garble(self, data: bytes) -> None:
        """Send ``data`` in place of the next frame."""
        self.edit(lambda _: data, frames=1)

    def rewrite_reference(self, change: Callable[[int], int], *, frames: int | None = None) -> None:
        """Change the PDU reference of S7 answers."""
        self.edit(reference_edit(change), frames=frames)

    def hold(self, *, frames: int | None = None) -> None:
        """Keep frames back, to be let go by ``release``: answers that come late."""
        self.edit(self._tampering.keep, frames=frames)

    def wait_held(self, timeout_s: float = _TIMEOUT_S) -> bool:
        """Wait until a frame is on hold; False if none came in time."""
        return self._tampering.frame_held.wait(timeout_s)

    def release(self) -> None:
        """Stop holding, and send what was held to the newest connection, whichever it was meant for."""

        def change() -> None:
            for frame in self._tampering.end():
                if self._links:
                    self._links[-1].down.enqueue(frame, 0.0)

        self._do(change)

    # -- the thread ----------------------------------------------------------------------------------------------------

    def _do(self, action: Callable[[], None]) -> None:
        """Have the thread run ``action``, and wait for it."""
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
            self._listener = socket.create_server((self.address.host, self.address.port))

    def _run(self) -> None:
        with self._cleanup:
            self._cleanup.callback(self._close_all)
            while self._running:
                self._links = [link for link in self._links if link.open]
                self._turn()

    def _close_all(self) -> None:
        for link in self._links:
            link.close()
        for plain in (self._listener, *self._waiting):
            if plain is not None:
                plain.close()

    def _turn(self) -> None:
        """Wait for the next thing to do, and do it."""
        pipes = [] if self._frozen else [pipe for link in self._links for pipe in link.pipes]
        readers = {pipe.source: pipe for pipe in pipes if pipe.hungry}
        writers = {pipe.sink: pipe for pipe in pipes if pipe.due}
        always = [self._wake_out] if self._listener is None else [self._wake_out, self._listener]
        next_s = min((pipe.next_s for pipe in pipes), default=None)
        timeout_s = None if next_s is None or next_s == float("inf") else max(0.0, next_s - time.monotonic())
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
        client, _ = listener.accept()
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
