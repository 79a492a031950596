"""Answers that pass every check of their headers, and are wrong behind them."""

from __future__ import annotations

import struct

from hypothesis import strategies as st


def answer(kind: int, parameters: bytes, data: bytes) -> bytes:
    """A frame whose lengths are right. ``kind``: the ROSCTR; userdata, 7, has no error in its header."""
    header = struct.pack(">BBHHHH", 0x32, kind, 0, 7, len(parameters), len(data)) + (b"" if kind == 7 else b"\0\0")
    payload = b"\x02\xf0\x80" + header + parameters + data
    return struct.pack(">BxH", 3, 4 + len(payload)) + payload


def _torn(whole: bytes) -> st.SearchStrategy[bytes]:
    return st.builds(lambda cut, tail: whole[:cut] + tail, st.integers(0, len(whole)), st.binary(max_size=4))


def answers(kind: int, parameters: bytes, data: bytes) -> st.SearchStrategy[bytes]:
    """Frames with right headers, whose parameters and data are such as these, cut short, and some noise."""
    return st.builds(answer, st.just(kind), _torn(parameters), _torn(data))
