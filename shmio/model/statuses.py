"""The status area of an image: a status code and a source time for each register.

An image of a layout with :attr:`Layout.status_offset` ends in this area, so that rings, recordings
and replays carry it like all other bytes. It has two arrays in the order of the layout's registers,
in the byte order of the layout:

- the OPC UA status codes (u32, OPC 10000-4, section 7.39), or those of :class:`Finding`, padded to 8 bytes;
- the source times (i64, ns since 1970 UTC; 0: unknown, so that the time of the frame applies).
"""

from __future__ import annotations

import enum
import struct
from bisect import bisect_right
from collections.abc import Iterable
from typing import Final, NamedTuple

from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import Buffer, RegisterCodec, Value, codec
from shmio.model.values import Quality

_CODE_BYTES: Final = 4
_TIME_BYTES: Final = 8
_QUALITIES: Final = (Quality.GOOD, Quality.UNCERTAIN, Quality.BAD, Quality.BAD)

GOOD: Final = 0x00000000
UNCERTAIN: Final = 0x40000000
UNCERTAIN_LAST_USABLE_VALUE: Final = 0x40900000
BAD: Final = 0x80000000
BAD_COMMUNICATION_ERROR: Final = 0x80050000
BAD_RESOURCE_UNAVAILABLE: Final = 0x80040000
BAD_TIMEOUT: Final = 0x800A0000
BAD_NO_COMMUNICATION: Final = 0x80310000
BAD_NOT_SUPPORTED: Final = 0x803D0000
BAD_WAITING_FOR_INITIAL_DATA: Final = 0x80320000
BAD_NODE_ID_UNKNOWN: Final = 0x80340000
BAD_OUT_OF_RANGE: Final = 0x803C0000
BAD_USER_ACCESS_DENIED: Final = 0x801F0000
BAD_TYPE_MISMATCH: Final = 0x80740000
BAD_DECODING_ERROR: Final = 0x80070000
BAD_INDEX_RANGE_NO_DATA: Final = 0x80370000
BAD_NOT_FOUND: Final = 0x803E0000
BAD_CONFIGURATION_ERROR: Final = 0x80890000
BAD_NOT_CONNECTED: Final = 0x808A0000
BAD_DEVICE_FAILURE: Final = 0x808B0000
BAD_NO_DATA: Final = 0x809B0000

_FROM_OPC: Final = {  # by quality and sub-status, QQSSSS: OPC 10000-8, table A.61
    0: BAD, 1: BAD_CONFIGURATION_ERROR, 2: BAD_NOT_CONNECTED, 3: BAD_DEVICE_FAILURE, 4: 0x808C0000, 5: 0x808D0000,
    6: BAD_NO_COMMUNICATION, 7: 0x808D0000, 8: BAD_WAITING_FOR_INITIAL_DATA, 16: UNCERTAIN,
    17: UNCERTAIN_LAST_USABLE_VALUE, 20: 0x40930000, 21: 0x40940000, 22: 0x40950000, 48: GOOD, 54: 0x00960000,
}  # fmt: skip
_OPC_QUALITIES: Final = range(256)


class Finding(enum.IntEnum):
    """What a source itself found wrong with a register's value, as a status code with room for a detail.

    The number is the highest byte of the code: the severity, bit 28, which OPC UA reserves, and a
    number. The other three bytes have the detail.
    """

    CHARACTER = 0x91
    """The register's encoding lacks a character of the text: its place (1 byte), its UTF-16 unit (2 bytes)."""
    UNKNOWN_QUALITY = 0x51
    """The device states a quality that has no meaning: the number, at most 0xFFFFFF."""
    UNREADABLE_TIME = 0x52
    """The device states a time that cannot be read, so the time of the receipt stands for it."""

    def code(self, detail: int = 0) -> int:
        """Return a status code with this finding and its detail, as far as three bytes can hold it."""
        return self << 24 | min(max(detail, 0), 0xFFFFFF)


UNREADABLE_TIME: Final = Finding.UNREADABLE_TIME.code()
_STANDARD: Final = {
    Finding.CHARACTER: BAD_OUT_OF_RANGE,
    Finding.UNKNOWN_QUALITY: UNCERTAIN,
    Finding.UNREADABLE_TIME: UNCERTAIN,
}


