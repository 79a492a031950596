"""What a connector is: the hooks that a device's protocol fills in. The loop that calls them is in ``loop``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from enum import Enum
from typing import Any, ClassVar

import msgspec

from shmio.errors import ConnectorError
from shmio.layout.model import Layout
from shmio.layout.values.write import Write
from shmio.segment import Provenance


class Lost(Enum):
    """What is known of a write that had no answer when the connection was lost."""

    UNSENT = "unsent"
    """Surely not carried out: the device was not given a byte of it."""
    UNKNOWN = "unknown"


class WriteLostError(ConnectorError):
    """The connection was lost before all writes had their answers."""

    def __init__(self, message: str, outcomes: Sequence[str | Lost]) -> None:
        """``outcomes``: of each write, as :meth:`Connector.write` returns it, or what is known of it."""
        super().__init__(message)
        self.outcomes = tuple(outcomes)


class Connector(ABC):
    """One device's protocol. All hooks run in one thread; none may block longer than ``timeout_s``.

    After a hook has raised, the loop calls :meth:`close` and later :meth:`connect` again: a late reply must never be
    taken for the next one. A connector that asks and waits implements :meth:`read`; one that can have several cycles
    under way, :meth:`submit`, :meth:`collect` and ``depth``. ConnectorError says why not, in words for the person at
    the cell.
    """

    Options: ClassVar[type[msgspec.Struct]]
    """The connector's own keys of ``[[source]]``; refuses unknown ones."""

    can_write: ClassVar[bool] = False
    """Whether :meth:`write` is implemented."""

    provenance: ClassVar[Provenance] = Provenance.LIVE
    """Where its values come from."""

    @abstractmethod
    def __init__(self, options: Any, layout: Layout) -> None:
        """``options`` is an instance of ``Options``. ConfigError when layout and options do not go together."""

    @property
    @abstractmethod
    def timeout_s(self) -> float:
        """The longest time that any hook blocks."""

    @abstractmethod
    def connect(self) -> None:
        """Reach the device; ConnectorError."""

    @abstractmethod
    def read(self) -> bytes:
        """One image of the whole block, ``layout.size`` bytes; ConnectorError, never a part or an old one."""

    @abstractmethod
    def close(self) -> None:
        """Drop the connection; allowed at any time, more than once."""

    def describe(self) -> str:
        """What was agreed with the device, for the log."""
        return ""

    @property
    def doubt(self) -> str:
        """Why the image just read should not be trusted though it is right, with the remedy; empty if it should."""
        return ""

    # -- more than one cycle at a time ---------------------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """Cycles that may be under way at once in this session."""
        return 1

    def submit(self) -> None:  # noqa: B027  not every connector can
        """Ask for an image without waiting for it; ConnectorError."""

    def collect(self, until_ns: int) -> bytes | None:  # noqa: ARG002  who reads and waits has a time-out
        """The image of the oldest cycle submitted; None if it has not come by ``until_ns`` (CLOCK_MONOTONIC).

        ConnectorError: it is wrong, or has not come within the connector's own time-out.
        """
        return self.read()

    # -- writing -------------------------------------------------------------------------------------------------------

    def write(self, writes: Sequence[Write]) -> list[str]:  # noqa: ARG002
        """Change these bytes and bits in the device; for each "" if it confirmed, else its refusal in words.

        A write of a bit leaves its neighbours alone; one of bytes may be longer than the protocol takes at once.
        WriteLostError: the connection is lost, and what became of each; ConnectorError: nothing is known of any.
        """
        raise ConnectorError("this connector cannot write")
