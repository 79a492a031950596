"""Whatever is written, in whatever order the jobs of a wave are served: as if it had been written one by one."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from snap7.datatypes import S7Area

from shmio.connectors.base import Lost
from shmio.connectors.s7.block_write import ends, waves
from shmio.emulators.s7_jobs import Fault, Jobs, Memory, Traits
from shmio.layout.values.write import Write

SIZE = 400


def controller(block: bytearray, pdu_size: int, fault: Fault | None = None) -> Jobs:
    jobs = Jobs(Memory({(S7Area.DB, 201): block}), Traits(max_pdu_size=pdu_size, fault=fault))
    jobs.answer(memoryview(struct.pack(">BBHHHHBxHHH", 0x32, 1, 0, 0, 8, 0, 0xF0, 8, 8, 960)))
    return jobs


def framed(answer: bytes | None) -> memoryview:
    assert answer is not None
    return memoryview(struct.pack(">BxH3s", 3, len(answer) + 7, b"\x02\xf0\x80") + answer)


def split(requests: bytes) -> list[bytes]:
    found = []
    while requests:
        size = int.from_bytes(requests[2:4], "big")
        found.append(requests[:size])
        requests = requests[size:]
    return found


def apply(block: bytearray, write: Write) -> None:
    if write.mask:
        block[write.offset] = block[write.offset] & ~write.mask | write.data[0] & write.mask
    else:
        block[write.offset : write.offset + len(write.data)] = write.data


WRITES = st.lists(
    st.builds(lambda at, data: Write(at, 0, data[: SIZE - at]), st.integers(0, SIZE - 1), st.binary(min_size=1))
    | st.builds(lambda data: Write(0, 0, data), st.binary(min_size=SIZE, max_size=SIZE))
    | st.builds(
        lambda at, bit, data: Write(at, 1 << bit, data),
        st.integers(0, 20),
        st.integers(0, 7),
        st.binary(min_size=1, max_size=1),
    ),
    max_size=40,
)


@settings(max_examples=60)
@given(writes=WRITES, pdu_size=st.sampled_from([100, 101, 240, 480, 960]), data=st.data())
def test_as_if_written_one_by_one(writes: list[Write], pdu_size: int, data: st.DataObject) -> None:
    block = bytearray(range(200)) * 2
    wanted = bytearray(block)
    plc = controller(block, pdu_size)
    outcomes = [""] * len(writes)
    for wave in waves(201, pdu_size, writes, outcomes):
        requests = list(enumerate(split(wave.take(wave.count, 65530))))
        assert len(requests) == wave.count
        for index, request in data.draw(st.permutations(requests)):
            assert len(request) <= pdu_size + 7
            assert int.from_bytes(request[11:13], "big") == (65530 + index) & 0xFFFF
            assert not wave.complete
            answer = framed(plc.answer(memoryview(request)[7:]))
            assert len(answer) <= pdu_size + 7
            wave.accept(index, answer)
        assert wave.complete
    for write in writes:
        apply(wanted, write)
    assert block == wanted
    assert outcomes == [""] * len(writes)


def outcomes_of(plc: Jobs, pdu_size: int, writes: list[Write]) -> list[str]:
    outcomes = [""] * len(writes)
    for wave in waves(201, pdu_size, writes, outcomes):
        for index, request in enumerate(split(wave.take(wave.count, 0))):
            wave.accept(index, framed(plc.answer(memoryview(request)[7:])))
    return outcomes


def test_many_small_writes_go_in_few_jobs() -> None:
    writes = [Write(2 * place, 0, b"x") for place in range(60)]
    (wave,) = waves(201, 960, writes, [""] * 60)
    assert wave.count == 3  # twenty items each
    (wave,) = waves(201, 960, [Write(place, 1 << bit, b"\1") for place in range(2) for bit in range(8)], [""] * 16)
    assert wave.count == 1  # bits of one byte are not in each other's way
    assert len(list(waves(201, 960, [Write(0, 0, b"ab"), Write(1, 4, b"\4"), Write(1, 4, b"\0")], [""] * 3))) == 3


def items(requests: bytes) -> list[tuple[int, bool]]:
    """First bit, and whether it is a write of a bit, of each item of these jobs, as they are sent."""
    found = []
    for request in split(requests):
        places = range(19, 19 + 12 * request[18], 12)
        found += [(int.from_bytes(request[at + 9 : at + 12], "big"), request[at + 3] == 1) for at in places]
    return found


@settings(max_examples=30)
@given(order=st.permutations(range(90)), pdu_size=st.sampled_from([100, 240, 960]), size=st.sampled_from([1, 3, 300]))
def test_data_before_their_strobe(order: list[int], pdu_size: int, size: int) -> None:
    """The order of the writes is that within a job and from job to job, wherever in the block they are."""
    writes: list[Write] = []
    wanted = []
    for data, strobe in zip(order[:45], order[45:], strict=True):
        at = SIZE + size * data
        writes += [Write(at, 0, bytes(size)), Write(strobe, 1 << strobe % 8, b"\xff")]
        wanted += [(8 * part, False) for part in range(at, at + size, pdu_size - 28)]
        wanted.append((8 * strobe + strobe % 8, True))
    (wave,) = waves(201, pdu_size, writes, [""] * len(writes))
    assert items(wave.take(2, 0) + wave.take(wave.count - 2, 2)) == wanted  # as the controller has room for jobs


def test_a_refused_item_among_good_ones() -> None:
    block = bytearray(SIZE)
    writes = [Write(0, 0, b"good"), Write(SIZE - 1, 0, b"xy"), Write(SIZE, 1, b"\1"), Write(9, 2, b"\2")]
    outcomes = outcomes_of(controller(block, 480), 480, writes)
    assert [bool(outcome) for outcome in outcomes] == [False, True, True, False]
    assert f"no byte {SIZE} " in outcomes[1]
    assert f"no byte {SIZE} " in outcomes[2]
    assert block == b"good" + bytes(5) + b"\2" + bytes(SIZE - 10)


def test_a_long_write_that_fails_at_its_end_says_so_once() -> None:
    outcomes = outcomes_of(controller(bytearray(SIZE), 100), 100, [Write(0, 0, bytes(SIZE + 1)), Write(0, 0, b"x")])
    assert f"no byte {SIZE} " in outcomes[0]
    assert outcomes[1] == ""


def test_a_job_that_is_refused_as_a_whole_refuses_each_of_its_writes() -> None:
    block = bytearray(SIZE)
    for fault, text in ((Fault.PUT_GET_OFF, "PUT/GET"), (Fault.WRITE_PROTECTED, "access denied")):
        outcomes = outcomes_of(controller(block, 480, fault), 480, [Write(0, 0, b"a"), Write(1, 1, b"\1")])
        assert all(text in outcome for outcome in outcomes)
    assert block == bytes(SIZE)


@pytest.mark.parametrize(
    ("sent", "answered", "fault", "first", "second"),
    [
        (0, 0, None, Lost.UNSENT, Lost.UNSENT),
        (2, 0, None, Lost.UNKNOWN, Lost.UNSENT),
        (2, 1, None, Lost.UNKNOWN, Lost.UNSENT),
        (2, 2, None, Lost.UNKNOWN, Lost.UNSENT),  # done in part: neither written nor surely not
        (5, 4, None, Lost.UNKNOWN, Lost.UNKNOWN),
        (5, 5, None, "", ""),
        (2, 2, Fault.WRITE_PROTECTED, "access denied", Lost.UNSENT),
        (2, 1, Fault.WRITE_PROTECTED, Lost.UNKNOWN, Lost.UNSENT),
    ],
)
def test_what_is_known_of_a_write_of_several_jobs_when_the_session_is_lost(
    sent: int, answered: int, fault: Fault | None, first: str | Lost, second: str | Lost
) -> None:
    plc = controller(bytearray(SIZE), 100, fault)
    outcomes = ["", ""]
    (wave,) = waves(201, 100, [Write(0, 0, bytes(300)), Write(350, 0, b"xy")], outcomes)
    assert wave.count == 5, "the second is in the last job, with the end of the first"
    for index, request in enumerate(split(wave.take(sent, 0))[:answered]):
        wave.accept(index, framed(plc.answer(memoryview(request)[7:])))
    for told, wanted in zip(ends(outcomes, [wave]), (first, second), strict=True):
        if isinstance(told, str) and isinstance(wanted, str):
            assert wanted in told
            assert bool(wanted) is bool(told)
        else:
            assert told is wanted
