"""The error about a single value, which makes only the value's own register bad."""

from __future__ import annotations


class ValueFaultError(Exception):
    """A message contains no value for a register, or a value that does not fit the register.

    ``code`` is the status for the register. ``source_ns`` is the source time of the value in ns since
    1970; 0 if unknown.
    """

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(reason)
        self.code = code
        self.source_ns = 0
