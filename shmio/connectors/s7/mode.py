"""Queries the controller's operating mode about once a second, to notice a PLC in STOP. No I/O.

The mode is the low half of the fourth byte of a record of SZL W#16#0424; the high half is the
previous mode. The numbers are from Siemens, System Software for S7-300/400, A5E00739858, 33.21. If
a controller does not support this list, it is not queried again, and STOP is not noticed.
"""

from __future__ import annotations

import logging
import struct

from shmio.connectors.s7 import pdu
from shmio.connectors.s7.explain import ITEM_OK, RefusedError
from shmio.errors import ConnectorError

INTERVAL_NS = 1_000_000_000
_PATIENCE = 2  # number of connections that end during a query before queries stop
_SZL = 0x0424
_ASK = bytes.fromhex("000112 04 11 44 01 00")  # head 3 bytes, length 4, a request, group SZL, "read SZL"
_PARAMETERS = b"\x00\x01\x12\x08\x12\x84\x01"  # head 3 bytes, length 8, an answer, group SZL, "read SZL"
_PARAMETERS_SIZE = 12
_DATA = struct.Struct(">BBH HH HH")  # return code, transport size, length; SZL and index; size and number of records

_MODES = {
    **dict.fromkeys((1, 2, 3, 4), "in STOP: its program does not run; switch it to RUN"),
    **dict.fromkeys((5, 6, 7), "starting up: its program does not run yet"),
    0xA: "on HOLD: its program stands at a breakpoint; end the test in the programming tool",
    0xD: "DEFECTIVE; see its diagnostics buffer",
    0xE: "in its self-test: its program does not run yet",
    0xF: "without power",
}
"""The modes in which values do not change, with their texts.

In the other modes the program runs: RUN is 8; a redundant pair has 9, and B and C while it couples.
"""

log = logging.getLogger("shmio.source")


class ModeQuery:
    """Queries the operating mode, and stores the last answer."""

    count = 1

    def __init__(self) -> None:
        self._due_ns = 0
        self.deadline_ns = 0
        """Time by which the answer to an open query must come, in ns of CLOCK_MONOTONIC."""
        self._known = False  # the controller has answered at least once
        self._failures = 0
        self._supported = True
        self.sent = 0
        self.complete = True
        self.doubt = ""
        """Reason why values may not change; empty if the program runs or the mode is unknown."""

    def due(self, now_ns: int) -> bool:
        """Return whether to send a query now."""
        return self._supported and self.complete and now_ns >= self._due_ns

    def overdue(self, now_ns: int) -> bool:
        """Return whether the answer is late."""
        return not self.complete and now_ns >= self.deadline_ns

    def begin(self, now_ns: int, deadline_ns: int) -> None:
        """Begin a query whose answer must come by ``deadline_ns``."""
        self._due_ns = now_ns + INTERVAL_NS
        self.deadline_ns = deadline_ns
        self.sent = 0
        self.complete = False

    def take(self, count: int, first: int) -> bytes:
        """Return the request."""
        self.sent = count
        data = struct.pack(">BBHHH", ITEM_OK, 0x09, 4, _SZL, 0)  # four bytes: SZL and index
        return pdu.request(first & 0xFFFF, _ASK, data, pdu.USERDATA)

    def accept(self, index: int, frame: memoryview) -> None:  # noqa: ARG002 - there is one request
        """Process the answer.

        Raises:
            ConnectorError: The answer does not match the request.

        """
        self.complete = True
        mode = parse_mode_answer(frame)
        if mode is None:
            self._give_up("does not support the query")
            return
        self._known = True
        words = _MODES.get(mode)
        self.doubt = f"the PLC is {words}" if words else ""

    def lost(self) -> None:
        """Forget the mode, because the connection was lost.

        Stop querying if connections were repeatedly lost during a query.
        """
        self.doubt = ""
        self._due_ns = 0
        if self.complete:
            return
        self.complete = True
        self._failures += 1
        if not self._known and self._failures == _PATIENCE:
            self._give_up("does not answer the query")

    def _give_up(self, why: str) -> None:
        self._supported = False
        self.doubt = ""
        log.debug("the controller %s of its operating mode: STOP will not be noticed", why)


def parse_mode_answer(frame: memoryview) -> int | None:
    """Return the operating mode from an answer to a read of SZL 0x0424; None if there is none.

    Raises:
        ConnectorError: The answer is malformed.

    """
    kind, parameters_size, data_size = pdu.check_envelope(frame)
    if kind != pdu.USERDATA:
        try:
            pdu.check_answer(frame)
        except RefusedError:
            return None
        raise ConnectorError("not an answer to 'read SZL'")
    begin = pdu.USERDATA_END + _PARAMETERS_SIZE
    if parameters_size != _PARAMETERS_SIZE or begin + data_size != len(frame) or data_size < 4:
        raise ConnectorError("not an answer to 'read SZL': inconsistent lengths")
    parameters = frame[pdu.USERDATA_END : begin]
    if parameters[:7] != _PARAMETERS:
        raise ConnectorError("not an answer to 'read SZL'")
    if parameters[10] or parameters[11] or frame[begin] != ITEM_OK:
        return None
    if data_size < _DATA.size:
        raise ConnectorError("answer to 'read SZL' without its head")
    _, _, length, szl, _, record_size, records = _DATA.unpack_from(frame, begin)
    if length != data_size - 4 or szl != _SZL:
        raise ConnectorError(f"not an answer to 'read SZL' 0x{_SZL:04X}")
    if not records or record_size < 4 or data_size < _DATA.size + 4:
        return None
    return frame[begin + _DATA.size + 3] & 0x0F
