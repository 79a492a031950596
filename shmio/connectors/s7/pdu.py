"""Encodes and parses S7 over ISO-on-TCP: frames, the set-up of a session, jobs and reads. No I/O.

A frame is ``TPKT | COTP | S7``: RFC 1006, section 6 (TPKT: version 3, length of the whole frame),
ISO 8073 class 0 (COTP: CR and CC open a connection, DT carries data), and the S7 job (ROSCTR 1). A
controller answers with Ack-Data (3), or with only an Ack (2) that has an error. S7 has no public
standard; names follow Wireshark's dissector.

The client of python-snap7 is not used. Its parsers are many times slower than one ``struct`` call
for each frame, and do not compare an answer with its request. Its encoders cannot write several
items in one job. It starts a new time-out for each piece that it receives, so a peer that sends
byte by byte never times out.

Every parser in this module raises only ConnectorError, for any input.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

from shmio.connectors.s7.explain import ITEM_OK, RefusedError, explain_error, is_known
from shmio.errors import ConnectorError

FRAME_OVERHEAD = 7  # TPKT 4, COTP DT 3
READ_OVERHEAD = 18  # bytes of a read answer's PDU: header 12, parameters 2, item header 4
READ_REQUEST_SIZE = 31
REFERENCE_OFFSET = 11  # offset of the PDU reference in a frame
MAX_BLOCK_SIZE = 65536  # size of a standard data block; also the number of references, if each read has one byte

WANTED_JOBS = 8  # docs/decisions/0049: the most that widespread clients ask for; real controllers grant 1 to 4
WANTED_PDU_SIZE = 960
MIN_PDU_SIZE = 64  # the smallest known controllers grant 240; a peer that grants less than 64 is not a controller
DEFAULT_TPDU_SIZE = 65531  # if the peer does not name a size: RFC 1006
_TPDU_SIZE_CODE = 0x0A  # 2 ** 10

_TPKT = struct.Struct(">BxH")
_HEADER = struct.Struct(">4x 3s BB2x2xHH")  # the common header of all S7 PDUs
_REQUEST = struct.Struct(">BBHHHH")  # protocol, ROSCTR, reserved, reference, length of parameters, length of data
_ADDRESS = struct.Struct(">BBBBHHI")  # 18, 10, S7-Any; type, count, block; area and offset in bits
_ITEM = struct.Struct(">BB BBH")
_USUAL = struct.Struct(">4x 5s2x2x HHH 4sH")  # an answer to a read; each constant part is one field
_USUAL_HEAD, _USUAL_ITEM = b"\x02\xf0\x80\x32\x03", b"\x04\x01\xff\x04"
HEADER_END = 19  # end of the headers of an answer to a job; its parameters follow
USERDATA_END = 17  # the same for userdata, whose header has no error code
_ITEM_END = 25
_VERSION = 3
_PROTOCOL = 0x32
_EOT = 0x80  # marks the last TPDU of a message
_COTP_DATA = b"\x02\xf0\x80"  # header length, DT, end of the message
_COTP_CR, _COTP_CC, _COTP_DR, _COTP_DT = 0xE0, 0xD0, 0x80, 0xF0
_ACK, _ACK_DATA = 2, 3
READ, WRITE, _SETUP = 0x04, 0x05, 0xF0
JOB, USERDATA = 1, 7
"""The values of ROSCTR (kind of PDU) in requests."""
DATA_BLOCK: Final = 0x84
TYPE_BIT, TYPE_BYTE = 1, 2
CONNECTION_TYPES: Final = {"pg": 1, "op": 2, "basic": 3}
_READ_ITEM = struct.Struct(">BBH")
_IN_BITS, _IN_BYTES = {0x04, 0x05}, {0x07, 0x09}
_BITS, _OCTETS = 0x04, 0x09  # transport sizes that mean: an item's length counts bits, or bytes


class Session(NamedTuple):
    """The session parameters that the controller granted."""

    pdu_size: int
    """Largest size of an S7 PDU in bytes, including its header."""
    jobs: int
    """Largest number of requests in flight."""


class ReadAnswer(NamedTuple):
    """The answer to a read of one item."""

    code: int
    """The item's return code. The answer has data only if the code is ITEM_OK."""
    data: memoryview


