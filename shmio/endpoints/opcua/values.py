"""Values of registers for OPC UA: data types, units, and the state of a register in a frame."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from typing import Any, Final, NamedTuple

from asyncua import ua

from shmio.layout.model import NUMBERS, Register
from shmio.layout.values.codec import Value, codec
from shmio.local.reading import holds_none
from shmio.model.statuses import (
    BAD_WAITING_FOR_INITIAL_DATA,
    GOOD,
    quality_of,
    standard,
    status_area,
)
from shmio.segment import Block, Frame, FrameFollower, Provenance, Quality

BAD_DECODING_ERROR: Final = 0x80070000
BAD_NO_COMMUNICATION: Final = 0x80310000
BAD_OUT_OF_SERVICE: Final = 0x808D0000
UNCERTAIN: Final = 0x40000000
GOOD_LOCAL_OVERRIDE: Final = 0x00960000
"""The status of an injected value (OPC 10000-8, section 6.3), which does not come from the device."""

_TYPES: Final = {
    ua.VariantType.Boolean: ("BOOL",),
    ua.VariantType.Byte: ("BYTE", "USINT"),
    ua.VariantType.SByte: ("SINT",),
    ua.VariantType.UInt16: ("WORD", "UINT"),
    ua.VariantType.Int16: ("INT",),
    ua.VariantType.UInt32: ("DWORD", "UDINT", "S5TIME", "TIME_OF_DAY"),
    ua.VariantType.Int32: ("DINT", "TIME"),
    ua.VariantType.UInt64: ("LWORD", "ULINT", "LTOD"),
    ua.VariantType.Int64: ("LINT", "LTIME"),
    ua.VariantType.Float: ("REAL",),
    ua.VariantType.Double: ("LREAL",),
}
_TYPE_OF: Final = {name: found for found, names in _TYPES.items() for name in names}
"""The OPC UA data type of each elementary type. Values of all other types are sent as texts."""

_UNITS: Final = {
    "%": "P1", "1/min": "RPM", "1/s": "C97", "A": "AMP", "Hz": "HTZ", "K": "KEL", "N": "NEW", "Nm": "NU", "Pa": "PAL",
    "V": "VLT", "W": "WTT", "bar": "BAR", "cm": "CMT", "deg": "DD", "g": "GRM", "h": "HUR", "kHz": "KHZ", "kN": "B47",
    "kPa": "KPA", "kV": "KVT", "kW": "KWT", "kWh": "KWH", "kg": "KGM", "km": "KMT", "l": "LTR", "l/min": "L2",
    "m": "MTR", "m/s": "MTS", "m/s2": "MSK", "m3": "MTQ", "m3/h": "MQH", "mA": "4K", "mV": "2Z", "mbar": "MBR",
    "min": "MIN", "mm": "MMT", "mm/s": "C16", "ms": "C26", "rad": "C81", "rad/s": "2A", "rpm": "RPM", "s": "SEC",
    "°": "DD", "°C": "CEL", "°F": "FAH", "µm": "4H", "Ω": "OHM",
}  # fmt: skip
"""The UNECE common codes of units (OPC 10000-8, section 5.6.3)."""
_UNECE: Final = "http://www.opcfoundation.org/UA/units/un/cefact"
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


def data_type(register: Register) -> ua.VariantType:
    """Return the OPC UA data type of a register's value, or of its elements."""
    return _TYPE_OF.get(register.element.base, ua.VariantType.String)


def is_number(register: Register) -> bool:
    """Return whether a register's values are numbers."""
    return register.element.base in NUMBERS


def dimensions(register: Register) -> list[int]:
    """Return the sizes of an array's dimensions; empty for a scalar."""
    return list(register.shape) if register.dims else []


def variant(register: Register, value: Value) -> ua.Variant:
    """Return a register's value as OPC UA sends it."""
    sizes = dimensions(register)
    return ua.Variant(value, data_type(register), sizes if len(sizes) > 1 else None, is_array=bool(sizes))


_CODES: Final = {
    ua.VariantType.Boolean: "?", ua.VariantType.Byte: "B", ua.VariantType.SByte: "b", ua.VariantType.UInt16: "H",
    ua.VariantType.Int16: "h", ua.VariantType.UInt32: "I", ua.VariantType.Int32: "i", ua.VariantType.UInt64: "Q",
    ua.VariantType.Int64: "q", ua.VariantType.Float: "f", ua.VariantType.Double: "d",
}  # fmt: skip
_TICKS_AT_EPOCH: Final = 116_444_736_000_000_000
"""1970 as OPC UA counts time: in steps of 100 ns since 1601 (OPC 10000-6, section 5.2.2.5)."""
_HAS_VALUE, _HAS_STATUS, _HAS_SOURCE_TIME, _HAS_SERVER_TIME = 1, 2, 4, 8
_IS_ARRAY, _HAS_DIMENSIONS = 0x80, 0x40
_STATUS: Final = struct.Struct("<I")
_TIME: Final = struct.Struct("<q")


