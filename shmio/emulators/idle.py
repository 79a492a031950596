"""A program that does nothing: the block keeps its initial values, and whatever clients write to them."""

from __future__ import annotations

from shmio.layout.model import Layout


class Idle:
    """Leaves every register alone: a controller in RUN without a user program."""

    period_ms = 100
    """Time between two cycles, which say only that the controller is alive."""

    def __init__(self, layout: Layout) -> None:
        """Suit every layout."""

    def step(self, time_s: float, frame: bytearray) -> None:
        """Change nothing."""