def character_missing(place: int, character: str) -> int:
    """Return the code for a text with a character that the register's encoding lacks; ``place`` counts from 1."""
    unit = min(ord(character), 0xFFFF)  # U+FFFF is no character: it stands for those beyond
    return Finding.CHARACTER.code(min(place, 0xFF) << 16 | unit)


def standard(code: int) -> int:
    """Return the status code of the OPC UA standard for a code, which may be a finding of the source itself."""
    return _STANDARD[Finding(code >> 24)] if code >> 24 in _STANDARD else code


def _found(code: int) -> str:
    """Return the reason for a finding of the source; empty if the code is a standard one."""
    detail = code & 0xFFFFFF
    match code >> 24:
        case Finding.CHARACTER:
            character = "a character" if detail & 0xFFFF == 0xFFFF else repr(chr(detail & 0xFFFF))
            return (
                f"the register's encoding cannot hold {character}, which is character {detail >> 16} of the text; "
                "set the source's key encoding to one that can"
            )
        case Finding.UNKNOWN_QUALITY:
            return f"the device states the quality {detail}, which has no meaning"
        case Finding.UNREADABLE_TIME:
            return "the device states a time that cannot be read, so the value has the time of its receipt"
    return ""


_NAMED: Final = 0xFFFF0000
"""The bits of a code that determine its name; the other half of the code has flags."""
_NAMES: Final = {  # those codes of OPC 10000-6, annex A.2, that data sources use
    0x00000000: "Good",
    0x002D0000: "GoodSubscriptionTransferred",
    0x002E0000: "GoodCompletesAsynchronously",
    0x002F0000: "GoodOverload",
    0x00300000: "GoodClamped",
    0x00960000: "GoodLocalOverride",
    0x00A50000: "GoodNoData",
    0x00A90000: "GoodCallAgain",
    0x00DC0000: "GoodEdited",
    0x00E00000: "GoodDependentValueChanged",
    0x04010000: "GoodCascadeInitializationAcknowledged",
    0x04080000: "GoodInitiateFaultState",
    0x40000000: "Uncertain",
    0x406C0000: "UncertainReferenceOutOfServer",
    0x408F0000: "UncertainNoCommunicationLastUsableValue",
    0x40900000: "UncertainLastUsableValue",
    0x40910000: "UncertainSubstituteValue",
    0x40920000: "UncertainInitialValue",
    0x40930000: "UncertainSensorNotAccurate",
    0x40940000: "UncertainEngineeringUnitsExceeded",
    0x40950000: "UncertainSubNormal",
    0x40A40000: "UncertainDataSubNormal",
    0x40C00000: "UncertainNotAllNodesAvailable",
    0x40DE0000: "UncertainDominantValueChanged",
    0x40E20000: "UncertainDependentValueChanged",
    0x42090000: "UncertainSimulatedValue",
    0x420A0000: "UncertainSensorCalibration",
    0x80000000: "Bad",
    0x80010000: "BadUnexpectedError",
    0x80020000: "BadInternalError",
    0x80030000: "BadOutOfMemory",
    0x80040000: "BadResourceUnavailable",
    0x80050000: "BadCommunicationError",
    0x80060000: "BadEncodingError",
    0x80070000: "BadDecodingError",
    0x80080000: "BadEncodingLimitsExceeded",
    0x80090000: "BadUnknownResponse",
    0x800A0000: "BadTimeout",
    0x800B0000: "BadServiceUnsupported",
    0x800C0000: "BadShutdown",
    0x800D0000: "BadServerNotConnected",
    0x800E0000: "BadServerHalted",
    0x800F0000: "BadNothingToDo",
    0x80100000: "BadTooManyOperations",
    0x80110000: "BadDataTypeIdUnknown",
    0x80120000: "BadCertificateInvalid",
    0x80130000: "BadSecurityChecksFailed",
    0x80140000: "BadCertificateTimeInvalid",
    0x80150000: "BadCertificateIssuerTimeInvalid",
    0x80160000: "BadCertificateHostNameInvalid",
    0x80170000: "BadCertificateUriInvalid",
    0x80180000: "BadCertificateUseNotAllowed",
    0x80190000: "BadCertificateIssuerUseNotAllowed",
    0x801A0000: "BadCertificateUntrusted",
    0x801B0000: "BadCertificateRevocationUnknown",
    0x801C0000: "BadCertificateIssuerRevocationUnknown",
    0x801D0000: "BadCertificateRevoked",
    0x801E0000: "BadCertificateIssuerRevoked",
    0x801F0000: "BadUserAccessDenied",
    0x80200000: "BadIdentityTokenInvalid",
    0x80210000: "BadIdentityTokenRejected",
    0x80220000: "BadSecureChannelIdInvalid",
    0x80240000: "BadNonceInvalid",
    0x80250000: "BadSessionIdInvalid",
    0x80260000: "BadSessionClosed",
    0x80270000: "BadSessionNotActivated",
    0x80280000: "BadSubscriptionIdInvalid",
    0x80310000: "BadNoCommunication",
    0x80320000: "BadWaitingForInitialData",
    0x80330000: "BadNodeIdInvalid",
    0x80340000: "BadNodeIdUnknown",
    0x80350000: "BadAttributeIdInvalid",
    0x80360000: "BadIndexRangeInvalid",
    0x80370000: "BadIndexRangeNoData",
    0x80380000: "BadDataEncodingInvalid",
    0x80390000: "BadDataEncodingUnsupported",
    0x803A0000: "BadNotReadable",
    0x803B0000: "BadNotWritable",
    0x803C0000: "BadOutOfRange",
    0x803D0000: "BadNotSupported",
    0x803E0000: "BadNotFound",
    0x803F0000: "BadObjectDeleted",
    0x80400000: "BadNotImplemented",
    0x80410000: "BadMonitoringModeInvalid",
    0x80420000: "BadMonitoredItemIdInvalid",
    0x80430000: "BadMonitoredItemFilterInvalid",
    0x80440000: "BadMonitoredItemFilterUnsupported",
    0x80450000: "BadFilterNotAllowed",
    0x80460000: "BadStructureMissing",
    0x80470000: "BadEventFilterInvalid",
    0x80540000: "BadSecurityModeRejected",
    0x80550000: "BadSecurityPolicyRejected",
    0x80560000: "BadTooManySessions",
    0x80570000: "BadUserSignatureInvalid",
    0x805B0000: "BadParentNodeIdInvalid",
    0x80600000: "BadBrowseNameInvalid",
    0x80730000: "BadWriteNotSupported",
    0x80740000: "BadTypeMismatch",
    0x80750000: "BadMethodInvalid",
    0x80760000: "BadArgumentsMissing",
    0x80770000: "BadTooManySubscriptions",
    0x80780000: "BadTooManyPublishRequests",
    0x80790000: "BadNoSubscription",
    0x807D0000: "BadTcpServerTooBusy",
    0x807E0000: "BadTcpMessageTypeInvalid",
    0x80800000: "BadTcpMessageTooLarge",
    0x80820000: "BadTcpInternalError",
    0x80830000: "BadTcpEndpointUrlInvalid",
    0x80860000: "BadSecureChannelClosed",
    0x80890000: "BadConfigurationError",
    0x808A0000: "BadNotConnected",
    0x808B0000: "BadDeviceFailure",
    0x808C0000: "BadSensorFailure",
    0x808D0000: "BadOutOfService",
    0x808E0000: "BadDeadbandFilterInvalid",
    0x809B0000: "BadNoData",
    0x809D0000: "BadDataLost",
    0x809E0000: "BadDataUnavailable",
    0x80A00000: "BadNoEntryExists",
    0x80AB0000: "BadInvalidArgument",
    0x80AC0000: "BadConnectionRejected",
    0x80AD0000: "BadDisconnect",
    0x80AE0000: "BadConnectionClosed",
    0x80AF0000: "BadInvalidState",
    0x80B00000: "BadEndOfStream",
    0x80B10000: "BadNoDataAvailable",
    0x80B80000: "BadRequestTooLarge",
    0x80B90000: "BadResponseTooLarge",
    0x80BF0000: "BadStateNotActive",
    0x80DB0000: "BadTooManyMonitoredItems",
    0x80E10000: "BadDominantValueChanged",
    0x80E30000: "BadDependentValueChanged",
    0x80E90000: "BadLocked",
    0x810D0000: "BadCertificateChainIncomplete",
    0x810E0000: "BadLicenseExpired",
    0x810F0000: "BadLicenseLimitsExceeded",
    0x81100000: "BadLicenseNotAvailable",
}


