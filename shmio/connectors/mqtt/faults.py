"""The fault of a single value, which turns its register bad and no other."""

from __future__ import annotations


class ValueFaultError(Exception):
    """A message has no such value, or none that fits.

    ``code`` is the status of the register, ``source_ns`` the time of the message; 0: unknown.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.source_ns = 0
