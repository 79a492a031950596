"""Each answer is passed once, to the operation that asked for it."""

from __future__ import annotations

import struct

import pytest

from shmio.connectors.s7.transport import Window
from shmio.errors import ConnectorError


def frame(reference: int, error: int = 0) -> memoryview:
    return memoryview(struct.pack(">BxH3sBBHHHHH", 3, 19, b"\x02\xf0\x80", 0x32, 3, 0, reference, 0, 0, error))


class Asker:
    """An operation whose requests are their references."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.sent = 0
        self.given: list[int] = []
        self.answered: list[int] = []

    @property
    def complete(self) -> bool:
        return len(self.answered) == self.count

    def take(self, count: int, first: int) -> bytes:
        references = [(first + place) & 0xFFFF for place in range(count)]
        self.sent += count
        self.given += references
        return struct.pack(f">{count}H", *references)

    def accept(self, index: int, frame: memoryview) -> None:
        assert int.from_bytes(frame[11:13], "big") == self.given[index]
        self.answered.append(index)


def test_window_has_at_most_the_granted_jobs_and_no_reference_twice() -> None:
    window = Window(3, 65534)
    first, second, urgent = Asker(4), Asker(2), Asker(1)
    window.add(first)
    window.add(second)
    assert bytes(window.due()) == struct.pack(">3H", 65534, 65535, 0)
    assert not window.due()
    window.accept(frame(0))  # in any order
    window.add(urgent, urgent=True)
    assert bytes(window.due()) == struct.pack(">H", 1)
    assert urgent.given == [1]
    window.accept(frame(65534))
    window.accept(frame(1))
    assert bytes(window.due()) == struct.pack(">2H", 2, 3)
    assert (first.given, second.given) == ([65534, 65535, 0, 2], [3])
    window.accept(frame(65535))
    assert bytes(window.due()) == struct.pack(">H", 4)
    for reference in (2, 3, 4):
        assert not window.idle
        window.accept(frame(reference))
    assert window.idle
    assert (first.answered, second.answered, urgent.answered) == ([2, 0, 1, 3], [0, 1], [0])
    assert not window.due()
    assert window.reference == 5


def test_unexpected_answers_are_refused() -> None:
    window = Window(2, 10)
    window.add(Asker(3))
    window.due()
    window.accept(frame(10))
    for reference in (10, 9, 12, 65535):  # answered, older, not sent, never
        with pytest.raises(ConnectorError, match=rf"not in flight \(reference {reference}\)"):
            window.accept(frame(reference))
    with pytest.raises(ConnectorError, match="PUT/GET"):  # its error says more than that it is unexpected
        window.accept(frame(77, error=0x8104))
    with pytest.raises(ConnectorError, match="too short"):
        window.accept(frame(10)[:16])