_OF_EITHER: Final = frozenset({
    BAD_DECODING_ERROR, BAD_INDEX_RANGE_NO_DATA, BAD_NOT_FOUND, BAD_OUT_OF_RANGE, BAD_TYPE_MISMATCH,
})  # fmt: skip
"""Codes that a source also sets by itself, for a value that it cannot read or that does not fit its register."""


class RegisterStatus(NamedTuple):
    """The status that the source gave a register.

    Attributes:
        code: OPC UA status code.
        source_ns: Time stamp of the value at its origin, UTC in ns since 1970; 0: unknown, so that
            the time of the frame applies.
    """

    code: int
    source_ns: int

    @property
    def quality(self) -> Quality:
        """The quality that corresponds to the severity of the code; bad for the reserved severity."""
        return quality_of(self.code)

    @property
    def waits(self) -> bool:
        """True if the register has never had a value, so that its bytes in the image mean nothing."""
        return self.code & _NAMED == BAD_WAITING_FOR_INITIAL_DATA and not self.source_ns

    @property
    def reason(self) -> str:
        """Reason why the quality is not good; empty if it is good."""
        if self.waits:
            return f"no data yet ({_NAMES[BAD_WAITING_FOR_INITIAL_DATA]})"
        if self.quality is Quality.GOOD:
            return ""
        if self.code & _NAMED in _OF_EITHER:
            return f"{describe(self.code)}, from the device or from the source, whose log then has the reason"
        return _found(self.code) or f"the device reports {describe(self.code)}"


