"""What controllers send besides answers: bytes from public captures of S7-300, S7-400 and PC-based controllers.

The captures are part of the collection ITI/ICS-Security-Tools (CC BY 4.0).
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle

import pytest

from shmio.errors import ConnectorError
from shmio.layout.values.write import Write
from tests.unit.connectors.s7.harness import Plc, assert_recovers
from tests.unit.connectors.s7.noise import EMPTY, parts_of

PUSHES = [bytes.fromhex(text) for text in (
    "03000019 02f080 320700000000 0008 0000 0100101000000000",
    "03000019 02f080 320700000000 0008 0000 0100101000000200",
    # the CPU goes to STOP
    "03000031 02f080 320700000000 0008 0018 0001120411040300 ff090014 4304ff8400000000000000009401092153421521",
    # values that another program of the same host watches
    ("0300003b 02f080 320700000000 000c 001e 000112081201020200000000 ff09001a 00040012010000020002 ff090006413385"
    "1fdead ff0900010200"),
    "0300002f 02f080 320700000000 000c 0012 000112081201080200000000 ff09000e 00040006010000020003 ffffff00",
)]  # fmt: skip


def is_data(frame: bytes) -> bool:
    return frame[5] == 0xF0


ADDED: dict[str, Callable[[bytes], bytes]] = {
    "an empty TPDU before": lambda frame: EMPTY + frame,
    "empty TPDUs after": lambda frame: frame + EMPTY * 3,
    "an empty message": lambda frame: EMPTY + frame + b"\3\0\0\7\2\xf0\x80",
    "the end in a TPDU of its own": lambda frame: parts_of(frame, len(frame) - 7),
    "numbered TPDUs": lambda frame: frame[:6] + b"\x81" + frame[7:] if is_data(frame) else frame,
    "pushes": lambda frame: b"".join(PUSHES) + frame + PUSHES[0] if is_data(frame) else frame,
}


@pytest.mark.parametrize("added", ADDED)
def test_answers_arrive_with(plc: Plc, added: str) -> None:
    """Also before and after the confirm and the set-up, and before answers that come together."""
    plc.proxy.edit(
        ADDED[added] if "own" not in added else lambda frame: ADDED[added](frame) if is_data(frame) else frame
    )
    client = plc.connected(packetSize=500)
    for generation in range(3):
        assert client.write([Write(7, 0, bytes([generation]))]) == [""]
        assert client.read() == plc.block
        assert plc.block[7] == generation


def test_answers_divided_at_each_byte(plc: Plc) -> None:
    client = plc.connected(size=12)
    size = 25 + 12 - 7
    cuts = cycle([(cut,) for cut in range(1, size)] + [tuple(range(1, size)), (4, 5, 20)])

    def divided(frame: bytes) -> bytes:
        return parts_of(frame, *next(cuts)).replace(b"\2\xf0\0", b"\2\xf0\1", 1)  # the number has no meaning

    plc.proxy.edit(lambda frame: divided(frame) if len(frame) == size + 7 else frame)
    for generation in range(size + 2):
        plc.block[3] = generation
        assert client.read() == plc.block[:12]


def test_answers_without_end_are_refused(plc: Plc) -> None:
    client = plc.connected()
    plc.proxy.edit(lambda frame: (frame[:6] + b"\0" + frame[7:]) * 3)
    with pytest.raises(ConnectorError, match="message of more than 960 bytes in several TPDUs"):
        client.read()
    assert_recovers(plc, client)


def test_what_answers_a_request_is_no_push(plc: Plc) -> None:
    client = plc.connected()
    answer = bytearray(PUSHES[2])
    answer[22] |= 0x80
    plc.proxy.edit(lambda frame: bytes(answer) + frame)
    with pytest.raises(ConnectorError, match=r"not an answer|not in flight"):
        client.read()
    assert_recovers(plc, client)