# -- frames ------------------------------------------------------------------------------------------------------------


def frame_length(inbox: memoryview, start: int, longest: int) -> int:
    """Return the length in bytes of the frame at ``start``, of which four bytes must have been received.

    Raises:
        ConnectorError: The bytes are not a frame, or the frame is longer than ``longest`` bytes.

    """
    version, length = _TPKT.unpack_from(inbox, start)
    if version != _VERSION:
        check_first(inbox, start)
    if not FRAME_OVERHEAD <= length <= longest:
        raise ConnectorError(f"the controller sent a frame of {length} bytes, expected {FRAME_OVERHEAD} to {longest}")
    return int(length)


def check_first(inbox: memoryview, start: int) -> None:
    """Raise ConnectorError unless the byte at ``start`` can begin a frame."""
    if inbox[start] != _VERSION:
        sent = bytes(inbox[start : start + 8])
        raise ConnectorError(f"the peer is not an S7 controller: it sent {sent!r}, which is not ISO-on-TCP")


def is_data(frame: memoryview) -> bool:
    """Return whether a frame holds a data TPDU of class 0."""
    return frame[4] == 2 and frame[5] == _COTP_DT


def is_last(frame: memoryview) -> bool:
    """Return whether a data TPDU is the last one of its message; the number beside the mark has no meaning."""
    return frame[6] >= _EOT


def is_whole(frame: memoryview) -> bool:
    """Return whether a data TPDU is a whole message, which has data, in the usual form."""
    return frame[6] == _EOT and len(frame) > FRAME_OVERHEAD


def data_frame(message: bytes) -> bytes:
    """Return a message as one frame."""
    return _frame(_COTP_DATA + message)


def is_push(frame: memoryview) -> bool:
    """Return whether a frame is userdata that no request asked for, such as an alarm or cyclic data.

    In their parameters, the high half of the byte with the group is 0; in requests it is 4, in answers 8.
    """
    return len(frame) > 22 and frame[8] == USERDATA and frame[7] == _PROTOCOL and is_data(frame) and frame[22] < 0x10


def request(reference: int, parameters: bytes, data: bytes = b"", rosctr: int = JOB) -> bytes:
    """Return a request as a frame; ``reference`` has 16 bits."""
    header = _REQUEST.pack(_PROTOCOL, rosctr, 0, reference, len(parameters), len(data))
    return _frame(_COTP_DATA + header + parameters + data)


def address(db_number: int, place: int, count: int, kind: int = TYPE_BYTE, area: int = DATA_BLOCK) -> bytes:
    """Return the encoded address of ``count`` bytes, or of one bit, in a data block or other area.

    ``place`` is the offset in bits; for a timer or counter, its number.
    """
    return _ADDRESS.pack(0x12, 10, 0x10, kind, count, db_number, area << 24 | place)


def _frame(payload: bytes) -> bytes:
    return _TPKT.pack(3, 4 + len(payload)) + payload


def reference_of(frame: memoryview) -> int:
    """Return the reference of the request to which an answer belongs, without checking the answer."""
    if len(frame) < USERDATA_END:
        _check_cotp(frame)
        raise ConnectorError(f"the controller's answer is too short ({len(frame)} bytes)")
    return frame[REFERENCE_OFFSET] << 8 | frame[REFERENCE_OFFSET + 1]


def check_envelope(frame: memoryview) -> tuple[int, int, int]:
    """Check the common header of all S7 PDUs.

    Return ROSCTR, and the lengths of parameters and data in bytes.
    """
    if len(frame) < USERDATA_END:
        _check_cotp(frame)
        raise ConnectorError(f"the controller's answer is too short ({len(frame)} bytes)")
    cotp, protocol, kind, parameter_length, data_length = _HEADER.unpack_from(frame)
    if cotp != _COTP_DATA:
        _check_cotp(frame)
        raise ConnectorError(f"the controller sent a data TPDU with the header {cotp.hex(' ')}, expected 02 f0 80")
    if protocol != _PROTOCOL:
        raise ConnectorError(f"the peer does not speak S7 (protocol 0x{protocol:02X}, expected 0x{_PROTOCOL:02X})")
    return kind, parameter_length, data_length


