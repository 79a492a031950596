"""What the emulated controller answers, byte by byte, and to noise."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from snap7.datatypes import S7Area

from shmio.emulators.s7_jobs import Fault, Jobs, Memory, Traits

BIT, BYTE, CHAR, WORD, INT, DWORD, DINT, REAL = range(1, 9)
DB = 0x84


def item(kind: int, count: int, start: int, *, bit: int = 0, number: int = 1, area: int = DB) -> bytes:
    return struct.pack(">BBBBHHI", 0x12, 10, 0x10, kind, count, number, area << 24 | start * 8 + bit)


def job(parameters: bytes, data: bytes = b"") -> memoryview:
    return memoryview(struct.pack(">BBHHHH", 0x32, 1, 0, 0x1234, len(parameters), len(data)) + parameters + data)


def read(*items: bytes) -> memoryview:
    return job(bytes((4, len(items))) + b"".join(items))


def write(*pairs: tuple[bytes, int, bytes]) -> memoryview:
    """Pairs of item, transport size, value."""
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
    jobs = Jobs(Memory({(S7Area.DB, 1): block, (S7Area.MK, 0): bytearray(b"flags")}), Traits())
    assert jobs.answer(SETUP) == bytes.fromhex("32 03 0000 1234 0008 0000 0000 f0 00 0008 0008 03c0")
    return jobs


def payload(answer: bytes | None) -> bytes:
    """What follows the parameters of a good answer."""
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
    jobs = Jobs(Memory({}), Traits())
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


def test_reads_several_items_each_with_its_own_fate(jobs: Jobs) -> None:
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
    jobs = Jobs(Memory({(S7Area.DB, 1): block}), Traits())
    assert error(jobs.answer(read(item(BYTE, 1, 0)))) == 0x8500  # before set-up
    jobs.answer(job(struct.pack(">BxHHH", 0xF0, 1, 1, 100)))
    assert len(payload(jobs.answer(read(item(BYTE, 82, 0))))) == 86
    assert error(jobs.answer(read(item(BYTE, 83, 0)))) == 0x8500
    assert error(jobs.answer(read(item(BYTE, 40, 0), item(BYTE, 39, 0)))) == 0x8500


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


def test_leaves_other_functions_to_others(jobs: Jobs) -> None:
    assert jobs.answer(job(b"\x28\x00")) is None
    assert jobs.answer(memoryview(bytes.fromhex("32 07 0000 0001 0004 0000 04 01 12 00"))) is None


VALID = [bytes(frame) for frame in (SETUP, read(item(BYTE, 9, 3)), write((item(BYTE, 3, 0), 4, b"abc")))]


@given(
    st.binary(min_size=10, max_size=120)
    | st.builds(
        lambda whole, at, byte, tail: whole[:at] + bytes((byte,)) + whole[at + 1 :] + tail,
        st.sampled_from(VALID),
        st.integers(0, 40),
        st.integers(0, 255),
        st.binary(max_size=4),
    )
)
def test_noise_gives_an_answer_or_none(noise: bytes) -> None:
    block = bytearray(100)
    jobs = Jobs(Memory({(S7Area.DB, 1): block}), Traits())
    jobs.answer(SETUP)
    answer = jobs.answer(memoryview(noise))
    assert answer is None or 12 <= len(answer) <= 960
    assert len(block) == 100
