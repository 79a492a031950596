"""Computes the growing waits between repeated attempts (back-off)."""

from __future__ import annotations

import random
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Backoff:
    """Rule for the waits between attempts. An object has no state: the caller counts the waits.

    Attributes:
        first_s: The first wait, in s.
        most_s: The longest wait, in s, before the jitter.
        factor: Ratio of each wait to the one before it.
        jitter: The largest random deviation, as a fraction of the wait. Use it where many clients
            would otherwise retry at the same time.

    """

    first_s: float
    most_s: float
    factor: float = 2.0
    jitter: float = 0.0

    def wait_s(self, waits: int = 0) -> float:
        """Return the next wait in s. ``waits`` is the number of waits since the last success."""
        wait_s = min(self.most_s, self.first_s * self.factor ** min(waits, 64))  # the bound prevents an overflow
        if self.jitter:
            wait_s *= random.uniform(1 - self.jitter, 1 + self.jitter)  # noqa: S311  not a secret
        return wait_s
