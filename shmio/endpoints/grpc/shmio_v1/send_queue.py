"""A queue of messages for one client, none of which may be dropped."""

from __future__ import annotations

from collections import deque
from typing import Final

from shmio.endpoints.grpc.streams.back_pressure import Backlog, TotalBacklog

MAX_WAITING: Final = 4096


class SendQueue:
    """A queue with bounds on the number and the size of its messages."""

    def __init__(self) -> None:
        self._messages: deque[bytes] = deque()
        self._load = Backlog(TotalBacklog())

    def __bool__(self) -> bool:
        return bool(self._messages)

    def add(self, message: bytes) -> str:
        """Add a message; return why it does not fit, or an empty text."""
        if self._load.full(message, MAX_WAITING):
            return f"{self._load.count} messages wait to be read: the client is too slow for what is told"
        self._load.add(message)
        self._messages.append(message)
        return ""

    def pop(self) -> bytes:
        """Remove and return the oldest message."""
        message = self._messages.popleft()
        self._load.remove(message)
        return message

    def all(self) -> bytes:
        """Remove all messages and return them concatenated."""
        return b"".join([self.pop() for _ in range(len(self._messages))])
