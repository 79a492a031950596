"""ROS 2 nodes for tests, each in a separate process that runs ``dds_node.py``."""

from __future__ import annotations

import importlib.util
import itertools
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import pytest

PROGRAM = Path(__file__).with_name("dds_node.py")
DOMAIN = 100 + os.getpid() % 100
_numbers = itertools.count(1)


class Peer:
    """A running node. Its topics begin with ``prefix``, so that tests do not disturb each other."""

    def __init__(self) -> None:
        if importlib.util.find_spec("cyclonedds") is None:
            pytest.skip("needs cyclonedds")
        self.prefix = f"p{os.getpid()}_{next(_numbers)}"
        self.domain = DOMAIN

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.send_signal(signal.SIGCONT)
        self._process.communicate(timeout=60)

    def start(self) -> None:
        """Start the process, for the first time or again."""
        command = [sys.executable, str(PROGRAM), str(self.domain), self.prefix]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._line() == "ready"

    def kill(self) -> None:
        self._process.kill()
        self._process.communicate(timeout=60)

    def freeze(self) -> None:
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def _line(self) -> Any:
        assert self._process.stdout is not None
        return json.loads(self._process.stdout.readline())

    def ask(self, *words: object) -> Any:
        """Send a command, a method of ``dds_node.Node``; return its result."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(words) + "\n")
        self._process.stdin.flush()
        return self._line()

    def address(self, topic: str, rest: str) -> str:
        """Return the address of a field in one of the node's topics."""
        return f"/{self.prefix}/{topic} {rest}"