def check_answer(frame: memoryview) -> int:
    """Check the headers of an answer to a job, and return the length of its data in bytes.

    Raises:
        RefusedError: The header contains an error code.
        ConnectorError: The header is malformed.

    """
    kind, parameter_length, data_length = check_envelope(frame)
    if kind not in {_ACK, _ACK_DATA}:
        raise ConnectorError(f"the controller's reply is not an answer: ROSCTR {kind}")
    if len(frame) < HEADER_END:
        raise ConnectorError(f"the controller's answer is too short ({len(frame)} bytes)")
    error = frame[17] << 8 | frame[18]
    if HEADER_END + parameter_length + data_length != len(frame):
        raise ConnectorError(
            f"the controller's answer has {len(frame)} bytes, but its header says {parameter_length} of "
            f"parameters and {data_length} of data"
        )
    if error:
        raise RefusedError(explain_error(error))
    if kind != _ACK_DATA:
        raise ConnectorError("the controller's answer has no data")
    return data_length


def _check_cotp(frame: memoryview) -> None:
    kind = frame[5]
    if kind == _COTP_DR:
        raise ConnectorError("the controller ended the session")
    if kind != _COTP_DT:
        raise ConnectorError(f"the controller sent the unexpected COTP TPDU 0x{kind:02X}")


# -- session -----------------------------------------------------------------------------------------------------------


def connect_request(local_tsap: int, remote_tsap: int) -> bytes:
    """Return the COTP connection request to a CPU.

    On most CPUs, ``remote_tsap`` contains the connection type, the rack and the slot.
    """
    tsaps = struct.pack(">BBH BBH BBB", 0xC1, 2, local_tsap, 0xC2, 2, remote_tsap, 0xC0, 1, _TPDU_SIZE_CODE)
    head = struct.pack(">BBHHB", 6 + len(tsaps), _COTP_CR, 0, 1, 0)
    return _frame(head + tsaps)


def parse_connect_confirm(frame: memoryview) -> int:
    """Check the answer to a connection request, and return the largest TPDU size in bytes."""
    if frame[5] == _COTP_DR:
        raise ConnectorError("the controller refused the session")
    if frame[5] != _COTP_CC or len(frame) < 11:
        raise ConnectorError(
            f"the peer is not an S7 controller: it answered COTP TPDU 0x{frame[5]:02X} to the connection request"
        )
    if frame[4] != len(frame) - 5:
        raise ConnectorError(
            "the peer's connection confirm has the wrong length; check that host and port are those of an S7 controller"
        )
    position = 11
    while position + 2 < len(frame):
        code, length = frame[position], frame[position + 1]
        if code == 0xC0 and length == 1:
            exponent = frame[position + 2]
            if not 7 <= exponent <= 16:
                raise ConnectorError(f"the controller's TPDU size code {exponent} is invalid")
            return int(min(1 << exponent, DEFAULT_TPDU_SIZE))
        position += 2 + length
    return DEFAULT_TPDU_SIZE


def setup_request(reference: int, jobs: int, pdu_size: int) -> bytes:
    """Return the request "setup communication", which proposes a number of parallel jobs and a PDU size in bytes."""
    return request(reference, struct.pack(">BBHHH", _SETUP, 0, jobs, jobs, pdu_size))


def parse_setup_answer(frame: memoryview, reference: int, asked: Session) -> Session:
    """Return the session that the controller grants. No parameter is above that of ``asked``."""
    data_length = check_answer(frame)
    if (answered := reference_of(frame)) != reference:
        raise ConnectorError(f"the controller answered a request that was not sent (reference {answered})")
    if len(frame) != HEADER_END + 8 or data_length or frame[HEADER_END] != _SETUP:
        raise ConnectorError("the controller's reply is not an answer to 'setup communication'")
    calling, called, pdu_size = struct.unpack_from(">HHH", frame, HEADER_END + 2)
    if pdu_size < MIN_PDU_SIZE:
        raise ConnectorError(f"the controller grants PDUs of only {pdu_size} bytes")
    return Session(min(pdu_size, asked.pdu_size), max(1, min(calling, called, asked.jobs)))


# -- reading -----------------------------------------------------------------------------------------------------------


