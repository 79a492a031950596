"""What devices and gateways say about the quality of a value."""

from __future__ import annotations

from typing import Any, Final

from shmio.model.statuses import (
    BAD,
    GOOD,
    UNCERTAIN,
    UNCERTAIN_LAST_USABLE_VALUE,
    from_opc_quality,
    unknown_quality,
)
from shmio.wording import brief

STALE: Final = 500
"""The number of Sparkplug for a value that may be old (Eclipse Sparkplug Specification 3.0.0, 6.4.8.1)."""
_WORDS: Final = {"true": GOOD, "false": BAD, "good": GOOD, "uncertain": UNCERTAIN, "bad": BAD}


def from_json(found: Any) -> tuple[int, str]:
    """Return the status code for a quality in JSON, and what the code does not say.

    It is a number as for :func:`from_number`, true, false, or one of the words good, uncertain and bad.
    """
    code = _WORDS.get(str(found).strip().casefold()) if isinstance(found, bool | str) else None
    return from_number(found) if code is None else (code, "")


def from_number(found: Any) -> tuple[int, str]:
    """Return the status code for a number of OPC DA or 500, and what the code does not say; all else is uncertain."""
    code = None
    if isinstance(found, int | float) and not isinstance(found, bool):
        code = UNCERTAIN_LAST_USABLE_VALUE if found == STALE else from_opc_quality(found)
    if code is not None:
        return code, ""
    return unknown_quality(found), f"its quality is {brief(found)}, which has no meaning that shmio knows"
