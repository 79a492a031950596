"""OPC UA servers for tests, in processes of their own: ``server.py``, made with asyncua."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from shmio.testing.ports import reserved_port

PROGRAM = Path(__file__).with_name("server.py")


class Device:
    """A running server."""

    def __init__(self, *certificate: Path) -> None:
        self._certificate = certificate
        self._stack = ExitStack()
        self.address = self._stack.enter_context(reserved_port())
        self.url = f"opc.tcp://{self.address}"

    def __enter__(self) -> Self:
        self._start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            self._process.send_signal(signal.SIGCONT)
            self._process.communicate(timeout=60)

    def _start(self) -> None:
        command = [sys.executable, str(PROGRAM), str(self.address.port), *map(str, self._certificate)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
        assert self._line() == "ready"

    def kill(self) -> None:
        """End the process at once."""
        self._process.kill()
        self._process.communicate(timeout=60)

    def restart(self) -> None:
        """Start the process again."""
        self._start()

    def freeze(self) -> None:
        """Stop the process, whose connections stay open."""
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Let the process continue."""
        self._process.send_signal(signal.SIGCONT)

    def _line(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def ask(self, *words: object) -> Any:
        """Send a command, a method of ``server.Device``; return its result."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(words) + "\n")
        self._process.stdin.flush()
        answer = self._line()
        assert not str(answer).startswith("failed"), answer
        return answer


def framing(data: bytes | bytearray) -> int:
    """Return the length of the chunk at the start of ``data``; 0 if it is not known yet."""
    return int.from_bytes(data[4:8], "little") if len(data) >= 8 else 0
