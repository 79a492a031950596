"""Notices of alerts: their content, as JSON and as environment variables."""

from __future__ import annotations

import json
from typing import Any, Final

import msgspec

from shmio.endpoints.alerts.lifecycle import Change

MAX_REASON: Final = 1000
"""Maximum length of a notice's ``reason``, in characters."""


class Notice(msgspec.Struct, kw_only=True, frozen=True):
    """A notice that an alert has become active, or has ended.

    Attributes:
        id: Identifies the notice, so that a receiver can ignore a notice that arrives twice.
        instance: Name of the instance.
        alert: Name of the alert.
        state: Whether the alert has become active, or has ended.
        severity: Severity of the alert, as configured.
        text: Text of the alert, as configured.
        watches: What the alert watches: its condition, processes or sources.
        reason: The values, states or qualities that caused the change, as text.
        values: Values of the registers in the condition, by path.
        injected: True if an injection has changed one of these values.
        provenance: Where the values come from.
        clock_s: Instance time of the change, in s.
        since_s: Instance time at which the alert became active, in s.
        time: When the notice was made, in UTC (RFC 3339).
        suppressed: Number of activations without a notice of their own since the last notice of an
            activation.

    """

    id: str
    instance: str
    alert: str
    state: Change
    severity: str
    text: str
    watches: str
    reason: str
    values: dict[str, bool | int | float | None]
    injected: bool
    provenance: str
    clock_s: float
    since_s: float
    time: str
    suppressed: int

    def json(self) -> bytes:
        """Return the notice as a JSON object."""
        return msgspec.json.encode(self)

    def environment(self) -> dict[str, str]:
        """Return the notice as environment variables. ``SHMIO_ALERT_VALUES`` is a JSON object."""
        fields: dict[str, Any] = msgspec.to_builtins(self)
        fields["name"] = fields.pop("alert")
        return {f"SHMIO_ALERT_{name.upper()}": _variable(value) for name, value in fields.items()}


def _variable(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text.replace("\0", "\N{REPLACEMENT CHARACTER}")
