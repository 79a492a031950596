"""What the S7 connector can be told; the keys are those of the seed's ``plc.ini`` (D6.5, section 4.2)."""

from __future__ import annotations

from typing import Annotated

import msgspec

# The slot of the CPU in its rack, by family, where nothing is configured.
_CPU_SLOT = {"S7_300": 2, "S7_400": 3, "S7_1200": 1, "S7_1500": 1}


class S7Options(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Where the controller is and how to talk to it.

    Values from a properties file are text: read them with ``msgspec.convert(..., S7Options, strict=False)``.
    """

    host: Annotated[str, msgspec.Meta(min_length=1, max_length=253)]
    model: Annotated[str, msgspec.Meta(max_length=64)] | None = None
    """``S7_300``, ``S7_400``, ``S7_1200`` or ``S7_1500``; only the default of ``slot`` depends on it."""
    port: Annotated[int, msgspec.Meta(ge=1, le=65535)] = 102
    rack: Annotated[int, msgspec.Meta(ge=0, le=7)] = 0
    slot: Annotated[int, msgspec.Meta(ge=0, le=31)] | None = None
    timeout: Annotated[int, msgspec.Meta(ge=1, le=600_000)] = 5000
    """Milliseconds for one whole operation: connecting, or reading the block."""
    packetSize: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None  # noqa: N815 - a key of plc.ini
    """The most data bytes in one read; what the controller grants bounds it too."""
    dbNumber: Annotated[int, msgspec.Meta(ge=1, le=65535)] | None = None  # noqa: N815 - a key of plc.ini
    """The data block; the layout's own number if absent."""
    maxJobs: Annotated[int, msgspec.Meta(ge=1, le=255)] | None = None  # noqa: N815 - named as its siblings
    """The most requests under way at once; what the controller grants bounds it too."""

    @property
    def cpu_slot(self) -> int:
        """The slot as configured, else the usual one of the model."""
        if self.slot is not None:
            return self.slot
        return _CPU_SLOT.get((self.model or "").strip().upper().replace("-", "_"), 1)

    @property
    def peer(self) -> str:
        """``host:port`` for messages, IPv6 in brackets."""
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"
