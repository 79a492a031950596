"""Virtual time as the endpoint has delivered it, shared by all feeds and services."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Moment(NamedTuple):
    """A step's number, and the simulation time after it, in ns since the instance's start."""

    number: int
    clock_ns: int


class TimeStatus(NamedTuple):
    """The state of the instance's time.

    ``dt_ns`` is the size of the step that the status reports, otherwise the present step size.
    ``alive`` is False after a client has said that time goes on no more.
    """

    clock_ns: int
    dt_ns: int
    alive: bool
    playing: bool


class DeliveredImage(NamedTuple):
    """A block's image after a step; ``raw``: as the source delivered it, without injections."""

    number: int
    clock_ns: int
    image: bytes
    raw: bytes


class VirtualTime:
    """Whether time is virtual (``on``), and the step that was delivered last (``moment``).

    In virtual time, values of blocks on the instance's clock are delivered step by step.
    For the event loop's thread.
    """

    def __init__(self) -> None:
        self.on = False
        self.look: Callable[[], object] = lambda: None
        """Adopts steps that other programs have made; set by the timeline."""
        self.moment = Moment(0, 0)