def describe(code: int) -> str:
    """Return a status code as text: its name and number; if the name is unknown, only the number."""
    name = _NAMES.get(standard(code) & _NAMED)
    return f"{name} (0x{code:08X})" if name else f"status 0x{code:08X}"


def from_opc_quality(quality: float) -> int | None:
    """Return the status code for a quality of OPC DA, 0 to 255, whose bits are QQSSSSLL; None if it has no meaning."""
    if quality not in _OPC_QUALITIES:
        return None
    number = int(quality) >> 2
    return _FROM_OPC.get(number, _FROM_OPC.get(number & 0x30))


def unknown_quality(quality: object) -> int:
    """Return the status code for a quality without a known meaning; it has the number, unless that is below 0."""
    return Finding.UNKNOWN_QUALITY.code(quality) if isinstance(quality, int) and quality >= 0 else UNCERTAIN


def worse(quality: Quality, reason: str, status: RegisterStatus) -> tuple[Quality, str]:
    """Return the worse of two qualities, that of a frame and that of a register's status, with its reason."""
    return (quality, reason) if quality <= status.quality else (status.quality, status.reason)


def quality_of(code: int) -> Quality:
    """Return the quality that corresponds to the severity of a status code; bad for the reserved severity."""
    return _QUALITIES[code >> 30]


