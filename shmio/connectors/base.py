"""The base classes of sources: Connector, Computed, Replayed and Mirrored.

A Connector reads a device, a Computed source calculates its values, a Replayed source plays a
recording, and a Mirrored source reproduces a source of another instance. Each kind has a loop that
calls its methods: ``poll_loop``, ``models.stepped``, ``replay.loop`` and ``fabric.loop``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import Any, ClassVar, Final

import msgspec

from shmio.connectors.browsing import Browsed, Wanted
from shmio.connectors.request_count import CycleRequests
from shmio.errors import ConfigError, ConnectorError, SnapshotError
from shmio.layout.model import Layout
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write
from shmio.segment import BlockWriter, Provenance

TAKEN: Final = "an injection took the value in place of the device"
"""Outcome of a write that another instance of shmio has not sent to the device, because of an injection there."""


class Lost(Enum):
    """State of a write that the device had not answered when the connection was lost."""

    UNSENT = "unsent"
    """The device did not carry out the write, because none of its bytes was sent."""
    UNKNOWN = "unknown"


class WriteLostError(ConnectorError):
    """The connection was lost before the device had answered all writes."""

    def __init__(self, message: str, outcomes: Sequence[str | Lost]) -> None:
        """Create the error.

        Args:
            message: Why the connection was lost.
            outcomes: For each write that the device has answered, the result as
                :meth:`Connector.write` returns it; for each other write, a :class:`Lost`.

        """
        super().__init__(message)
        self.outcomes = tuple(outcomes)


class UnconfirmedError(WriteLostError):
    """The device did not confirm all writes in time, but the connection still works and stays open."""


class Connector(ABC):
    """Base class of connectors. A connector implements the protocol of one device.

    The loop calls all methods in one thread, and none may block longer than ``timeout_s``. If a
    method raises an exception, the loop calls :meth:`close`, and later :meth:`connect` again. So a
    late reply is never taken for the reply to a later request. A connector that sends a request and
    waits for its reply implements :meth:`read`. A connector that can have several requests in
    flight implements :meth:`submit`, :meth:`collect` and ``depth``. A connector that can write
    implements :meth:`write`, or :meth:`send` and :meth:`confirm`. The operator of the cell reads
    the text of a ConnectorError.
    """

    Options: ClassVar[type[msgspec.Struct]]
    """The connector's own keys of ``[[source]]``. The struct must refuse unknown keys."""

    can_write: ClassVar[bool] = False
    """True if the connector can write."""

    provenance: ClassVar[Provenance] = Provenance.LIVE
    """The origin of the values, which each frame of the source states."""

    register_quality: ClassVar[bool] = False
    """True if the device gives each register its own status and time.

    Then the layout has a status area, and the connector creates its images with
    :class:`shmio.connectors.register_image.RegisterImage`.
    """

    reads_optimized: ClassVar[bool] = False
    """True if the connector can read S7 data blocks with optimized access.

    The values of these blocks have names but no addresses.
    """

    path_options: ClassVar[tuple[str, ...]] = ()
    """The keys of ``Options`` whose values are paths of files or folders.

    A relative path starts at the folder of the configuration.
    """

    register_options: ClassVar[frozenset[str] | None] = None
    """The keys of ``Options`` that determine what is read or written, but not how to connect.

    If a reload changes only these keys and the layout, a new connector takes over the connection of
    the old one by :meth:`take_over`. None: the connector cannot take over a connection, so a reload
    restarts its process.
    """

    cannot_browse: ClassVar[str] = "this connector cannot list what a device offers"
    """Why this connector cannot browse, and what the user can do instead."""

    @classmethod
    def for_layout(cls, layout: Layout) -> type[Connector]:  # noqa: ARG003  most read all layouts
        """Return the connector class to use for a layout; the class has the same ``Options``.

        By default, this is the class itself. A connector that needs ``register_quality`` only for
        some layouts returns another class for these.
        """
        return cls

    @classmethod
    def browse_options(cls, url: str) -> dict[str, Any]:
        """Convert the URL given to ``shmio-supervisor browse`` to keys of ``Options``.

        Raises:
            ConfigError: The URL is not one of this connector, or the connector cannot browse.

        """
        if "url" not in cls.Options.__struct_fields__:
            raise ConfigError(cls.cannot_browse)
        return {"url": url}

    @classmethod
    def browse(cls, options: Any, wanted: Wanted) -> Browsed:  # noqa: ARG003
        """List the values that a device offers, without a layout. This may take minutes.

        Args:
            options: An instance of ``Options``.
            wanted: The part of the device to list, and the limits of the search.

        Raises:
            ConfigError: An option is wrong, or this connector cannot browse.
            ConnectorError: The device cannot be reached, or it refuses to be browsed.

        """
        raise ConfigError(cls.cannot_browse)

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
        """The longest time that any method may block, in s."""

    @abstractmethod
    def connect(self) -> None:
        """Open the connection to the device.

        Raises:
            ConnectorError: The device cannot be reached.

        """

    def take_over(self, other: Any) -> bool:  # noqa: ARG002  not every connector can
        """Take over the open connection of another connector, instead of :meth:`connect`.

        An answer to a request of the other connector must never become a value of this one.

        Args:
            other: A connector of the same class, with the same options except for
                ``register_options``. It has no read and no write in flight. If this method returns
                True, the connection no longer belongs to ``other``.

        Returns:
            Whether this connector has taken over the connection. If not, the loop closes ``other``,
            and connects.

        Raises:
            ConnectorError: The connection was lost.

        """
        return False

    @abstractmethod
    def read(self) -> bytes:
        """Read one image of the whole block.

        Returns:
            ``layout.size`` bytes.

        Raises:
            ConnectorError: The device has not delivered a complete, fresh image.

        """

    @abstractmethod
    def close(self) -> None:
        """Close the connection. The loop may call this at any time and more than once."""

    def describe(self) -> str:
        """Return, for the log, the parameters of the connection that were negotiated with the device."""
        return ""

    @property
    def doubt(self) -> str:
        """Why the last image is uncertain, with the remedy; empty if the image is good."""
        return ""

    def cycle_requests(self) -> CycleRequests | None:
        """Return the requests that a cycle sends to the device; None if they are not known.

        ``shmio-supervisor check`` shows them. The method is called without a connection, and must
        open none.
        """
        return None

    # -- more than one cycle at a time ---------------------------------------------------------------------------------

    @property
    def depth(self) -> int:
        """Maximum number of requested images in flight on the present connection."""
        return 1

    def submit(self) -> None:  # noqa: B027  not every connector can
        """Request an image without waiting for it.

        Raises:
            ConnectorError: The request cannot be sent.

        """

    def collect(self, until_ns: int) -> bytes | None:  # noqa: ARG002  read() has its own time-out
        """Wait for the oldest image that :meth:`submit` has requested and that is not yet collected.

        Args:
            until_ns: Time at which to stop waiting, CLOCK_MONOTONIC in ns.

        Returns:
            The image, ``layout.size`` bytes; None if it has not arrived by ``until_ns``.

        Raises:
            ConnectorError: The answer is wrong, or has not arrived within the connector's own
                time-out.

        """
        return self.read()

    # -- writing -------------------------------------------------------------------------------------------------------

    def write(self, writes: Sequence[Write]) -> list[str]:  # noqa: ARG002
        """Write bytes and bits to the device.

        A write of a bit does not change the other bits of its byte. A write of bytes may be longer
        than one request of the protocol can carry.

        Args:
            writes: The writes, in the order in which to carry them out.

        Returns:
            For each write, "" if the device confirmed it, or else the reason why the device refused
            it.

        Raises:
            WriteLostError: The connection was lost; the error contains what is known of each write.
            ConnectorError: It is not known whether the device carried out any of the writes.

        """
        raise ConnectorError("this connector cannot write")

    _outcomes: Sequence[str] = ()

    def send(self, writes: Sequence[Write]) -> None:
        """Send writes without waiting until the device confirms them.

        A connector implements this and :meth:`confirm` if even a healthy device may take longer
        than a cycle to confirm a write. The loop sends no further writes before it has the outcomes
        of these. By default, this method calls :meth:`write`, which waits.

        Args:
            writes: As for :meth:`write`.

        Raises:
            ConnectorError: As for :meth:`write`.

        """
        self._outcomes = self.write(writes)

    def confirm(self, until_ns: int) -> Sequence[str] | None:  # noqa: ARG002  write() has its own time-out
        """Wait for the outcomes of the writes that :meth:`send` has sent.

        Args:
            until_ns: Time at which to stop waiting, CLOCK_MONOTONIC in ns.

        Returns:
            The outcomes as :meth:`write` returns them; None if some are not known by ``until_ns``.

        Raises:
            UnconfirmedError: The device has not confirmed all writes within the connector's own
                time-out. The connection stays open.
            ConnectorError: As for :meth:`write`.

        """
        return self._outcomes


