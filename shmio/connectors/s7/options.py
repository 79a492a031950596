"""The options of the S7 connector.

The keys are those of the seed's ``plc.ini`` (D6.5, section 4.2).
"""

from __future__ import annotations

import ipaddress
import re
from typing import Annotated

import msgspec

from shmio.config.wording import meant

# The slot of the CPU in its rack, by family, where nothing is configured.
_CPU_SLOT = {"S7_300": 2, "S7_400": 3, "S7_1200": 1, "S7_1500": 1}


class S7Options(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Address of the controller and parameters of the session.

    ValueError for an invalid host or model.
    """

    host: Annotated[str, msgspec.Meta(min_length=1, max_length=253)]
    model: str | None = None
    """``S7_300``, ``S7_400``, ``S7_1200`` or ``S7_1500``.

    Only the default of ``slot`` depends on it.
    """
    port: Annotated[int, msgspec.Meta(ge=1, le=65535)] = 102
    rack: Annotated[int, msgspec.Meta(ge=0, le=7)] = 0
    slot: Annotated[int, msgspec.Meta(ge=0, le=31)] | None = None
    timeout: Annotated[int, msgspec.Meta(ge=1, le=600_000)] = 5000
    """Milliseconds for connecting, for reading the block, and for each answer to a write."""
    packetSize: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None  # noqa: N815 - a key of plc.ini
    """The most data bytes in one read; the controller's PDU size limits it too."""
    dbNumber: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None  # noqa: N815 - a key of plc.ini
    """The data block; the layout's own number if absent."""
    maxJobs: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None  # noqa: N815 - named as its siblings
    """The most requests in flight; the controller's limit applies too."""

    def __post_init__(self) -> None:
        if not _is_host(self.host):
            raise ValueError(f"host: {self.host!r} is not a host name or address; give the port in the key port")
        if self.model is not None and _family(self.model) not in _CPU_SLOT:
            raise ValueError(
                f"model: {self.model!r} is unknown; valid: {', '.join(_CPU_SLOT)}{meant(self.model, _CPU_SLOT)}"
            )

    @property
    def cpu_slot(self) -> int:
        """The slot as configured, else the model's usual one."""
        if self.slot is not None:
            return self.slot
        return 1 if self.model is None else _CPU_SLOT[_family(self.model)]

    @property
    def peer(self) -> str:
        """``host:port`` for messages, IPv6 in brackets."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def _family(model: str) -> str:
    """Return the model as the table has it: ``s7-1500`` is ``S7_1500``."""
    return model.strip().upper().replace("-", "_").replace(" ", "_")


def _is_host(text: str) -> bool:
    """Return whether the text is an IP address (IPv6 with a zone too) or a valid host name."""
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return re.fullmatch(r"[^\s:/\[\]@]+", text) is not None and _is_name(text)
    return True


def _is_name(text: str) -> bool:
    """Return whether the text can be looked up: no label is empty or longer than 63 bytes."""
    try:
        text.encode("idna")
    except UnicodeError:
        return False
    return True