def encode(register: Register, state: RegisterState, server_ns: int) -> bytes:
    """Return a register's state as the binary encoding of a DataValue (OPC 10000-6, section 5.2.2.17).

    The library's encoder does the same in ten times the time.

    Args:
        register: The register, element or part.
        state: Its state.
        server_ns: The time of the frame, in ns since 1970; 0 if unknown.
    """
    mask = _HAS_VALUE | _HAS_STATUS
    parts = [b"", b"\0", _STATUS.pack(state.code)]
    if state.value is not None:
        parts[1] = _encode_variant(register, state.value)
    for bit, time_ns in ((_HAS_SOURCE_TIME, state.source_ns), (_HAS_SERVER_TIME, server_ns)):
        if time_ns:
            mask |= bit
            parts.append(_TIME.pack(time_ns // 1000 * 10 + _TICKS_AT_EPOCH))
    parts[0] = bytes((mask,))
    return b"".join(parts)


def _encode_variant(register: Register, value: Any) -> bytes:
    kind = data_type(register)
    code = _CODES.get(kind)
    if not register.dims:
        body = _encode_text(value) if code is None else struct.pack("<" + code, value)
        return bytes((kind.value,)) + body
    sizes = register.shape
    flat = value if len(sizes) == 1 else list(_flat(value))
    count = struct.pack("<i", len(flat))
    body = b"".join(map(_encode_text, flat)) if code is None else struct.pack(f"<{len(flat)}{code}", *flat)
    if len(sizes) == 1:
        return bytes((kind.value | _IS_ARRAY,)) + count + body
    dimensions = struct.pack(f"<{1 + len(sizes)}i", len(sizes), *sizes)
    return bytes((kind.value | _IS_ARRAY | _HAS_DIMENSIONS,)) + count + body + dimensions


def _encode_text(text: str) -> bytes:
    data = text.encode("utf-8", "surrogateescape")
    return struct.pack("<i", len(data)) + data


def _flat(value: Any) -> Iterator[Any]:
    for one in value:
        if isinstance(one, list):
            yield from _flat(one)
        else:
            yield one


def unit(text: str, namespace: str) -> ua.EUInformation:
    """Return a unit as OPC UA sends it. A unit without a UNECE code gets ``namespace``."""
    code = _UNITS.get(text)
    name = ua.LocalizedText(text)
    if code is None:
        return ua.EUInformation(namespace, -1, name, name)
    return ua.EUInformation(_UNECE, int.from_bytes(code.encode(), "big"), name, name)


def moment(ns: int) -> datetime:
    """Return a time, given in ns since 1970, as OPC UA sends it."""
    return _EPOCH + timedelta(microseconds=ns // 1000)


class RegisterState(NamedTuple):
    """The state of a register in a frame.

    Attributes:
        value: The value; None while the status is bad.
        code: The OPC UA status code.
        source_ns: UTC time of the value at its origin, in ns since 1970; 0 if unknown.
    """

    value: Value
    code: int
    source_ns: int


def register_state(follower: FrameFollower, register: Register, injected: Sequence[Any] = ()) -> RegisterState:
    """Return the present state of a register, an element or a part.

    Args:
        follower: The follower of the source's block, which has the newest frame.
        register: The register, element or part.
        injected: The injections over ``/out`` that the frame contains.
    """
    block, frame = follower.block, follower.frame
    code = block_status(block, frame)
    if frame is None or quality_of(code) is Quality.BAD:
        return RegisterState(None, code, 0 if frame is None else frame.source_ns)
    source_ns = frame.source_ns
    if (area := status_area(block.layout)) is not None:
        status = area.get(frame.image, area.index(register))
        source_ns = status.source_ns or source_ns
        if status.quality is Quality.BAD:
            return RegisterState(None, standard(status.code), source_ns)
        code = code or standard(status.code)
    value = codec(register, block.layout.byte_order).decode(frame.image)
    if holds_none(value):
        return RegisterState(None, BAD_DECODING_ERROR, source_ns)
    if code == GOOD and frame.effective is not None and any(one.covers(register) for one in injected):
        code = GOOD_LOCAL_OVERRIDE
    return RegisterState(value, code, source_ns)


def block_status(block: Block, frame: Frame | None) -> int:
    """Return the status code that all registers of a block get from its present quality."""
    if frame is None:
        return BAD_WAITING_FOR_INITIAL_DATA
    quality, _ = block.assess(frame)
    if quality is Quality.BAD:
        if frame.quality is not Quality.BAD:  # it is stale: its source has stopped publishing
            return BAD_OUT_OF_SERVICE
        return BAD_NO_COMMUNICATION if frame.provenance is Provenance.LIVE else BAD_OUT_OF_SERVICE
    if frame.source_ns == 0:
        return BAD_WAITING_FOR_INITIAL_DATA
    return UNCERTAIN if quality is Quality.UNCERTAIN else GOOD