class Computed(ABC):
    """Base class for a source that computes its registers, and that follows the instance clock.

    The loop calls all methods in one thread, except :meth:`interrupt`. A method that fails raises a
    ShmioError, whose text the operator of the cell reads. The loop tries again in the next cycle.
    """

    Options: ClassVar[type[msgspec.Struct]]
    """The source's own keys of ``[[source]]``. The struct must refuse unknown keys."""

    prompt: ClassVar[bool] = False
    """True if the loop publishes written values at once, and not only in the next cycle."""

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
        """The topics that connected inputs get their values from, by the paths of the inputs."""
        return {}

    @property
    def inputs(self) -> tuple[str, ...]:
        """The paths of the registers that a configuration may connect to topics of other sources."""
        return ()

    def connect(self, values: Mapping[str, Value], doubt: str) -> None:  # noqa: B027  not every source has inputs
        """Store the values of connected inputs for the next :meth:`step`.

        Args:
            values: Values by path. An input that is not among them keeps its present value.
            doubt: Why some inputs have no value; empty if all have one.

        """

    def attach(self, writer: BlockWriter) -> None:  # noqa: B027  most need nothing of it
        """Store the object that writes the source's block. This is called once, before the methods below.

        Raises:
            SegmentError: The block does not fit the source.

        """

    @abstractmethod
    def resume(self, image: bytes) -> None:
        """Continue from the last image of the source's previous process. This is called before :meth:`begin`."""

    @abstractmethod
    def begin(self) -> bytes:
        """Return the image before the first step; for a ``prompt`` source, its present image."""

    def has_changed(self) -> bool:
        """Return whether the result of :meth:`begin` would be a new image. This is called between two steps."""
        return False

    def interrupt(self) -> None:  # noqa: B027  most never wait
        """End a :meth:`step` that is waiting. Any thread may call this."""

    def close(self) -> None:  # noqa: B027  most hold nothing
        """Release all resources of the source. The loop calls this last."""

    def save(self) -> bytes:
        """Return the source's state for a snapshot, without its last image. This is called between two steps.

        Raises:
            SnapshotError: The source cannot save its state; the message says why.

        """
        raise SnapshotError("its connector does not support snapshots")

    def prepare_restore(self, data: bytes) -> Callable[[], None]:  # noqa: ARG002
        """Check the state of a snapshot, and return the function that restores it.

        Raises:
            SnapshotError: The state is damaged, or does not fit the source.

        """
        raise SnapshotError("its connector does not support snapshots")

    @abstractmethod
    def write(self, writes: Sequence[Write]) -> list[str]:
        """Set bytes and bits; return for each write "" or the reason why the source refuses it."""

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
    """Base class for a source that plays the frames of a recording, with the recording's layout.

    Such a source follows the instance clock.
    """

    Options: ClassVar[type[msgspec.Struct]]
    """The source's own keys of ``[[source]]``. The struct must refuse unknown keys."""

    @abstractmethod
    def __init__(self, options: Any, name: Any) -> None:
        """Open the recording.

        Args:
            options: An instance of ``Options``.
            name: The name of the source.

        Raises:
            ConfigError: The recording cannot be played. The message begins with the configuration
                key that is wrong.

        """


class Mirrored(ABC):
    """Base class for a source that reproduces a source of another instance, with its layout."""

    Options: ClassVar[type[msgspec.Struct]]
    """The source's own keys of ``[[source]]``. The struct must refuse unknown keys."""

    @abstractmethod
    def __init__(self, options: Any, name: Any) -> None:
        """Check the options, without connecting.

        Args:
            options: An instance of ``Options``.
            name: The name of the source.

        Raises:
            ConfigError: An option is wrong. The message begins with the configuration key.

        """
