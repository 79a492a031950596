"""Virtual time as the endpoint has delivered it: what all feeds and services look at."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Moment(NamedTuple):
    """A step, by its number, and the simulation time after it, in ns since the instance's start."""

    number: int
    clock_ns: int


class TimeStatus(NamedTuple):
    """How time stands. ``dt_ns``: of the step that it tells of, or else what a step moves time by at present."""

    clock_ns: int
    dt_ns: int
    alive: bool
    playing: bool


class DeliveredImage(NamedTuple):
    """A picture of a block (``streams.subject``) as a step has left it; ``raw`` as of a frame."""

    number: int
    clock_ns: int
    image: bytes
    raw: bytes


class VirtualTime:
    """Whether time is virtual, and the step that was delivered last.

    While it is, what comes out of blocks on the instance's clock is shown step by step. Written in the event loop's
    thread alone.
    """

    def __init__(self) -> None:
        self.on = False
        self.look: Callable[[], object] = lambda: None
        """Take in steps of other programs that nobody has waited for."""
        self.moment = Moment(0, 0)
