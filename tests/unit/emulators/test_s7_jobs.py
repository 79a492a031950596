"""Answers of the emulated controller, byte by byte, and its answers to noise."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from snap7.datatypes import S7Area

from shmio.emulators.s7 import Fault, Jobs, Memory, ServerOptions

BIT, BYTE, CHAR, WORD, INT, DWORD, DINT, REAL = range(1, 9)
DB = 0x84


def item(kind: int, count: int, start: int, *, bit: int = 0, number: int = 1, area: int = DB) -> bytes:
    return struct.pack(">BBBBHHI", 0x12, 10, 0x10, kind, count, number, area << 24 | start * 8 + bit)


def job(parameters: bytes, data: bytes = b"") -> memoryview:
    return memoryview(struct.pack(">BBHHHH", 0x32, 1, 0, 0x1234, len(parameters), len(data)) + parameters + data)


def read(*items: bytes) -> memoryview:
    return job(bytes((4, len(items))) + b"".join(items))


def write(*pairs: tuple[bytes, int, bytes]) -> memoryview:
    """Return a job that writes; each of ``pairs`` is an item, a transport size and a value."""
    data = b""
    for _, transport, value in pairs:
        length = len(value) * 8 if transport in {4, 5} else len(value)
        data += b"\0" * (len(data) & 1) + struct.pack(">BBH", 0, transport, length) + value
    return job(bytes((5, len(pairs))) + b"".join(place for place, _, _ in pairs), data)


SETUP = job(struct.pack(">BxHHH", 0xF0, 20, 20, 4000))


@pytest.fixture
def block() -> bytearray:
    return bytearray(range(200))


@pytest.fixture
def jobs(block: bytearray) -> Jobs:
    jobs = Jobs(Memory({(S7Area.DB, 1): block, (S7Area.MK, 0): bytearray(b"flags")}), ServerOptions())
    assert jobs.answer(SETUP) == bytes.fromhex("32 03 0000 1234 0008 0000 0000 f0 00 0014 0008 03c0")
    return jobs


def payload(answer: bytes | None) -> bytes:
    """Return the data of an answer without an error."""
    assert answer is not None
    assert answer[:2] == b"\x32\x03"
    assert answer[4:6] == b"\x12\x34"
    parameters, data, error = struct.unpack_from(">HHH", answer, 6)
    assert error == 0
    assert len(answer) == 12 + parameters + data
    return answer[12 + parameters :]


def error(answer: bytes | None) -> int:
    assert answer is not None
    assert len(answer) == 12
    return int.from_bytes(answer[10:], "big")


def test_grants_no_more_than_asked() -> None:
    jobs = Jobs(Memory({}), ServerOptions())
    answer = jobs.answer(job(struct.pack(">BxHHH", 0xF0, 1, 2, 240)))
    assert answer is not None
    assert answer[14:] == struct.pack(">HHH", 1, 2, 240)


@pytest.mark.parametrize(
    ("kind", "count", "head"),
    [
        (BYTE, 8, "ff 04 0040"),
        (CHAR, 8, "ff 09 0008"),
        (WORD, 4, "ff 04 0040"),
        (INT, 4, "ff 05 0040"),
        (DWORD, 2, "ff 04 0040"),
        (DINT, 2, "ff 05 0040"),
        (REAL, 2, "ff 07 0008"),
    ],
)
def test_reads_each_type(jobs: Jobs, block: bytearray, kind: int, count: int, head: str) -> None:
    assert payload(jobs.answer(read(item(kind, count, 7)))) == bytes.fromhex(head) + block[7:15]


def test_reads_a_bit(jobs: Jobs) -> None:
    assert payload(jobs.answer(read(item(BIT, 1, 5, bit=2)))) == bytes.fromhex("ff 03 0001 01")
    assert payload(jobs.answer(read(item(BIT, 1, 5, bit=1)))) == bytes.fromhex("ff 03 0001 00")


def test_each_of_several_items_has_its_own_result(jobs: Jobs) -> None:
    answer = jobs.answer(
        read(
            item(BYTE, 3, 0),
            item(BYTE, 1, 0, number=2),
            item(BYTE, 2, 199),
            item(BYTE, 5, 0, number=0, area=0x83),
            item(0x1D, 1, 0),
        )
    )
    wanted = "ff 04 0018 000102 00  0a 00 0000  05 00 0000  ff 04 0028 666c616773 00  06 00 0000"
    assert payload(answer) == bytes.fromhex(wanted)


def test_reads_to_the_last_byte_and_not_past_it(jobs: Jobs) -> None:
    assert payload(jobs.answer(read(item(BYTE, 1, 199)))) == bytes.fromhex("ff 04 0008 c7")
    for wrong in (item(BYTE, 2, 199), item(BYTE, 1, 200), item(WORD, 65535, 0), item(BYTE, 1, (1 << 21) - 1)):
        assert payload(jobs.answer(read(wrong))) == bytes.fromhex("05 00 0000")


def test_answer_must_fit_the_pdu(block: bytearray) -> None:
    jobs = Jobs(Memory({(S7Area.DB, 1): block}), ServerOptions())
    assert error(jobs.answer(read(item(BYTE, 1, 0)))) == 0x8500  # before set-up
    jobs.answer(job(struct.pack(">BxHHH", 0xF0, 1, 1, 100)))
    assert len(payload(jobs.answer(read(item(BYTE, 82, 0))))) == 86
    assert error(jobs.answer(read(item(BYTE, 83, 0)))) == 0x8500
    assert error(jobs.answer(read(item(BYTE, 40, 0), item(BYTE, 39, 0)))) == 0x8500


def test_a_job_must_fit_the_pdu_too(block: bytearray) -> None:
    before = bytes(block)
    jobs = Jobs(Memory({(S7Area.DB, 1): block}), ServerOptions())
    assert error(jobs.answer(write((item(BYTE, 1, 0), 4, b"x")))) == 0x8500  # before set-up
    jobs.answer(job(struct.pack(">BxHHH", 0xF0, 1, 1, 100)))
    assert error(jobs.answer(write((item(BYTE, 73, 0), 4, bytes(73))))) == 0x8500
    assert block == before
    assert payload(jobs.answer(write((item(BYTE, 72, 0), 4, bytes(72))))) == b"\xff"
    assert block == bytes(72) + before[72:]


@pytest.mark.parametrize("size", [0, 65535])
def test_any_pdu_size_may_be_requested(block: bytearray, size: int) -> None:
    jobs = Jobs(Memory({(S7Area.DB, 1): block}), ServerOptions())
    answer = jobs.answer(job(struct.pack(">BxHHH", 0xF0, 0, 65535, size)))
    assert answer is not None
    assert answer[14:] == struct.pack(">HHH", 0, 8, min(size, 960))
    assert len(jobs.answer(read(item(BYTE, 1, 0))) or b"") == (19 if size else 12)


def test_writes_each_type(jobs: Jobs, block: bytearray) -> None:
    before = bytes(block)
    for kind, transport in ((BYTE, 4), (CHAR, 9), (WORD, 4), (INT, 5), (DWORD, 4), (DINT, 5), (REAL, 7)):
        width = (1, 1, 2, 2, 4, 4, 4)[kind - 2]
        assert payload(jobs.answer(write((item(kind, 4 // width, 9), transport, b"abcd")))) == b"\xff"
        assert block == before[:9] + b"abcd" + before[13:]
        block[:] = before


@pytest.mark.parametrize("value", [0, 1])
@pytest.mark.parametrize("bit", range(8))
def test_writes_a_bit_and_only_that(jobs: Jobs, block: bytearray, bit: int, value: int) -> None:
    before = bytes(block)
    assert payload(jobs.answer(write((item(BIT, 1, 50, bit=bit), 3, bytes((value,)))))) == b"\xff"
    assert block[50] == (before[50] & ~(1 << bit)) | value << bit
    assert block[:50] + block[51:] == before[:50] + before[51:]


def test_writes_all_items(jobs: Jobs, block: bytearray) -> None:
    answer = jobs.answer(
        write(
            (item(BYTE, 3, 0), 4, b"abc"),
            (item(BIT, 1, 10, bit=7), 3, b"\x01"),
            (item(BYTE, 2, 199), 4, b"xy"),
            (item(BYTE, 1, 0, number=9), 4, b"z"),
            (item(WORD, 1, 20), 4, b"\x01\x02\x03"),
            (item(WORD, 1, 30), 4, b"WO"),
        )
    )
    assert payload(answer) == bytes((0xFF, 0xFF, 0x05, 0x0A, 0x07, 0xFF))
    expected = bytearray(range(200))
    expected[0:3], expected[10], expected[30:32] = b"abc", 10 | 0x80, b"WO"
    assert block == expected


@pytest.mark.parametrize(
    "broken",
    [
        job(b"\x04\x00"),
        job(b"\x04\x02" + item(BYTE, 1, 0)),
        job(b"\x04\x01" + item(BYTE, 1, 0)[:-1]),
        job(b"\x05\x01" + item(BYTE, 1, 0)),
        job(b"\x05\x01" + item(BYTE, 4, 0), b"\x00\x04\x00\x20abc"),
        job(b"\x05\x02" + item(BYTE, 1, 0) * 2, b"\x00\x04\x00\x08a\x00"),
        job(b"\xf0\x00\x00\x01"),
    ],
)
def test_malformed_jobs_are_refused_and_store_nothing(jobs: Jobs, block: bytearray, broken: memoryview) -> None:
    assert error(jobs.answer(broken)) == 0x8500
    assert block == bytes(range(200))


@pytest.mark.parametrize("syntax", [b"\x11\x0a\x10", b"\x12\x0b\x10", b"\x12\x0a\xb2"])
def test_other_address_forms_are_not_known(jobs: Jobs, syntax: bytes) -> None:
    assert payload(jobs.answer(read(syntax + item(BYTE, 1, 0)[3:]))) == bytes.fromhex("06 00 0000")


def test_jobs_of_other_functions_are_not_handled(jobs: Jobs) -> None:
    assert jobs.answer(job(b"\x28\x00")) is None
    assert jobs.answer(memoryview(bytes.fromhex("32 07 0000 0001 0004 0000 04 01 12 00"))) is None
    assert jobs.answer(memoryview(b"\x72" + bytes(SETUP)[1:])) is None


# -- options -----------------------------------------------------------------------------------------------------------


def jobs_of(block: bytearray, options: ServerOptions) -> Jobs:
    jobs = Jobs(Memory({(S7Area.DB, 1): block, (S7Area.MK, 0): bytearray(b"flags")}), options)
    jobs.answer(SETUP)
    return jobs


def test_grants_the_configured_size_and_jobs(block: bytearray) -> None:
    jobs = Jobs(Memory({}), ServerOptions(max_pdu_size=480, max_jobs=19))
    answer = jobs.answer(SETUP)
    assert answer is not None
    assert answer[14:] == struct.pack(">HHH", 20, 19, 480)
    assert len(payload(jobs_of(block, ServerOptions(max_pdu_size=100)).answer(read(item(BYTE, 82, 0))))) == 86
    assert error(jobs_of(block, ServerOptions(max_pdu_size=100)).answer(read(item(BYTE, 83, 0)))) == 0x8500


@pytest.mark.parametrize("wrong", [{"max_pdu_size": 99}, {"max_pdu_size": 961}, {"max_jobs": 0}, {"max_jobs": 33}])
def test_refuses_traits_out_of_bounds(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="a PDU has 100 to 960 bytes"):
        ServerOptions(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("fault", "reading", "writing"),
    [
        (Fault.PROTECTED, "03 00 0000", "03"),
        (Fault.WRITE_PROTECTED, "ff 04 0008 05", "03"),
        (Fault.OPTIMIZED, "05 00 0000", "05"),
    ],
)
def test_faults_of_items(block: bytearray, fault: Fault, reading: str, writing: str) -> None:
    jobs = jobs_of(block, ServerOptions(fault=fault))
    assert payload(jobs.answer(read(item(BYTE, 1, 5)))) == bytes.fromhex(reading)
    assert payload(jobs.answer(write((item(BYTE, 1, 5), 4, b"x")))) == bytes.fromhex(writing)
    assert payload(jobs.answer(write((item(BIT, 1, 5, bit=1), 3, b"\1")))) == bytes.fromhex(writing)
    assert block == bytes(range(200))


def test_put_get_off_refuses_every_job_but_the_set_up(block: bytearray) -> None:
    jobs = jobs_of(block, ServerOptions(fault=Fault.PUT_GET_OFF))
    assert error(jobs.answer(read(item(BYTE, 1, 5)))) == 0x8104
    assert error(jobs.answer(write((item(BYTE, 1, 5), 4, b"x")))) == 0x8104
    assert block == bytes(range(200))


def test_only_data_blocks_are_optimized(block: bytearray) -> None:
    jobs = jobs_of(block, ServerOptions(fault=Fault.OPTIMIZED))
    assert payload(jobs.answer(read(item(BYTE, 5, 0, number=0, area=0x83)))) == bytes.fromhex("ff 04 0028") + b"flags"


def test_block_shorter_than_its_memory(block: bytearray) -> None:
    jobs = jobs_of(block, ServerOptions(block_size=100))
    assert payload(jobs.answer(read(item(BYTE, 1, 99)))) == bytes.fromhex("ff 04 0008 63")
    assert payload(jobs.answer(read(item(BYTE, 2, 99)))) == bytes.fromhex("05 00 0000")
    assert payload(jobs.answer(write((item(BYTE, 1, 100), 4, b"x"), (item(BYTE, 1, 99), 4, b"x")))) == b"\x05\xff"
    assert block[99:102] == bytes((ord("x"), 100, 101))


MANY = write((item(BYTE, 3, 0), 4, b"abc"), (item(BIT, 1, 9, bit=3), 3, b"\1"), (item(BYTE, 2, 98), 4, b"xy"))
VALID = [bytes(frame) for frame in (SETUP, read(item(BYTE, 9, 3)), write((item(BYTE, 3, 0), 4, b"abc")), MANY)]


@given(
    st.binary(min_size=10, max_size=120)
    | st.builds(
        lambda whole, at, byte, tail: whole[:at] + bytes((byte,)) + whole[at + 1 :] + tail,
        st.sampled_from(VALID),
        st.integers(0, 90),
        st.integers(0, 255),
        st.binary(max_size=4),
    ),
    st.builds(ServerOptions, fault=st.none() | st.sampled_from(Fault), block_size=st.none() | st.integers(0, 200)),
)
def test_noise_gives_an_answer_or_none(noise: bytes, options: ServerOptions) -> None:
    block = bytearray(100)
    jobs = Jobs(Memory({(S7Area.DB, 1): block}), options)
    jobs.answer(SETUP)
    answer = jobs.answer(memoryview(noise))
    assert answer is None or 12 <= len(answer) <= 960
    assert len(block) == 100
