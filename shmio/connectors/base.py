"""The base class of connectors: the hooks that a device's protocol implements.

``loop`` calls them.
"""

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
    """The state of a write that had no answer when the connection was lost."""

    UNSENT = "unsent"
    """Not carried out: none of its bytes was sent to the device."""
    UNKNOWN = "unknown"


class WriteLostError(ConnectorError):
    """The connection was lost before all writes had their answers."""

    def __init__(self, message: str, outcomes: Sequence[str | Lost]) -> None:
        """Create the error.

        Args:
            message: Why the connection was lost.
            outcomes: For each write, its result as from :meth:`Connector.write`, or what is known
                of it.

        """
        super().__init__(message)
        self.outcomes = tuple(outcomes)


class Connector(ABC):
    """Base class for the protocol of one device.

    All hooks run in one thread, and none may block longer than ``timeout_s``. After a hook has
    raised, the loop calls :meth:`close` and later :meth:`connect` again, so that a late reply is
    never taken for the next one. A connector that asks and waits implements :meth:`read`. One that
    can have several cycles in flight implements :meth:`submit`, :meth:`collect` and ``depth``. The
    text of a ConnectorError is for the operator of the cell.
    """

    Options: ClassVar[type[msgspec.Struct]]
    """The connector's own keys of ``[[source]]``. The struct must refuse unknown keys."""

    can_write: ClassVar[bool] = False
    """Whether :meth:`write` is implemented."""

    provenance: ClassVar[Provenance] = Provenance.LIVE
    """The provenance of the values that it reads."""

    @abstractmethod
    def __init__(self, options: Any, layout: Layout) -> None:
        """Create the connector without connecting it.

        Args:
            options: An instance of ``Options``.
            layout: The layout of the source's block.

        Raises:
            ConfigError: Layout and options contradict each other.

        """

    @property
    @abstractmethod
    def timeout_s(self) -> float:
        """The longest time that any hook blocks, in s."""

    @abstractmethod
    def connect(self) -> None:
        """Open the connection to the device.

        Raises:
            ConnectorError: The device cannot be reached.

        """

    @abstractmethod
    def read(self) -> bytes:
        """Read one image of the whole block.

        Returns:
            ``layout.size`` bytes.

        Raises:
            ConnectorError: There is no whole, fresh image.

        """

    @abstractmethod
    def close(self) -> None:
        """Close the connection. It may be called at any time and more than once."""

    def describe(self) -> str:
        """Return what was negotiated with the device, for the log."""
        return ""

    @property
    def doubt(self) -> str:
        """Why the last image is uncertain although it was read, with the remedy.

        Empty if it is good.
        """
        return ""

    # -- more than one cycle at a time ---------------------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """How many cycles may be in flight at once in this session."""
        return 1

    def submit(self) -> None:  # noqa: B027  not every connector can
        """Request an image without waiting for it.

        Raises:
            ConnectorError: The request cannot be sent.

        """

    def collect(self, until_ns: int) -> bytes | None:  # noqa: ARG002  read() has its own time-out
        """Wait for the image of the oldest submitted cycle.

        Args:
            until_ns: When to stop waiting, ns of CLOCK_MONOTONIC.

        Returns:
            The image, ``layout.size`` bytes; None if it has not come by ``until_ns``.

        Raises:
            ConnectorError: The answer is wrong, or has not come within the connector's own
                time-out.

        """
        return self.read()

    # -- writing -------------------------------------------------------------------------------------------------------

    def write(self, writes: Sequence[Write]) -> list[str]:  # noqa: ARG002
        """Write bytes and bits to the device.

        A write of a bit leaves the other bits of its byte alone. A write of bytes may be longer
        than the protocol takes at once.

        Args:
            writes: What to write, in this order.

        Returns:
            For each write "" if the device confirmed it, else why the device refused it.

        Raises:
            WriteLostError: The connection was lost; the error says what is known of each write.
            ConnectorError: Nothing is known of any write.

        """
        raise ConnectorError("this connector cannot write")
