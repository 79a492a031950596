"""The query for the controller's operating mode, sent about once a second to notice a PLC in STOP. No I/O.

The mode is the low half of the fourth byte of a record of the system status list (SZL) W#16#0424; the
high half is the previous mode. The numbers are from Siemens, System Software for S7-300/400,
A5E00739858, 33.21. If a controller refuses this list, shmio does not ask for it again in the session,
and does not notice STOP.
"""

from __future__ import annotations

import logging
import time
from typing import Final

from shmio.connectors.s7.explain import RefusedError
from shmio.connectors.s7.query import Query
from shmio.connectors.s7.userdata import READ_SZL, szl_data, szl_records

INTERVAL_NS = 1_000_000_000
_SZL = 0x0424

_DOUBTS = {
    **dict.fromkeys((1, 2, 3, 4), "in STOP: its program does not run; switch it to RUN"),
    **dict.fromkeys((5, 6, 7), "starting up: its program does not run yet"),
    0xA: "on HOLD: its program stands at a breakpoint; end the test in the programming tool",
    0xD: "DEFECTIVE; see its diagnostics buffer",
    0xE: "in its self-test: its program does not run yet",
    0xF: "without power",
}
"""The modes in which values do not change, with texts that say so.

In all other modes, the program runs. RUN is 8; a redundant pair has 9, and 0xB and 0xC while its
controllers synchronize.
"""
MODES: Final = {
    **dict.fromkeys((1, 2, 3, 4), "STOP"),
    **dict.fromkeys((5, 6, 7), "STARTUP"),
    8: "RUN",
    9: "RUN-R",
    0xA: "HOLD",
    0xB: "LINK-UP",
    0xC: "UPDATE",
    0xD: "DEFECTIVE",
    0xE: "SELF-TEST",
    0xF: "NO POWER",
}
"""The name of each mode."""

log = logging.getLogger("shmio.source")


class ModeQuery(Query):
    """Asks for the operating mode about once a second, and stores the last answer."""

    def __init__(self) -> None:
        super().__init__(READ_SZL, INTERVAL_NS)
        self.doubt = ""
        """Why values may not change; empty if the program runs or the mode is unknown."""
        self.mode: int | None = None
        """The number of the mode, usually one of ``MODES``; None if it is unknown."""
        self.answered_ns = 0
        """UTC time of the last answer, in ns since 1970."""
        self.unknown = False
        """True if the controller does not report its mode in this session."""
        self._logged = False

    @property
    def runs(self) -> bool:
        """True if the mode is known, and the program runs in this mode."""
        return self.mode in MODES and self.mode not in _DOUBTS

    def data(self) -> bytes:
        """Return the data of the request."""
        return szl_data(_SZL)

    def answered(self, data: bytes) -> None:
        """Store the mode. If the answer contains no mode, stop asking in this session."""
        records = szl_records(data, _SZL)
        if not records or len(records[0]) < 4:
            self._stop()
            return
        self.mode = records[0][3] & 0x0F
        self.answered_ns = time.time_ns()
        words = _DOUBTS.get(self.mode)
        self.doubt = f"the PLC is {words}" if words else ""

    def refused(self, refusal: RefusedError) -> None:  # noqa: ARG002 - all refusals mean the same
        """Stop asking in this session. The next session may be with another controller."""
        self._stop()

    def _stop(self) -> None:
        self.skip()
        self.given_up("does not support the query")

    def lost(self, *, alive: bool = True) -> None:
        """Forget the mode, because the connection was lost."""
        self._forget()
        self.unknown = not self.supported
        super().lost(alive=alive)

    def given_up(self, why: str) -> None:
        """Log that shmio will not notice STOP, and why."""
        self._forget()
        self.unknown = True
        if not self._logged:
            self._logged = True
            log.debug("shmio will not notice STOP, because the controller %s", why)

    def _forget(self) -> None:
        self.doubt, self.mode = "", None
