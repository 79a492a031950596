"""The error for a single value, which turns only its own register bad."""

from __future__ import annotations


class ValueFaultError(Exception):
    """A message does not contain the value of a register, or a value that does not fit.

    ``code`` is the status of the register. ``source_ns`` is the time of the message in ns since
    1970; 0 if unknown.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.source_ns = 0
