"""What somebody may listen to: registers of one block, and how an image of them becomes a message."""

from __future__ import annotations

from collections.abc import Callable, Sized
from dataclasses import dataclass, field
from typing import Protocol

from shmio.layout.model import Register


class BlockImage(Protocol):
    """An image of a block and its time: a frame, or what is to become one."""

    @property
    def number(self) -> int:
        """Number of the frame."""

    @property
    def clock_ns(self) -> int:
        """The instance's clock."""

    @property
    def image(self) -> bytes:
        """The block's bytes."""


class SourceImage(BlockImage, Protocol):
    """A frame, with what its source delivered."""

    @property
    def raw(self) -> bytes:
        """That, whatever injections show instead."""


Encode = Callable[[BlockImage], Sized | None]
"""The message, whose length is in bytes; None where the bytes hold no value."""


@dataclass(frozen=True, slots=True)
class Subject:
    """A register, an array's element or a structure as one wire shows it; equal ones are encoded once for all.

    ``wire``: which one. ``path``: canonical, in the block. ``registers``: what it shows. ``changed``: whether two
    frames differ in it, if it is not what consumers see of the registers.
    """

    wire: str
    path: str
    registers: tuple[Register, ...] = field(compare=False)
    encode: Encode = field(compare=False)
    changed: Callable[[SourceImage, SourceImage], bool] | None = field(default=None, compare=False)
