"""The base classes of sources: Connector reaches a device, Computed is computed, Replayed is a recording.

Each kind has its loop, which calls the hooks: ``loop``, ``models.stepped`` and ``replay.loop``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any, ClassVar

import msgspec

from shmio.connectors.browsing import Browsed, Wanted
from shmio.connectors.load import Load
from shmio.errors import ConfigError, ConnectorError
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write
from shmio.segment import BlockWriter, Provenance


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

    register_quality: ClassVar[bool] = False
    """Whether the device gives each register a status and a time of its own.

    Then the layout has a status area, and :class:`shmio.connectors.register_image.RegisterImage`
    makes the images.
    """

    reads_optimized: ClassVar[bool] = False
    """Whether it can read a data block with optimized access, whose values have names but no addresses."""

    path_options: ClassVar[tuple[str, ...]] = ()
    """Those of its keys that are paths of files or folders, which are relative to the configuration."""

    @classmethod
    def for_layout(cls, layout: Layout) -> type[Connector]:  # noqa: ARG003  most read all layouts
        """Return the class that reads a layout, with the same ``Options``.

        A connector that needs ``register_quality`` only for some layouts returns another class for
        these.
        """
        return cls

    @classmethod
    def browse(cls, options: Any, wanted: Wanted) -> Browsed:  # noqa: ARG003
        """List what a device offers, without a layout. It may take long.

        Args:
            options: An instance of ``Options``.
            wanted: Which part to list, and the limits of the search.

        Raises:
            ConfigError: An option is wrong, or this connector cannot browse.
            ConnectorError: The device cannot be reached, or refuses it.

        """
        raise ConfigError("this connector cannot list what a device offers")

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

    def load(self) -> Load | None:
        """Return what a cycle asks of the device, for ``shmio-supervisor check``; None if that is not known.

        It is called without a connection, and makes none.
        """
        return None

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


class Computed(ABC):
    """Base class for a source whose registers are computed, and which follows the instance clock.

    All hooks run in one thread. A hook that fails raises a ShmioError with a text for the operator
    of the cell. The next cycle tries again.
    """

    Options: ClassVar[type[msgspec.Struct]]
    """Its own keys of ``[[source]]``. The struct must refuse unknown keys."""

    prompt: ClassVar[bool] = False
    """Whether written values are published at once, without waiting for a cycle."""

    timeout_s: float = 1.0
    """The longest time that a step may take, in s."""

    @abstractmethod
    def __init__(self, options: Any, layout: Layout) -> None:
        """Create the source.

        Args:
            options: An instance of ``Options``.
            layout: The layout of the source's block.

        Raises:
            ConfigError: Layout and options contradict each other.

        """

    @property
    def connections(self) -> Mapping[str, str]:
        """The topic that each connected input reads, by the input's path."""
        return {}

    @property
    def inputs(self) -> tuple[str, ...]:
        """The paths of the registers that may be connected."""
        return ()

    def connect(self, values: Mapping[str, Value], doubt: str) -> None:  # noqa: B027  not every source has inputs
        """Take the values of connected inputs for the next :meth:`step`.

        Args:
            values: Values by path. An input without a value keeps the one it has.
            doubt: Why values are missing; empty if none are.

        """

    def attach(self, writer: BlockWriter) -> None:  # noqa: B027  most need nothing of it
        """Take the writing side of the block; called once, before the hooks below.

        Raises:
            SegmentError: The block does not fit the source.

        """

    @abstractmethod
    def resume(self, image: bytes) -> None:
        """Continue from the last image of the previous process; called before :meth:`begin`."""

    @abstractmethod
    def begin(self) -> bytes:
        """Return the image before the first step; of a prompt source, the present image."""

    def news(self) -> bool:
        """Return whether :meth:`begin` has a new result; called between two steps."""
        return False

    def interrupt(self) -> None:  # noqa: B027  most never wait
        """End a step that waits. Any thread may call it."""

    @abstractmethod
    def write(self, writes: Sequence[Write]) -> list[str]:
        """Take bytes and bits; return for each "" or why it is refused."""

    @abstractmethod
    def step(self, time_ns: int, dt_ns: int) -> bytes:
        """Compute the image at an instance time.

        Args:
            time_ns: The instance time at the end of the step, in ns.
            dt_ns: The length of the step, in ns.

        Returns:
            The image, ``layout.size`` bytes.

        """


class Replayed(ABC):
    """Base class for a source with the layout and frames of a recording; it follows the instance clock."""

    Options: ClassVar[type[msgspec.Struct]]
    """Its own keys of ``[[source]]``. The struct must refuse unknown keys."""

    @abstractmethod
    def __init__(self, options: Any, name: Any) -> None:
        """Open the recording.

        Args:
            options: An instance of ``Options``.
            name: The name of the source.

        Raises:
            ConfigError: The recording cannot be played. The message begins with the key.

        """
