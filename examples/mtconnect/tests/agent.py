"""Starts the agent of the tests, a process in another language, and sends it commands."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Self

from shmio.config import Address


class Agent:
    """An agent on a free port of this host."""

    def __init__(self) -> None:
        command = ["node", str(Path(__file__).with_name("agent.js"))]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.address = Address("127.0.0.1", int(self._line()))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.communicate(timeout=20)

    def tell(self, **command: object) -> None:
        """Send a command. Return when the agent has carried it out."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(command) + "\n")
        self._process.stdin.flush()
        assert self._line() == "ok"

    def set(self, **values: str) -> None:
        """Set the values of data items."""
        self.tell(set=values)

    def condition(self, item: str, element: str, code: str = "", text: str = "") -> None:
        """Add an observation of a condition."""
        self.tell(condition=[item, element, code, text])

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()
