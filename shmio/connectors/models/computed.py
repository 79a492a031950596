"""What a source is that this process computes, where another has a device. The loop that runs it is in ``stepped``."""

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
    """A source that lives on the instance's clock. All hooks run in one thread.

    A hook that fails raises a ShmioError, in words for the person at the cell; the next cycle tries again.
    """

    Options: ClassVar[type[msgspec.Struct]]
    """Its own keys of ``[[source]]``; refuses unknown ones."""

    prompt: ClassVar[bool] = False
    """Whether what is written is shown at once, without waiting for a cycle."""

    timeout_s: float = 1.0
    """How long a step is to take at most."""

    @abstractmethod
    def __init__(self, options: Any, layout: Layout) -> None:
        """``options`` is an instance of ``Options``. ConfigError when layout and options do not go together."""

    @property
    def connections(self) -> Mapping[str, str]:
        """The topic that each connected input is read from, by the input's path."""
        return {}

    @property
    def inputs(self) -> tuple[str, ...]:
        """Paths of the registers that may be connected."""
        return ()

    def connect(self, values: Mapping[str, Value], doubt: str) -> None:  # noqa: B027  not every source has inputs
        """Values of connected inputs for the next :meth:`step`; one that is left out keeps what it has.

        ``doubt``: why some are left out.
        """

    def attach(self, writer: BlockWriter) -> None:  # noqa: B027  most need nothing of it
        """Take the writing side of the block; once, before the hooks below. SegmentError."""

    @abstractmethod
    def resume(self, image: bytes) -> None:
        """Go on from the last image that the source's process before this one published; before :meth:`begin`."""

    @abstractmethod
    def begin(self) -> bytes:
        """The image before the first step; of a prompt source, as it is now."""

    def news(self) -> bool:
        """Whether :meth:`begin` has something else to say by now; asked between two steps."""
        return False

    def interrupt(self) -> None:  # noqa: B027  most never wait
        """Have a step that waits for others end soon; from any thread."""

    @abstractmethod
    def write(self, writes: Sequence[Write]) -> list[str]:
        """Take these bytes and bits; for each "" or why it is refused."""

    @abstractmethod
    def step(self, time_ns: int, dt_ns: int) -> bytes:
        """The image at a time of the instance's clock, ``dt_ns`` after the one before."""
