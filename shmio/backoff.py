"""Back-off: growing waits between attempts."""

from __future__ import annotations

import random
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Backoff:
    """Rule for the waits between attempts; it has no state, and the caller counts failures.

    Attributes:
        first_s: The first wait, in s.
        most_s: The longest wait, in s, before the jitter.
        factor: Each wait is so many times as long as the one before.
        jitter: The largest random deviation, as a fraction of the wait. Use it where many clients
            would otherwise all try at the same time.

    """

    first_s: float
    most_s: float
    factor: float = 2.0
    jitter: float = 0.0

    def wait_s(self, waits: int = 0) -> float:
        """Return the next wait in s, after so many ``waits`` in a row."""
        wait_s = min(self.most_s, self.first_s * self.factor ** min(waits, 64))  # a float may not overflow
        if self.jitter:
            wait_s *= random.uniform(1 - self.jitter, 1 + self.jitter)  # noqa: S311  not a secret
        return wait_s