class StatusArea:
    """Finds, reads and writes the statuses in images of one layout, which must have a status area."""

    def __init__(self, layout: Layout) -> None:
        if layout.status_offset is None:
            raise ValueError(f"{layout.name}: the layout has no status area")
        self.codes_offset = layout.status_offset
        """Offset of the status codes in an image, in bytes."""
        self.times_offset = layout.size - _TIME_BYTES * len(layout.own)
        """Offset of the source times in an image, in bytes."""
        order = ">" if layout.byte_order == "big" else "<"
        self._code, self._time = struct.Struct(f"{order}I"), struct.Struct(f"{order}q")
        self._severity_at = 0 if layout.byte_order == "big" else 3  # index of the byte with a code's severity
        self._first_bits = [8 * register.offset + (register.bit or 0) for register in layout.own]

    def index(self, register: Register) -> int:
        """Return the index, in the layout, of the register that contains a register, element or part.

        A register of a tag table over the block gets the index of the block's own register.
        """
        return bisect_right(self._first_bits, 8 * register.offset + (register.bit or 0)) - 1

    def indices(self, registers: Iterable[Register]) -> list[int]:
        """Return the index of each register: see :meth:`index`."""
        return [self.index(register) for register in registers]

    def code_range(self, index: int) -> tuple[int, int]:
        """Return (offset, size) of a register's code in an image."""
        return self.codes_offset + _CODE_BYTES * index, _CODE_BYTES

    def time_range(self, index: int) -> tuple[int, int]:
        """Return (offset, size) of a register's source time in an image."""
        return self.times_offset + _TIME_BYTES * index, _TIME_BYTES

    def time_bytes(self, source_ns: int) -> bytes:
        """Return the bytes of a source time, as an image has them."""
        return self._time.pack(source_ns)

    def get(self, image: Buffer, index: int) -> RegisterStatus:
        """Return the status of the register with this index in the layout."""
        (code,) = self._code.unpack_from(image, self.codes_offset + _CODE_BYTES * index)
        (source_ns,) = self._time.unpack_from(image, self.times_offset + _TIME_BYTES * index)
        return RegisterStatus(code, source_ns)

    def quality(self, image: Buffer, index: int) -> Quality:
        """Return the quality of the register with this index in the layout."""
        return _QUALITIES[image[self.codes_offset + _CODE_BYTES * index + self._severity_at] >> 6]

    def worst(self, image: Buffer, indices: Iterable[int]) -> tuple[int, RegisterStatus]:
        """Return (index, status) of the worst status at these indices; of the first one if several are equal."""
        found = min(indices, key=lambda index: self.quality(image, index))
        return found, self.get(image, found)

    def put(self, image: bytearray, index: int, status: RegisterStatus) -> None:
        """Write the status of the register with this index in the layout."""
        self.write(image, index, status.code, status.source_ns)

    def write(self, image: bytearray, index: int, code: int, source_ns: int) -> None:
        """Write the status of a register as :meth:`put` does, but from its code and time, which is faster."""
        self._code.pack_into(image, self.codes_offset + _CODE_BYTES * index, code)
        self._time.pack_into(image, self.times_offset + _TIME_BYTES * index, source_ns)

    def write_time(self, image: bytearray, index: int, source_ns: int) -> None:
        """Write the time of a register's status, and keep its code."""
        self._time.pack_into(image, self.times_offset + _TIME_BYTES * index, source_ns)


def status_registers(layout: Layout, registers: Iterable[Register], *, times: bool = True) -> list[Register]:
    """Return registers whose values are the statuses of other registers, for tables and comparisons.

    Args:
        layout: The layout of the registers.
        registers: Registers, elements or parts. All elements and parts of a register share its status.
        times: Whether to include the source times.

    Returns:
        For each register, the DWORD ``PATH#status`` and the LINT ``PATH#source_ns``; an empty list
        if the layout has no status area. No other path contains a ``#``.

    """
    area = status_area(layout)
    if area is None:
        return []
    found = []
    for index in dict.fromkeys(area.indices(registers)):
        path = layout.own[index].path
        offset, size = area.code_range(index)
        found.append(Register(f"{path}#status", "DWORD", (), offset, None, size, 1))
        if times:
            offset, size = area.time_range(index)
            found.append(Register(f"{path}#source_ns", "LINT", (), offset, None, size, 1))
    return found


class _StatusCodec:
    """Codec of a register that decodes the value as None while the register's status is bad."""

    def __init__(self, register: Register, layout: Layout, area: StatusArea) -> None:
        self._codec = codec(register, layout.byte_order)
        self._area, self._index = area, area.index(register)
        self.encode_into = self._codec.encode_into

    def decode(self, data: Buffer) -> Value:
        """Return the register's value in an image; None if its bytes are invalid or its status is bad."""
        return None if self._area.quality(data, self._index) is Quality.BAD else self._codec.decode(data)


def trusted_codec(register: Register, layout: Layout) -> RegisterCodec:
    """Return a codec of a register that decodes the value as None if the register's status is bad."""
    area = status_area(layout)
    return codec(register, layout.byte_order) if area is None else _StatusCodec(register, layout, area)


def status_area(layout: Layout) -> StatusArea | None:
    """Return the status area of a layout, or None if it has none. The result is cached."""
    if layout.status_offset is None:
        return None
    found: StatusArea | None = vars(layout).get("_status_area")
    if found is None:
        found = vars(layout)["_status_area"] = StatusArea(layout)  # as cached_property does
    return found