def read_request(reference: int, items: Sequence[bytes]) -> bytes:
    """Return a request that reads the items at these addresses."""
    return request(reference, bytes((READ, len(items))) + b"".join(items))


def parse_read_answer(frame: memoryview) -> ReadAnswer:
    """Parse the answer to a read of one item of bytes; ``data`` is a view of the frame.

    Raises:
        RefusedError: The controller refused the job.
        ConnectorError: The answer is malformed.

    """
    if len(frame) >= _ITEM_END:
        # Nearly all answers have this form. Parse any other field by field, for a precise error.
        head, parameter_length, data_length, error, item, bits = _USUAL.unpack_from(frame)
        if (
            head == _USUAL_HEAD
            and item == _USUAL_ITEM
            and parameter_length == 2
            and not error
            and bits == (data_length - 4) * 8
            and data_length == len(frame) - 21
        ):
            return ReadAnswer(ITEM_OK, frame[_ITEM_END:])
    data_length = check_answer(frame)
    if len(frame) < HEADER_END + 3:
        raise ConnectorError(f"the controller's answer is too short for a read ({len(frame)} bytes)")
    if frame[HEADER_END] != READ or frame[HEADER_END + 1] != 1 or data_length != len(frame) - HEADER_END - 2:
        raise ConnectorError("the controller's reply is not an answer to a read of one item")
    code = frame[HEADER_END + 2]
    if code != ITEM_OK:
        return ReadAnswer(code, frame[:0])
    if len(frame) < _ITEM_END:
        raise ConnectorError(f"the controller's answer is too short for data ({len(frame)} bytes)")
    _, _, _, transport, length = _ITEM.unpack_from(frame, HEADER_END)
    if transport == _BITS and not length & 7:
        length >>= 3
    elif transport != _OCTETS:
        raise ConnectorError(
            f"the controller sent data of transport size 0x{transport:02X}, length {length}; bytes were requested"
        )
    # Some servers pad data of odd length, although only items before the last one need padding.
    if len(frame) - _ITEM_END not in {length, length + (length & 1)}:
        raise ConnectorError(
            f"the controller's answer has {len(frame) - _ITEM_END} bytes of data, but its header says {length}"
        )
    return ReadAnswer(code, frame[_ITEM_END : _ITEM_END + length])


def parse_items(frame: memoryview, sizes: Sequence[int]) -> list[ReadAnswer]:
    """Parse the answer to a read of several items of ``sizes`` bytes; data are views of the frame.

    Raises:
        RefusedError: The controller refused the job.
        ConnectorError: The answer is malformed.

    """
    check_answer(frame)
    if len(frame) < HEADER_END + 2 or frame[HEADER_END] != READ or frame[HEADER_END + 1] != len(sizes):
        raise ConnectorError(f"the controller's reply is not an answer to a read of {len(sizes)} items")
    answers: list[ReadAnswer] = []
    end = HEADER_END + 2
    for size in sizes:
        at = end + ((end - HEADER_END) & 1 if answers else 0)  # items begin at even places
        if at + 4 > len(frame):
            raise ConnectorError(f"the controller's answer ends before item {len(answers) + 1} of {len(sizes)}")
        code, transport, length = _READ_ITEM.unpack_from(frame, at)
        end = at + 4
        if code != ITEM_OK:
            if length and not is_known(code):  # probably data, after an item that was too short
                raise ConnectorError(
                    f"the controller's answer has an inconsistent item with return code 0x{code:02X} and length "
                    f"{length}"
                )
            answers.append(ReadAnswer(code, frame[:0]))
            continue
        if transport in _IN_BITS and not length & 7:
            length >>= 3
        elif transport not in _IN_BYTES:
            raise ConnectorError(
                f"the controller sent data of transport size 0x{transport:02X}, length {length}; bytes were requested"
            )
        if length != size or end + size > len(frame):
            raise ConnectorError(f"the controller's answer has {length} bytes of data, but {size} were requested")
        answers.append(ReadAnswer(code, frame[end : end + size]))
        end += size
    if len(frame) - end not in {0, 1}:  # some servers pad the last item too
        raise ConnectorError(f"the controller's answer has {len(frame)} bytes, but only {end} belong to its items")
    return answers
