"""The base class of sources that are computed instead of read from a device.

``stepped`` runs them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import msgspec

from shmio.layout.model import Layout
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write
from shmio.segment import BlockWriter


class Computed(ABC):
    """A source that follows the instance clock. All hooks run in one thread.

    A hook that fails raises a ShmioError with a text for the operator of the cell. The next cycle
    tries again.
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
