"""Subjects to listen to: registers of one block, and how their image becomes a message."""

from __future__ import annotations

from collections.abc import Callable, Sized
from dataclasses import dataclass, field
from typing import Protocol

from shmio.layout.model import Register


class BlockImage(Protocol):
    """An image of a block with its number and time: a frame, or a future one."""

    @property
    def number(self) -> int:
        """Number of the frame, or of the step."""

    @property
    def clock_ns(self) -> int:
        """Time of the instance's clock, in ns."""

    @property
    def image(self) -> bytes:
        """The block's bytes as consumers see them."""


class SourceImage(BlockImage, Protocol):
    """An image together with the bytes that the source delivered."""

    @property
    def raw(self) -> bytes:
        """The block's bytes as the source delivered them, without injections."""


Encode = Callable[[BlockImage], Sized | None]
"""Encodes an image as a message, whose ``len`` is in bytes; None: the bytes hold no value."""


@dataclass(frozen=True, slots=True)
class Subject:
    """A register, an array's element or a structure in the encoding of one service.

    Equal subjects are encoded once for all listeners.

    Attributes:
        wire: Name of the encoding.
        path: Canonical path in the block.
        registers: The registers it shows.
        encode: Makes a message of an image.
        changed: Returns whether two images differ in the subject; None: compare the registers
            as consumers see them.

    """

    wire: str
    path: str
    registers: tuple[Register, ...] = field(compare=False)
    encode: Encode = field(compare=False)
    changed: Callable[[SourceImage, SourceImage], bool] | None = field(default=None, compare=False)
