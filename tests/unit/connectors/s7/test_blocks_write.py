"""Writes are sent in waves of jobs. In any order of service, they have the effect of single writes."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from snap7.datatypes import S7Area

from shmio.connectors.base import Lost
from shmio.connectors.s7.blocks import bit_item, byte_item, ends, parse_write_answer, waves, write_request
from shmio.connectors.s7.explain import RefusedError
from shmio.emulators.s7 import Fault, Jobs, Memory, ServerOptions
from shmio.errors import ConnectorError
from shmio.layout.values.write import Write
from tests.unit.connectors.s7 import noise as frames

SIZE = 400


def controller(block: bytearray, pdu_size: int, fault: Fault | None = None) -> Jobs:
    jobs = Jobs(Memory({(S7Area.DB, 201): block}), ServerOptions(max_pdu_size=pdu_size, fault=fault))
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
def test_waves_have_the_effect_of_single_writes(writes: list[Write], pdu_size: int, data: st.DataObject) -> None:
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
    assert wave.count == 1  # writes of different bits of a byte fit into one wave
    assert len(list(waves(201, 960, [Write(0, 0, b"ab"), Write(1, 4, b"\4"), Write(1, 4, b"\0")], [""] * 3))) == 3


def items(requests: bytes) -> list[tuple[int, bool]]:
    """Return (first bit, whether a single bit is written) for each item, in the order of sending."""
    found = []
    for request in split(requests):
        places = range(19, 19 + 12 * request[18], 12)
        found += [(int.from_bytes(request[at + 9 : at + 12], "big"), request[at + 3] == 1) for at in places]
    return found


@settings(max_examples=30)
@given(order=st.permutations(range(90)), pdu_size=st.sampled_from([100, 240, 960]), size=st.sampled_from([1, 3, 300]))
def test_data_are_sent_before_their_strobe(order: list[int], pdu_size: int, size: int) -> None:
    """Writes keep their order, within a job and from job to job, at any offsets."""
    writes: list[Write] = []
    wanted = []
    for data, strobe in zip(order[:45], order[45:], strict=True):
        at = SIZE + size * data
        writes += [Write(at, 0, bytes(size)), Write(strobe, 1 << strobe % 8, b"\xff")]
        wanted += [(8 * part, False) for part in range(at, at + size, pdu_size - 28)]
        wanted.append((8 * strobe + strobe % 8, True))
    (wave,) = waves(201, pdu_size, writes, [""] * len(writes))
    assert items(wave.take(2, 0) + wave.take(wave.count - 2, 2)) == wanted  # in two parts, as for a busy controller


def test_a_refused_item_among_good_ones() -> None:
    block = bytearray(SIZE)
    writes = [Write(0, 0, b"good"), Write(SIZE - 1, 0, b"xy"), Write(SIZE, 1, b"\1"), Write(9, 2, b"\2")]
    outcomes = outcomes_of(controller(block, 480), 480, writes)
    assert [bool(outcome) for outcome in outcomes] == [False, True, True, False]
    assert f"no byte {SIZE} " in outcomes[1]
    assert f"no byte {SIZE} " in outcomes[2]
    assert block == b"good" + bytes(5) + b"\2" + bytes(SIZE - 10)


def test_long_write_that_fails_at_its_end_has_one_reason() -> None:
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
        (2, 2, None, Lost.UNKNOWN, Lost.UNSENT),  # partly written
        (5, 4, None, Lost.UNKNOWN, Lost.UNKNOWN),
        (5, 5, None, "", ""),
        (2, 2, Fault.WRITE_PROTECTED, "access denied", Lost.UNSENT),
        (2, 1, Fault.WRITE_PROTECTED, Lost.UNKNOWN, Lost.UNSENT),
    ],
)
def test_outcomes_of_a_write_of_several_jobs_after_a_lost_session(
    sent: int, answered: int, fault: Fault | None, first: str | Lost, second: str | Lost
) -> None:
    plc = controller(bytearray(SIZE), 100, fault)
    outcomes = ["", ""]
    (wave,) = waves(201, 100, [Write(0, 0, bytes(300)), Write(350, 0, b"xy")], outcomes)
    assert wave.count == 5, "the second write is in the last job, with the end of the first"
    for index, request in enumerate(split(wave.take(sent, 0))[:answered]):
        wave.accept(index, framed(plc.answer(memoryview(request)[7:])))
    for told, wanted in zip(ends(outcomes, [wave]), (first, second), strict=True):
        if isinstance(told, str) and isinstance(wanted, str):
            assert wanted in told
            assert bool(wanted) is bool(told)
        else:
            assert told is wanted


# -- jobs and answers, as bytes written down by hand from the protocol's description

ANSWER = bytes.fromhex("03000018 02f080 32 03 0000 0007 0002 0003 00 00 05 03 ff 0a ff")


def test_one_job_of_bytes_and_a_bit() -> None:
    """Data of odd length are padded in the middle of a job, but not at its end."""
    items = [
        byte_item(201, 462, b"abc"),
        bit_item(201, 7, 5, True),
        byte_item(201, 0, b"z"),
    ]
    wanted = """0300004a 02f080 32 01 0000 1234 0026 0013 05 03
        12 0a 10 02 0003 00c9 84 000e70
        12 0a 10 01 0001 00c9 84 00003d
        12 0a 10 02 0001 00c9 84 000000
        00 04 0018 616263 00
        00 03 0001 01 00
        00 04 0008 7a"""
    assert write_request(0x1234, items).hex() == bytes.fromhex(wanted).hex()


def test_an_answer_has_a_code_for_each_item() -> None:
    assert parse_write_answer(memoryview(ANSWER), 3) == b"\xff\x0a\xff"


def changed(**at: int) -> memoryview:
    data = bytearray(ANSWER)
    for place, value in at.items():
        data[int(place[1:])] = value
    return memoryview(data)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (changed(_5=0x80), "ended the session"),
        (changed(_7=0x72), "does not speak S7"),
        (changed(_8=7), "ROSCTR 7"),
        (changed(_14=3), "says 3 of parameters"),
        (changed(_16=2), "says 2 of parameters and 2"),
        (changed(_14=1, _16=4), "not an answer to a write"),
        (changed(_19=4), "not an answer to a write"),
        (changed(_20=2), "3 return codes, but 3 items"),
        (memoryview(ANSWER[:18]), "too short"),
        (memoryview(frames.answer(3, b"", b"")), "not an answer to a write"),
        (memoryview(frames.answer(3, b"\x05", b"")), "not an answer to a write"),
        (memoryview(frames.answer(3, b"", b"\x05\x03\xff")), "not an answer to a write"),
    ],
)
def test_refuses_a_wrong_answer(frame: memoryview, text: str) -> None:
    with pytest.raises(ConnectorError, match=text):
        parse_write_answer(frame, 3)


def test_wrong_number_of_codes_is_refused() -> None:
    with pytest.raises(ConnectorError, match="3 return codes, but 2 items were written"):
        parse_write_answer(memoryview(ANSWER), 2)


@pytest.mark.parametrize("head", ["32 02 0000 0007 0000 0000", "32 03 0000 0007 0000 0000"])
def test_answer_may_refuse_the_whole_job(head: str) -> None:
    frame = bytes.fromhex("03000013 02f080" + head + "83 04")
    with pytest.raises(RefusedError, match=r"0x8304.*PUT/GET"):
        parse_write_answer(memoryview(frame), 3)


@example(frames.answer(3, b"", b""), 1)
@example(frames.answer(3, b"\x05", b""), 1)
@given(frames.answers(3, b"\x05\x03", b"\xff\x0a\xff") |
       st.binary(min_size=7, max_size=60) | st.builds(lambda cut, tail: (ANSWER[:cut] + tail).ljust(7, b"\0"),
       st.integers(0, 24), st.binary(max_size=20)), st.integers(1, 20))  # fmt: skip
def test_noise_gives_codes_or_a_connector_error(noise: bytes, count: int) -> None:
    with contextlib.suppress(ConnectorError):
        assert len(parse_write_answer(memoryview(noise), count)) == count
