"""A rosbridge server for tests, made with Node's ws, which shares no code with ours."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest

from shmio.testing.ports import reserved_port

NODE = Path(__file__).parents[2] / "endpoints/node"
MISSING = "" if shutil.which("node") and (NODE / "node_modules/ws").exists() else "needs Node's package ws"


class Bridge:
    """A running server, in a process of its own."""

    def __init__(self) -> None:
        if MISSING:
            pytest.skip(MISSING)
        self._stack = ExitStack()
        self.address = self._stack.enter_context(reserved_port())
        self.url = f"ws://{self.address}"

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            self._process.send_signal(signal.SIGCONT)
            self._process.communicate(timeout=60)

    def start(self) -> None:
        """Start the process, for the first time or again."""
        command = ["node", str(NODE / "rosbridge_server.js"), str(self.address.port)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self._line() == "ready"

    def kill(self) -> None:
        self._process.kill()
        self._process.communicate(timeout=60)

    def freeze(self) -> None:
        """Stop the process (SIGSTOP). Its connections stay open."""
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Let the process continue after ``freeze``."""
        self._process.send_signal(signal.SIGCONT)

    def _line(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def ask(self, *words: object) -> Any:
        """Send a command to the server; return its result."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(words) + "\n")
        self._process.stdin.flush()
        return self._line()


def framing(data: bytes | bytearray) -> int:
    """Return the length of the frame or handshake answer at the start of ``data``; 0 if it is not known yet."""
    if data.startswith(b"HTTP"):
        return data.find(b"\r\n\r\n") + 4 if b"\r\n\r\n" in data else 0
    if len(data) < 2:
        return 0
    size = data[1] & 0x7F
    if size < 126:
        return 2 + size
    extra = 2 if size == 126 else 8
    return 2 + extra + int.from_bytes(data[2 : 2 + extra], "big") if len(data) >= 2 + extra else 0
