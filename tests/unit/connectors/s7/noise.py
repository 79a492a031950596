"""Answers with correct headers and faulty contents, and messages in several TPDUs."""

from __future__ import annotations

import struct
from itertools import pairwise

from hypothesis import strategies as st


def answer(kind: int, parameters: bytes, data: bytes) -> bytes:
    """Return a frame with correct lengths; ``kind`` is its ROSCTR (7, userdata, has no error field)."""
    header = struct.pack(">BBHHHH", 0x32, kind, 0, 7, len(parameters), len(data)) + (b"" if kind == 7 else b"\0\0")
    payload = b"\x02\xf0\x80" + header + parameters + data
    return struct.pack(">BxH", 3, 4 + len(payload)) + payload


def _torn(whole: bytes) -> st.SearchStrategy[bytes]:
    return st.builds(lambda cut, tail: whole[:cut] + tail, st.integers(0, len(whole)), st.binary(max_size=4))


def answers(kind: int, parameters: bytes, data: bytes) -> st.SearchStrategy[bytes]:
    """Generate frames with correct headers, but truncated parameters and data, and some noise."""
    return st.builds(answer, st.just(kind), _torn(parameters), _torn(data))


EMPTY = bytes.fromhex("03000007 02f000")
"""A data TPDU without data and without EOT, which Siemens' clients and PC-based controllers send between messages."""


def parts_of(frame: bytes, *cuts: int) -> bytes:
    """Return a message in several TPDUs, which end at these places of its PDU."""
    pdu = frame[7:]
    tpdus = [
        bytes((2, 0xF0, 0x80 if stop == len(pdu) else 0)) + pdu[start:stop]
        for start, stop in pairwise([0, *cuts, len(pdu)])
    ]
    return b"".join(b"\3\0" + (4 + len(tpdu)).to_bytes(2, "big") + tpdu for tpdu in tpdus)
