from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class Column(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    COLUMN_UNSPECIFIED: _ClassVar[Column]
    COLUMN_BOOL: _ClassVar[Column]
    COLUMN_INT32: _ClassVar[Column]
    COLUMN_INT64: _ClassVar[Column]
    COLUMN_UINT64: _ClassVar[Column]
    COLUMN_FLOAT: _ClassVar[Column]
    COLUMN_DOUBLE: _ClassVar[Column]
    COLUMN_TEXT: _ClassVar[Column]

class Quality(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    QUALITY_BAD: _ClassVar[Quality]
    QUALITY_UNCERTAIN: _ClassVar[Quality]
    QUALITY_GOOD: _ClassVar[Quality]

class Provenance(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    PROVENANCE_LIVE: _ClassVar[Provenance]
    PROVENANCE_SIMULATED: _ClassVar[Provenance]
    PROVENANCE_REPLAYED: _ClassVar[Provenance]
    PROVENANCE_INJECTED: _ClassVar[Provenance]

class Direction(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    DIRECTION_OUT: _ClassVar[Direction]
    DIRECTION_IN: _ClassVar[Direction]

class Mode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    MODE_LATEST: _ClassVar[Mode]
    MODE_EVERY_FRAME: _ClassVar[Mode]

class Format(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    FORMAT_VALUES: _ClassVar[Format]
    FORMAT_FRAMES: _ClassVar[Format]
COLUMN_UNSPECIFIED: Column
COLUMN_BOOL: Column
COLUMN_INT32: Column
COLUMN_INT64: Column
COLUMN_UINT64: Column
COLUMN_FLOAT: Column
COLUMN_DOUBLE: Column
COLUMN_TEXT: Column
QUALITY_BAD: Quality
QUALITY_UNCERTAIN: Quality
QUALITY_GOOD: Quality
PROVENANCE_LIVE: Provenance
PROVENANCE_SIMULATED: Provenance
PROVENANCE_REPLAYED: Provenance
PROVENANCE_INJECTED: Provenance
DIRECTION_OUT: Direction
DIRECTION_IN: Direction
MODE_LATEST: Mode
MODE_EVERY_FRAME: Mode
FORMAT_VALUES: Format
FORMAT_FRAMES: Format

class GetLayoutsRequest(_message.Message):
    __slots__ = ("sources",)
    SOURCES_FIELD_NUMBER: _ClassVar[int]
    sources: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, sources: _Optional[_Iterable[str]] = ...) -> None: ...

class LayoutPart(_message.Message):
    __slots__ = ("source", "section", "name", "number", "size", "big_endian", "hash", "period_ns", "stale_ns", "writable", "armed", "optimized", "registers", "last", "status_offset")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SECTION_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    BIG_ENDIAN_FIELD_NUMBER: _ClassVar[int]
    HASH_FIELD_NUMBER: _ClassVar[int]
    PERIOD_NS_FIELD_NUMBER: _ClassVar[int]
    STALE_NS_FIELD_NUMBER: _ClassVar[int]
    WRITABLE_FIELD_NUMBER: _ClassVar[int]
    ARMED_FIELD_NUMBER: _ClassVar[int]
    OPTIMIZED_FIELD_NUMBER: _ClassVar[int]
    REGISTERS_FIELD_NUMBER: _ClassVar[int]
    LAST_FIELD_NUMBER: _ClassVar[int]
    STATUS_OFFSET_FIELD_NUMBER: _ClassVar[int]
    source: str
    section: int
    name: str
    number: int
    size: int
    big_endian: bool
    hash: bytes
    period_ns: int
    stale_ns: int
    writable: _containers.RepeatedScalarFieldContainer[str]
    armed: bool
    optimized: bool
    registers: _containers.RepeatedCompositeFieldContainer[Register]
    last: bool
    status_offset: int
    def __init__(self, source: _Optional[str] = ..., section: _Optional[int] = ..., name: _Optional[str] = ..., number: _Optional[int] = ..., size: _Optional[int] = ..., big_endian: bool = ..., hash: _Optional[bytes] = ..., period_ns: _Optional[int] = ..., stale_ns: _Optional[int] = ..., writable: _Optional[_Iterable[str]] = ..., armed: bool = ..., optimized: bool = ..., registers: _Optional[_Iterable[_Union[Register, _Mapping]]] = ..., last: bool = ..., status_offset: _Optional[int] = ...) -> None: ...

class Register(_message.Message):
    __slots__ = ("path", "type", "dims", "offset", "bit", "size", "count", "column", "slot", "comment", "initial", "unit", "over", "encoding")
    PATH_FIELD_NUMBER: _ClassVar[int]
    TYPE_FIELD_NUMBER: _ClassVar[int]
    DIMS_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    BIT_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    COLUMN_FIELD_NUMBER: _ClassVar[int]
    SLOT_FIELD_NUMBER: _ClassVar[int]
    COMMENT_FIELD_NUMBER: _ClassVar[int]
    INITIAL_FIELD_NUMBER: _ClassVar[int]
    UNIT_FIELD_NUMBER: _ClassVar[int]
    OVER_FIELD_NUMBER: _ClassVar[int]
    ENCODING_FIELD_NUMBER: _ClassVar[int]
    path: str
    type: str
    dims: _containers.RepeatedCompositeFieldContainer[Bounds]
    offset: int
    bit: int
    size: int
    count: int
    column: Column
    slot: int
    comment: str
    initial: str
    unit: str
    over: str
    encoding: str
    def __init__(self, path: _Optional[str] = ..., type: _Optional[str] = ..., dims: _Optional[_Iterable[_Union[Bounds, _Mapping]]] = ..., offset: _Optional[int] = ..., bit: _Optional[int] = ..., size: _Optional[int] = ..., count: _Optional[int] = ..., column: _Optional[_Union[Column, str]] = ..., slot: _Optional[int] = ..., comment: _Optional[str] = ..., initial: _Optional[str] = ..., unit: _Optional[str] = ..., over: _Optional[str] = ..., encoding: _Optional[str] = ...) -> None: ...

class Bounds(_message.Message):
    __slots__ = ("low", "high")
    LOW_FIELD_NUMBER: _ClassVar[int]
    HIGH_FIELD_NUMBER: _ClassVar[int]
    low: int
    high: int
    def __init__(self, low: _Optional[int] = ..., high: _Optional[int] = ...) -> None: ...

class Range(_message.Message):
    __slots__ = ("offset", "size", "mask")
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    offset: int
    size: int
    mask: int
    def __init__(self, offset: _Optional[int] = ..., size: _Optional[int] = ..., mask: _Optional[int] = ...) -> None: ...

class Piece(_message.Message):
    __slots__ = ("offset", "data", "mask")
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    MASK_FIELD_NUMBER: _ClassVar[int]
    offset: int
    data: bytes
    mask: int
    def __init__(self, offset: _Optional[int] = ..., data: _Optional[bytes] = ..., mask: _Optional[int] = ...) -> None: ...

class Table(_message.Message):
    __slots__ = ("number", "source", "section", "hash", "size", "registers", "slots", "direction", "ranges")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    SECTION_FIELD_NUMBER: _ClassVar[int]
    HASH_FIELD_NUMBER: _ClassVar[int]
    SIZE_FIELD_NUMBER: _ClassVar[int]
    REGISTERS_FIELD_NUMBER: _ClassVar[int]
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    RANGES_FIELD_NUMBER: _ClassVar[int]
    number: int
    source: str
    section: int
    hash: bytes
    size: int
    registers: _containers.RepeatedCompositeFieldContainer[Register]
    slots: _containers.RepeatedScalarFieldContainer[int]
    direction: Direction
    ranges: _containers.RepeatedCompositeFieldContainer[Range]
    def __init__(self, number: _Optional[int] = ..., source: _Optional[str] = ..., section: _Optional[int] = ..., hash: _Optional[bytes] = ..., size: _Optional[int] = ..., registers: _Optional[_Iterable[_Union[Register, _Mapping]]] = ..., slots: _Optional[_Iterable[int]] = ..., direction: _Optional[_Union[Direction, str]] = ..., ranges: _Optional[_Iterable[_Union[Range, _Mapping]]] = ...) -> None: ...

class Values(_message.Message):
    __slots__ = ("bools", "int32s", "int64s", "uint64s", "floats", "doubles", "texts")
    BOOLS_FIELD_NUMBER: _ClassVar[int]
    INT32S_FIELD_NUMBER: _ClassVar[int]
    INT64S_FIELD_NUMBER: _ClassVar[int]
    UINT64S_FIELD_NUMBER: _ClassVar[int]
    FLOATS_FIELD_NUMBER: _ClassVar[int]
    DOUBLES_FIELD_NUMBER: _ClassVar[int]
    TEXTS_FIELD_NUMBER: _ClassVar[int]
    bools: Bools
    int32s: Int32s
    int64s: Int64s
    uint64s: Uint64s
    floats: Floats
    doubles: Doubles
    texts: Texts
    def __init__(self, bools: _Optional[_Union[Bools, _Mapping]] = ..., int32s: _Optional[_Union[Int32s, _Mapping]] = ..., int64s: _Optional[_Union[Int64s, _Mapping]] = ..., uint64s: _Optional[_Union[Uint64s, _Mapping]] = ..., floats: _Optional[_Union[Floats, _Mapping]] = ..., doubles: _Optional[_Union[Doubles, _Mapping]] = ..., texts: _Optional[_Union[Texts, _Mapping]] = ...) -> None: ...

class Bools(_message.Message):
    __slots__ = ("slots", "values")
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    slots: _containers.RepeatedScalarFieldContainer[int]
    values: _containers.RepeatedScalarFieldContainer[bool]
    def __init__(self, slots: _Optional[_Iterable[int]] = ..., values: _Optional[_Iterable[bool]] = ...) -> None: ...

class Int32s(_message.Message):
    __slots__ = ("slots", "values")
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    slots: _containers.RepeatedScalarFieldContainer[int]
    values: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, slots: _Optional[_Iterable[int]] = ..., values: _Optional[_Iterable[int]] = ...) -> None: ...

class Int64s(_message.Message):
    __slots__ = ("slots", "values")
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    slots: _containers.RepeatedScalarFieldContainer[int]
    values: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, slots: _Optional[_Iterable[int]] = ..., values: _Optional[_Iterable[int]] = ...) -> None: ...

class Uint64s(_message.Message):
    __slots__ = ("slots", "values")
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    slots: _containers.RepeatedScalarFieldContainer[int]
    values: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, slots: _Optional[_Iterable[int]] = ..., values: _Optional[_Iterable[int]] = ...) -> None: ...

class Floats(_message.Message):
    __slots__ = ("slots", "values")
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    slots: _containers.RepeatedScalarFieldContainer[int]
    values: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, slots: _Optional[_Iterable[int]] = ..., values: _Optional[_Iterable[float]] = ...) -> None: ...

class Doubles(_message.Message):
    __slots__ = ("slots", "values")
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    slots: _containers.RepeatedScalarFieldContainer[int]
    values: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, slots: _Optional[_Iterable[int]] = ..., values: _Optional[_Iterable[float]] = ...) -> None: ...

class Texts(_message.Message):
    __slots__ = ("slots", "values")
    SLOTS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    slots: _containers.RepeatedScalarFieldContainer[int]
    values: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, slots: _Optional[_Iterable[int]] = ..., values: _Optional[_Iterable[str]] = ...) -> None: ...

class Marks(_message.Message):
    __slots__ = ("registers",)
    REGISTERS_FIELD_NUMBER: _ClassVar[int]
    registers: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, registers: _Optional[_Iterable[int]] = ...) -> None: ...

class Statuses(_message.Message):
    __slots__ = ("registers", "codes", "source_ns")
    REGISTERS_FIELD_NUMBER: _ClassVar[int]
    CODES_FIELD_NUMBER: _ClassVar[int]
    SOURCE_NS_FIELD_NUMBER: _ClassVar[int]
    registers: _containers.RepeatedScalarFieldContainer[int]
    codes: _containers.RepeatedScalarFieldContainer[int]
    source_ns: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, registers: _Optional[_Iterable[int]] = ..., codes: _Optional[_Iterable[int]] = ..., source_ns: _Optional[_Iterable[int]] = ...) -> None: ...

class Update(_message.Message):
    __slots__ = ("table", "frame", "cycle", "incarnation", "clock_ns", "source_ns", "quality", "reason", "provenance", "missed", "whole", "values", "originals", "invalid", "injected", "image", "original", "age_ns", "pieces", "statuses")
    TABLE_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    INCARNATION_FIELD_NUMBER: _ClassVar[int]
    CLOCK_NS_FIELD_NUMBER: _ClassVar[int]
    SOURCE_NS_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    PROVENANCE_FIELD_NUMBER: _ClassVar[int]
    MISSED_FIELD_NUMBER: _ClassVar[int]
    WHOLE_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    ORIGINALS_FIELD_NUMBER: _ClassVar[int]
    INVALID_FIELD_NUMBER: _ClassVar[int]
    INJECTED_FIELD_NUMBER: _ClassVar[int]
    IMAGE_FIELD_NUMBER: _ClassVar[int]
    ORIGINAL_FIELD_NUMBER: _ClassVar[int]
    AGE_NS_FIELD_NUMBER: _ClassVar[int]
    PIECES_FIELD_NUMBER: _ClassVar[int]
    STATUSES_FIELD_NUMBER: _ClassVar[int]
    table: int
    frame: int
    cycle: int
    incarnation: int
    clock_ns: int
    source_ns: int
    quality: Quality
    reason: str
    provenance: Provenance
    missed: int
    whole: bool
    values: Values
    originals: Values
    invalid: Marks
    injected: Marks
    image: bytes
    original: bytes
    age_ns: int
    pieces: _containers.RepeatedCompositeFieldContainer[Piece]
    statuses: Statuses
    def __init__(self, table: _Optional[int] = ..., frame: _Optional[int] = ..., cycle: _Optional[int] = ..., incarnation: _Optional[int] = ..., clock_ns: _Optional[int] = ..., source_ns: _Optional[int] = ..., quality: _Optional[_Union[Quality, str]] = ..., reason: _Optional[str] = ..., provenance: _Optional[_Union[Provenance, str]] = ..., missed: _Optional[int] = ..., whole: bool = ..., values: _Optional[_Union[Values, _Mapping]] = ..., originals: _Optional[_Union[Values, _Mapping]] = ..., invalid: _Optional[_Union[Marks, _Mapping]] = ..., injected: _Optional[_Union[Marks, _Mapping]] = ..., image: _Optional[bytes] = ..., original: _Optional[bytes] = ..., age_ns: _Optional[int] = ..., pieces: _Optional[_Iterable[_Union[Piece, _Mapping]]] = ..., statuses: _Optional[_Union[Statuses, _Mapping]] = ...) -> None: ...

class ReadRequest(_message.Message):
    __slots__ = ("patterns", "originals", "tables")
    PATTERNS_FIELD_NUMBER: _ClassVar[int]
    ORIGINALS_FIELD_NUMBER: _ClassVar[int]
    TABLES_FIELD_NUMBER: _ClassVar[int]
    patterns: _containers.RepeatedScalarFieldContainer[str]
    originals: bool
    tables: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, patterns: _Optional[_Iterable[str]] = ..., originals: bool = ..., tables: _Optional[_Iterable[int]] = ...) -> None: ...

class ReadResponse(_message.Message):
    __slots__ = ("tables", "updates")
    TABLES_FIELD_NUMBER: _ClassVar[int]
    UPDATES_FIELD_NUMBER: _ClassVar[int]
    tables: _containers.RepeatedCompositeFieldContainer[Table]
    updates: _containers.RepeatedCompositeFieldContainer[Update]
    def __init__(self, tables: _Optional[_Iterable[_Union[Table, _Mapping]]] = ..., updates: _Optional[_Iterable[_Union[Update, _Mapping]]] = ...) -> None: ...

class SubscribeRequest(_message.Message):
    __slots__ = ("patterns", "mode", "format", "max_rate_hz", "deadband")
    PATTERNS_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    FORMAT_FIELD_NUMBER: _ClassVar[int]
    MAX_RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    DEADBAND_FIELD_NUMBER: _ClassVar[int]
    patterns: _containers.RepeatedScalarFieldContainer[str]
    mode: Mode
    format: Format
    max_rate_hz: float
    deadband: float
    def __init__(self, patterns: _Optional[_Iterable[str]] = ..., mode: _Optional[_Union[Mode, str]] = ..., format: _Optional[_Union[Format, str]] = ..., max_rate_hz: _Optional[float] = ..., deadband: _Optional[float] = ...) -> None: ...

class SubscribeResponse(_message.Message):
    __slots__ = ("tables", "updates", "ended", "step")
    TABLES_FIELD_NUMBER: _ClassVar[int]
    UPDATES_FIELD_NUMBER: _ClassVar[int]
    ENDED_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    tables: _containers.RepeatedCompositeFieldContainer[Table]
    updates: _containers.RepeatedCompositeFieldContainer[Update]
    ended: _containers.RepeatedCompositeFieldContainer[Ended]
    step: Step
    def __init__(self, tables: _Optional[_Iterable[_Union[Table, _Mapping]]] = ..., updates: _Optional[_Iterable[_Union[Update, _Mapping]]] = ..., ended: _Optional[_Iterable[_Union[Ended, _Mapping]]] = ..., step: _Optional[_Union[Step, _Mapping]] = ...) -> None: ...

class Step(_message.Message):
    __slots__ = ("number", "time_ns")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    number: int
    time_ns: int
    def __init__(self, number: _Optional[int] = ..., time_ns: _Optional[int] = ...) -> None: ...

class Ended(_message.Message):
    __slots__ = ("source", "reason", "direction")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    source: str
    reason: str
    direction: Direction
    def __init__(self, source: _Optional[str] = ..., reason: _Optional[str] = ..., direction: _Optional[_Union[Direction, str]] = ...) -> None: ...

class EventsRequest(_message.Message):
    __slots__ = ("sources",)
    SOURCES_FIELD_NUMBER: _ClassVar[int]
    sources: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, sources: _Optional[_Iterable[str]] = ...) -> None: ...

class EventsResponse(_message.Message):
    __slots__ = ("sources", "events")
    SOURCES_FIELD_NUMBER: _ClassVar[int]
    EVENTS_FIELD_NUMBER: _ClassVar[int]
    sources: _containers.RepeatedScalarFieldContainer[str]
    events: _containers.RepeatedCompositeFieldContainer[Event]
    def __init__(self, sources: _Optional[_Iterable[str]] = ..., events: _Optional[_Iterable[_Union[Event, _Mapping]]] = ...) -> None: ...

class Event(_message.Message):
    __slots__ = ("source", "kind", "number", "frame", "cycle", "incarnation", "clock_ns", "utc_ns", "quality", "text", "injection", "command", "by", "direction", "registers", "missed")
    class Kind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        KIND_UNSPECIFIED: _ClassVar[Event.Kind]
        KIND_STARTED: _ClassVar[Event.Kind]
        KIND_STOPPED: _ClassVar[Event.Kind]
        KIND_QUALITY: _ClassVar[Event.Kind]
        KIND_ACCEPTED: _ClassVar[Event.Kind]
        KIND_REJECTED: _ClassVar[Event.Kind]
        KIND_WRITTEN: _ClassVar[Event.Kind]
        KIND_REFUSED: _ClassVar[Event.Kind]
        KIND_EXPIRED: _ClassVar[Event.Kind]
        KIND_UNKNOWN: _ClassVar[Event.Kind]
        KIND_DIVERTED: _ClassVar[Event.Kind]
        KIND_TAKEN: _ClassVar[Event.Kind]
        KIND_INJECTED: _ClassVar[Event.Kind]
        KIND_LIFTED: _ClassVar[Event.Kind]
        KIND_SHADOWED: _ClassVar[Event.Kind]
        KIND_ACTIVATED: _ClassVar[Event.Kind]
        KIND_DEACTIVATED: _ClassVar[Event.Kind]
        KIND_NOTED: _ClassVar[Event.Kind]
        KIND_SAVED: _ClassVar[Event.Kind]
        KIND_RESTORED: _ClassVar[Event.Kind]
        KIND_REMOVED: _ClassVar[Event.Kind]
    KIND_UNSPECIFIED: Event.Kind
    KIND_STARTED: Event.Kind
    KIND_STOPPED: Event.Kind
    KIND_QUALITY: Event.Kind
    KIND_ACCEPTED: Event.Kind
    KIND_REJECTED: Event.Kind
    KIND_WRITTEN: Event.Kind
    KIND_REFUSED: Event.Kind
    KIND_EXPIRED: Event.Kind
    KIND_UNKNOWN: Event.Kind
    KIND_DIVERTED: Event.Kind
    KIND_TAKEN: Event.Kind
    KIND_INJECTED: Event.Kind
    KIND_LIFTED: Event.Kind
    KIND_SHADOWED: Event.Kind
    KIND_ACTIVATED: Event.Kind
    KIND_DEACTIVATED: Event.Kind
    KIND_NOTED: Event.Kind
    KIND_SAVED: Event.Kind
    KIND_RESTORED: Event.Kind
    KIND_REMOVED: Event.Kind
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    INCARNATION_FIELD_NUMBER: _ClassVar[int]
    CLOCK_NS_FIELD_NUMBER: _ClassVar[int]
    UTC_NS_FIELD_NUMBER: _ClassVar[int]
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    INJECTION_FIELD_NUMBER: _ClassVar[int]
    COMMAND_FIELD_NUMBER: _ClassVar[int]
    BY_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    REGISTERS_FIELD_NUMBER: _ClassVar[int]
    MISSED_FIELD_NUMBER: _ClassVar[int]
    source: str
    kind: Event.Kind
    number: int
    frame: int
    cycle: int
    incarnation: int
    clock_ns: int
    utc_ns: int
    quality: Quality
    text: str
    injection: int
    command: int
    by: str
    direction: Direction
    registers: _containers.RepeatedCompositeFieldContainer[Assignment]
    missed: int
    def __init__(self, source: _Optional[str] = ..., kind: _Optional[_Union[Event.Kind, str]] = ..., number: _Optional[int] = ..., frame: _Optional[int] = ..., cycle: _Optional[int] = ..., incarnation: _Optional[int] = ..., clock_ns: _Optional[int] = ..., utc_ns: _Optional[int] = ..., quality: _Optional[_Union[Quality, str]] = ..., text: _Optional[str] = ..., injection: _Optional[int] = ..., command: _Optional[int] = ..., by: _Optional[str] = ..., direction: _Optional[_Union[Direction, str]] = ..., registers: _Optional[_Iterable[_Union[Assignment, _Mapping]]] = ..., missed: _Optional[int] = ...) -> None: ...

class Value(_message.Message):
    __slots__ = ("boolean", "integer", "unsigned", "number", "text", "list")
    BOOLEAN_FIELD_NUMBER: _ClassVar[int]
    INTEGER_FIELD_NUMBER: _ClassVar[int]
    UNSIGNED_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    LIST_FIELD_NUMBER: _ClassVar[int]
    boolean: bool
    integer: int
    unsigned: int
    number: float
    text: str
    list: List
    def __init__(self, boolean: bool = ..., integer: _Optional[int] = ..., unsigned: _Optional[int] = ..., number: _Optional[float] = ..., text: _Optional[str] = ..., list: _Optional[_Union[List, _Mapping]] = ...) -> None: ...

class List(_message.Message):
    __slots__ = ("values",)
    VALUES_FIELD_NUMBER: _ClassVar[int]
    values: _containers.RepeatedCompositeFieldContainer[Value]
    def __init__(self, values: _Optional[_Iterable[_Union[Value, _Mapping]]] = ...) -> None: ...

class Assignment(_message.Message):
    __slots__ = ("path", "value")
    PATH_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    path: str
    value: Value
    def __init__(self, path: _Optional[str] = ..., value: _Optional[_Union[Value, _Mapping]] = ...) -> None: ...

class WriteRequest(_message.Message):
    __slots__ = ("values", "timeout_ms", "until_accepted")
    VALUES_FIELD_NUMBER: _ClassVar[int]
    TIMEOUT_MS_FIELD_NUMBER: _ClassVar[int]
    UNTIL_ACCEPTED_FIELD_NUMBER: _ClassVar[int]
    values: _containers.RepeatedCompositeFieldContainer[Assignment]
    timeout_ms: int
    until_accepted: bool
    def __init__(self, values: _Optional[_Iterable[_Union[Assignment, _Mapping]]] = ..., timeout_ms: _Optional[int] = ..., until_accepted: bool = ...) -> None: ...

class WriteResponse(_message.Message):
    __slots__ = ("outcomes",)
    OUTCOMES_FIELD_NUMBER: _ClassVar[int]
    outcomes: _containers.RepeatedCompositeFieldContainer[Outcome]
    def __init__(self, outcomes: _Optional[_Iterable[_Union[Outcome, _Mapping]]] = ...) -> None: ...

class Outcome(_message.Message):
    __slots__ = ("kind", "reason")
    class Kind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        KIND_UNKNOWN: _ClassVar[Outcome.Kind]
        KIND_WRITTEN: _ClassVar[Outcome.Kind]
        KIND_TAKEN: _ClassVar[Outcome.Kind]
        KIND_REJECTED: _ClassVar[Outcome.Kind]
        KIND_REFUSED: _ClassVar[Outcome.Kind]
        KIND_EXPIRED: _ClassVar[Outcome.Kind]
        KIND_SHADOWED: _ClassVar[Outcome.Kind]
        KIND_ACCEPTED: _ClassVar[Outcome.Kind]
    KIND_UNKNOWN: Outcome.Kind
    KIND_WRITTEN: Outcome.Kind
    KIND_TAKEN: Outcome.Kind
    KIND_REJECTED: Outcome.Kind
    KIND_REFUSED: Outcome.Kind
    KIND_EXPIRED: Outcome.Kind
    KIND_SHADOWED: Outcome.Kind
    KIND_ACCEPTED: Outcome.Kind
    KIND_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    kind: Outcome.Kind
    reason: str
    def __init__(self, kind: _Optional[_Union[Outcome.Kind, str]] = ..., reason: _Optional[str] = ...) -> None: ...

class InjectRequest(_message.Message):
    __slots__ = ("lay", "shadow")
    LAY_FIELD_NUMBER: _ClassVar[int]
    SHADOW_FIELD_NUMBER: _ClassVar[int]
    lay: Lay
    shadow: Shadow
    def __init__(self, lay: _Optional[_Union[Lay, _Mapping]] = ..., shadow: _Optional[_Union[Shadow, _Mapping]] = ...) -> None: ...

class Lay(_message.Message):
    __slots__ = ("patterns", "priority", "name", "keep", "lifetime_ms", "quiet", "source", "ranges", "direction")
    PATTERNS_FIELD_NUMBER: _ClassVar[int]
    PRIORITY_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    KEEP_FIELD_NUMBER: _ClassVar[int]
    LIFETIME_MS_FIELD_NUMBER: _ClassVar[int]
    QUIET_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    RANGES_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    patterns: _containers.RepeatedScalarFieldContainer[str]
    priority: int
    name: str
    keep: bool
    lifetime_ms: int
    quiet: bool
    source: str
    ranges: _containers.RepeatedCompositeFieldContainer[Range]
    direction: Direction
    def __init__(self, patterns: _Optional[_Iterable[str]] = ..., priority: _Optional[int] = ..., name: _Optional[str] = ..., keep: bool = ..., lifetime_ms: _Optional[int] = ..., quiet: bool = ..., source: _Optional[str] = ..., ranges: _Optional[_Iterable[_Union[Range, _Mapping]]] = ..., direction: _Optional[_Union[Direction, str]] = ...) -> None: ...

class Shadow(_message.Message):
    __slots__ = ("sequence", "values", "assignments", "pieces")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    ASSIGNMENTS_FIELD_NUMBER: _ClassVar[int]
    PIECES_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    values: Values
    assignments: _containers.RepeatedCompositeFieldContainer[Assignment]
    pieces: _containers.RepeatedCompositeFieldContainer[Piece]
    def __init__(self, sequence: _Optional[int] = ..., values: _Optional[_Union[Values, _Mapping]] = ..., assignments: _Optional[_Iterable[_Union[Assignment, _Mapping]]] = ..., pieces: _Optional[_Iterable[_Union[Piece, _Mapping]]] = ...) -> None: ...

class InjectResponse(_message.Message):
    __slots__ = ("laid", "originals", "answers")
    LAID_FIELD_NUMBER: _ClassVar[int]
    ORIGINALS_FIELD_NUMBER: _ClassVar[int]
    ANSWERS_FIELD_NUMBER: _ClassVar[int]
    laid: Laid
    originals: _containers.RepeatedCompositeFieldContainer[Update]
    answers: _containers.RepeatedCompositeFieldContainer[Answer]
    def __init__(self, laid: _Optional[_Union[Laid, _Mapping]] = ..., originals: _Optional[_Iterable[_Union[Update, _Mapping]]] = ..., answers: _Optional[_Iterable[_Union[Answer, _Mapping]]] = ...) -> None: ...

class Laid(_message.Message):
    __slots__ = ("number", "table")
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    TABLE_FIELD_NUMBER: _ClassVar[int]
    number: int
    table: Table
    def __init__(self, number: _Optional[int] = ..., table: _Optional[_Union[Table, _Mapping]] = ...) -> None: ...

class Answer(_message.Message):
    __slots__ = ("sequence", "outcome")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    OUTCOME_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    outcome: Outcome
    def __init__(self, sequence: _Optional[int] = ..., outcome: _Optional[_Union[Outcome, _Mapping]] = ...) -> None: ...

class DeclareRequest(_message.Message):
    __slots__ = ("declarations", "keep")
    DECLARATIONS_FIELD_NUMBER: _ClassVar[int]
    KEEP_FIELD_NUMBER: _ClassVar[int]
    declarations: _containers.RepeatedCompositeFieldContainer[Declaration]
    keep: bool
    def __init__(self, declarations: _Optional[_Iterable[_Union[Declaration, _Mapping]]] = ..., keep: bool = ...) -> None: ...

class Declaration(_message.Message):
    __slots__ = ("name", "targets", "set", "offset", "scale", "clamp", "noise", "random", "freeze", "delay", "drop", "flip", "probability", "start_s", "end_s", "when", "for_s", "times", "priority", "seed")
    NAME_FIELD_NUMBER: _ClassVar[int]
    TARGETS_FIELD_NUMBER: _ClassVar[int]
    SET_FIELD_NUMBER: _ClassVar[int]
    OFFSET_FIELD_NUMBER: _ClassVar[int]
    SCALE_FIELD_NUMBER: _ClassVar[int]
    CLAMP_FIELD_NUMBER: _ClassVar[int]
    NOISE_FIELD_NUMBER: _ClassVar[int]
    RANDOM_FIELD_NUMBER: _ClassVar[int]
    FREEZE_FIELD_NUMBER: _ClassVar[int]
    DELAY_FIELD_NUMBER: _ClassVar[int]
    DROP_FIELD_NUMBER: _ClassVar[int]
    FLIP_FIELD_NUMBER: _ClassVar[int]
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    START_S_FIELD_NUMBER: _ClassVar[int]
    END_S_FIELD_NUMBER: _ClassVar[int]
    WHEN_FIELD_NUMBER: _ClassVar[int]
    FOR_S_FIELD_NUMBER: _ClassVar[int]
    TIMES_FIELD_NUMBER: _ClassVar[int]
    PRIORITY_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    name: str
    targets: _containers.RepeatedScalarFieldContainer[str]
    set: Value
    offset: Value
    scale: Value
    clamp: Clamp
    noise: Noise
    random: Random
    freeze: Freeze
    delay: Delay
    drop: Drop
    flip: Flip
    probability: float
    start_s: float
    end_s: float
    when: str
    for_s: float
    times: int
    priority: int
    seed: int
    def __init__(self, name: _Optional[str] = ..., targets: _Optional[_Iterable[str]] = ..., set: _Optional[_Union[Value, _Mapping]] = ..., offset: _Optional[_Union[Value, _Mapping]] = ..., scale: _Optional[_Union[Value, _Mapping]] = ..., clamp: _Optional[_Union[Clamp, _Mapping]] = ..., noise: _Optional[_Union[Noise, _Mapping]] = ..., random: _Optional[_Union[Random, _Mapping]] = ..., freeze: _Optional[_Union[Freeze, _Mapping]] = ..., delay: _Optional[_Union[Delay, _Mapping]] = ..., drop: _Optional[_Union[Drop, _Mapping]] = ..., flip: _Optional[_Union[Flip, _Mapping]] = ..., probability: _Optional[float] = ..., start_s: _Optional[float] = ..., end_s: _Optional[float] = ..., when: _Optional[str] = ..., for_s: _Optional[float] = ..., times: _Optional[int] = ..., priority: _Optional[int] = ..., seed: _Optional[int] = ...) -> None: ...

class Clamp(_message.Message):
    __slots__ = ("min", "max")
    MIN_FIELD_NUMBER: _ClassVar[int]
    MAX_FIELD_NUMBER: _ClassVar[int]
    min: float
    max: float
    def __init__(self, min: _Optional[float] = ..., max: _Optional[float] = ...) -> None: ...

class Noise(_message.Message):
    __slots__ = ("amplitude", "distribution")
    class Distribution(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        DISTRIBUTION_UNIFORM: _ClassVar[Noise.Distribution]
        DISTRIBUTION_GAUSSIAN: _ClassVar[Noise.Distribution]
    DISTRIBUTION_UNIFORM: Noise.Distribution
    DISTRIBUTION_GAUSSIAN: Noise.Distribution
    AMPLITUDE_FIELD_NUMBER: _ClassVar[int]
    DISTRIBUTION_FIELD_NUMBER: _ClassVar[int]
    amplitude: float
    distribution: Noise.Distribution
    def __init__(self, amplitude: _Optional[float] = ..., distribution: _Optional[_Union[Noise.Distribution, str]] = ...) -> None: ...

class Random(_message.Message):
    __slots__ = ("values", "min", "max")
    VALUES_FIELD_NUMBER: _ClassVar[int]
    MIN_FIELD_NUMBER: _ClassVar[int]
    MAX_FIELD_NUMBER: _ClassVar[int]
    values: _containers.RepeatedCompositeFieldContainer[Value]
    min: float
    max: float
    def __init__(self, values: _Optional[_Iterable[_Union[Value, _Mapping]]] = ..., min: _Optional[float] = ..., max: _Optional[float] = ...) -> None: ...

class Freeze(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Delay(_message.Message):
    __slots__ = ("ms", "cycles")
    MS_FIELD_NUMBER: _ClassVar[int]
    CYCLES_FIELD_NUMBER: _ClassVar[int]
    ms: float
    cycles: int
    def __init__(self, ms: _Optional[float] = ..., cycles: _Optional[int] = ...) -> None: ...

class Drop(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Flip(_message.Message):
    __slots__ = ("bits",)
    BITS_FIELD_NUMBER: _ClassVar[int]
    bits: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, bits: _Optional[_Iterable[int]] = ...) -> None: ...

class DeclareResponse(_message.Message):
    __slots__ = ("declared", "happenings")
    DECLARED_FIELD_NUMBER: _ClassVar[int]
    HAPPENINGS_FIELD_NUMBER: _ClassVar[int]
    declared: Declared
    happenings: _containers.RepeatedCompositeFieldContainer[Happening]
    def __init__(self, declared: _Optional[_Union[Declared, _Mapping]] = ..., happenings: _Optional[_Iterable[_Union[Happening, _Mapping]]] = ...) -> None: ...

class Declared(_message.Message):
    __slots__ = ("injections",)
    INJECTIONS_FIELD_NUMBER: _ClassVar[int]
    injections: _containers.RepeatedCompositeFieldContainer[Laying]
    def __init__(self, injections: _Optional[_Iterable[_Union[Laying, _Mapping]]] = ...) -> None: ...

class Laying(_message.Message):
    __slots__ = ("source", "number", "name", "seed")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    source: str
    number: int
    name: str
    seed: int
    def __init__(self, source: _Optional[str] = ..., number: _Optional[int] = ..., name: _Optional[str] = ..., seed: _Optional[int] = ...) -> None: ...

class Happening(_message.Message):
    __slots__ = ("source", "number", "kind", "clock_ns", "utc_ns", "frame", "cycle", "run", "text")
    class Kind(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        KIND_UNKNOWN: _ClassVar[Happening.Kind]
        KIND_INJECTED: _ClassVar[Happening.Kind]
        KIND_ACTIVATED: _ClassVar[Happening.Kind]
        KIND_DEACTIVATED: _ClassVar[Happening.Kind]
        KIND_LIFTED: _ClassVar[Happening.Kind]
    KIND_UNKNOWN: Happening.Kind
    KIND_INJECTED: Happening.Kind
    KIND_ACTIVATED: Happening.Kind
    KIND_DEACTIVATED: Happening.Kind
    KIND_LIFTED: Happening.Kind
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    CLOCK_NS_FIELD_NUMBER: _ClassVar[int]
    UTC_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    RUN_FIELD_NUMBER: _ClassVar[int]
    TEXT_FIELD_NUMBER: _ClassVar[int]
    source: str
    number: int
    kind: Happening.Kind
    clock_ns: int
    utc_ns: int
    frame: int
    cycle: int
    run: int
    text: str
    def __init__(self, source: _Optional[str] = ..., number: _Optional[int] = ..., kind: _Optional[_Union[Happening.Kind, str]] = ..., clock_ns: _Optional[int] = ..., utc_ns: _Optional[int] = ..., frame: _Optional[int] = ..., cycle: _Optional[int] = ..., run: _Optional[int] = ..., text: _Optional[str] = ...) -> None: ...

class ListInjectionsRequest(_message.Message):
    __slots__ = ("sources",)
    SOURCES_FIELD_NUMBER: _ClassVar[int]
    sources: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, sources: _Optional[_Iterable[str]] = ...) -> None: ...

class ListInjectionsResponse(_message.Message):
    __slots__ = ("injections",)
    INJECTIONS_FIELD_NUMBER: _ClassVar[int]
    injections: _containers.RepeatedCompositeFieldContainer[Injection]
    def __init__(self, injections: _Optional[_Iterable[_Union[Injection, _Mapping]]] = ...) -> None: ...

class Injection(_message.Message):
    __slots__ = ("source", "number", "direction", "priority", "keep", "name", "pid", "ranges", "running", "writer", "cell")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    PRIORITY_FIELD_NUMBER: _ClassVar[int]
    KEEP_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    RANGES_FIELD_NUMBER: _ClassVar[int]
    RUNNING_FIELD_NUMBER: _ClassVar[int]
    WRITER_FIELD_NUMBER: _ClassVar[int]
    CELL_FIELD_NUMBER: _ClassVar[int]
    source: str
    number: int
    direction: Direction
    priority: int
    keep: bool
    name: str
    pid: int
    ranges: _containers.RepeatedCompositeFieldContainer[Range]
    running: Running
    writer: int
    cell: str
    def __init__(self, source: _Optional[str] = ..., number: _Optional[int] = ..., direction: _Optional[_Union[Direction, str]] = ..., priority: _Optional[int] = ..., keep: bool = ..., name: _Optional[str] = ..., pid: _Optional[int] = ..., ranges: _Optional[_Iterable[_Union[Range, _Mapping]]] = ..., running: _Optional[_Union[Running, _Mapping]] = ..., writer: _Optional[int] = ..., cell: _Optional[str] = ...) -> None: ...

class Running(_message.Message):
    __slots__ = ("declaration", "state", "seed", "runs", "cycle", "time_ns")
    class State(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
        __slots__ = ()
        STATE_UNSPECIFIED: _ClassVar[Running.State]
        STATE_WAITING: _ClassVar[Running.State]
        STATE_ACTIVE: _ClassVar[Running.State]
        STATE_OVER: _ClassVar[Running.State]
        STATE_LIFTED: _ClassVar[Running.State]
    STATE_UNSPECIFIED: Running.State
    STATE_WAITING: Running.State
    STATE_ACTIVE: Running.State
    STATE_OVER: Running.State
    STATE_LIFTED: Running.State
    DECLARATION_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    SEED_FIELD_NUMBER: _ClassVar[int]
    RUNS_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    declaration: Declaration
    state: Running.State
    seed: int
    runs: int
    cycle: int
    time_ns: int
    def __init__(self, declaration: _Optional[_Union[Declaration, _Mapping]] = ..., state: _Optional[_Union[Running.State, str]] = ..., seed: _Optional[int] = ..., runs: _Optional[int] = ..., cycle: _Optional[int] = ..., time_ns: _Optional[int] = ...) -> None: ...

class LiftRequest(_message.Message):
    __slots__ = ("source", "number")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    source: str
    number: int
    def __init__(self, source: _Optional[str] = ..., number: _Optional[int] = ...) -> None: ...

class LiftAllRequest(_message.Message):
    __slots__ = ("sources",)
    SOURCES_FIELD_NUMBER: _ClassVar[int]
    sources: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, sources: _Optional[_Iterable[str]] = ...) -> None: ...

class LiftResponse(_message.Message):
    __slots__ = ("lifted",)
    LIFTED_FIELD_NUMBER: _ClassVar[int]
    lifted: _containers.RepeatedCompositeFieldContainer[Lifted]
    def __init__(self, lifted: _Optional[_Iterable[_Union[Lifted, _Mapping]]] = ...) -> None: ...

class Lifted(_message.Message):
    __slots__ = ("source", "number", "name", "failure")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    NUMBER_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    FAILURE_FIELD_NUMBER: _ClassVar[int]
    source: str
    number: int
    name: str
    failure: str
    def __init__(self, source: _Optional[str] = ..., number: _Optional[int] = ..., name: _Optional[str] = ..., failure: _Optional[str] = ...) -> None: ...

class SimulateRequest(_message.Message):
    __slots__ = ("join", "done")
    JOIN_FIELD_NUMBER: _ClassVar[int]
    DONE_FIELD_NUMBER: _ClassVar[int]
    join: Join
    done: Done
    def __init__(self, join: _Optional[_Union[Join, _Mapping]] = ..., done: _Optional[_Union[Done, _Mapping]] = ...) -> None: ...

class Join(_message.Message):
    __slots__ = ("source", "name")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    NAME_FIELD_NUMBER: _ClassVar[int]
    source: str
    name: str
    def __init__(self, source: _Optional[str] = ..., name: _Optional[str] = ...) -> None: ...

class Done(_message.Message):
    __slots__ = ("step", "values", "assignments", "failure")
    STEP_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    ASSIGNMENTS_FIELD_NUMBER: _ClassVar[int]
    FAILURE_FIELD_NUMBER: _ClassVar[int]
    step: int
    values: Values
    assignments: _containers.RepeatedCompositeFieldContainer[Assignment]
    failure: str
    def __init__(self, step: _Optional[int] = ..., values: _Optional[_Union[Values, _Mapping]] = ..., assignments: _Optional[_Iterable[_Union[Assignment, _Mapping]]] = ..., failure: _Optional[str] = ...) -> None: ...

class SimulateResponse(_message.Message):
    __slots__ = ("joined", "work")
    JOINED_FIELD_NUMBER: _ClassVar[int]
    WORK_FIELD_NUMBER: _ClassVar[int]
    joined: Joined
    work: Do
    def __init__(self, joined: _Optional[_Union[Joined, _Mapping]] = ..., work: _Optional[_Union[Do, _Mapping]] = ...) -> None: ...

class Joined(_message.Message):
    __slots__ = ("inputs", "outputs", "values", "computed", "clock", "period_ns")
    INPUTS_FIELD_NUMBER: _ClassVar[int]
    OUTPUTS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    COMPUTED_FIELD_NUMBER: _ClassVar[int]
    CLOCK_FIELD_NUMBER: _ClassVar[int]
    PERIOD_NS_FIELD_NUMBER: _ClassVar[int]
    inputs: Table
    outputs: Table
    values: Values
    computed: bool
    clock: Clock
    period_ns: int
    def __init__(self, inputs: _Optional[_Union[Table, _Mapping]] = ..., outputs: _Optional[_Union[Table, _Mapping]] = ..., values: _Optional[_Union[Values, _Mapping]] = ..., computed: bool = ..., clock: _Optional[_Union[Clock, _Mapping]] = ..., period_ns: _Optional[int] = ...) -> None: ...

class Do(_message.Message):
    __slots__ = ("step", "time_ns", "dt_ns", "values", "invalid", "doubt", "refused")
    STEP_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    DT_NS_FIELD_NUMBER: _ClassVar[int]
    VALUES_FIELD_NUMBER: _ClassVar[int]
    INVALID_FIELD_NUMBER: _ClassVar[int]
    DOUBT_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    step: int
    time_ns: int
    dt_ns: int
    values: Values
    invalid: Marks
    doubt: str
    refused: str
    def __init__(self, step: _Optional[int] = ..., time_ns: _Optional[int] = ..., dt_ns: _Optional[int] = ..., values: _Optional[_Union[Values, _Mapping]] = ..., invalid: _Optional[_Union[Marks, _Mapping]] = ..., doubt: _Optional[str] = ..., refused: _Optional[str] = ...) -> None: ...

class GetStatusRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Status(_message.Message):
    __slots__ = ("instance", "mode", "state", "segment", "segment_bytes", "supervisor", "processes", "note", "clock")
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    MODE_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    SEGMENT_FIELD_NUMBER: _ClassVar[int]
    SEGMENT_BYTES_FIELD_NUMBER: _ClassVar[int]
    SUPERVISOR_FIELD_NUMBER: _ClassVar[int]
    PROCESSES_FIELD_NUMBER: _ClassVar[int]
    NOTE_FIELD_NUMBER: _ClassVar[int]
    CLOCK_FIELD_NUMBER: _ClassVar[int]
    instance: str
    mode: str
    state: str
    segment: str
    segment_bytes: int
    supervisor: Supervisor
    processes: _containers.RepeatedCompositeFieldContainer[Process]
    note: str
    clock: Clock
    def __init__(self, instance: _Optional[str] = ..., mode: _Optional[str] = ..., state: _Optional[str] = ..., segment: _Optional[str] = ..., segment_bytes: _Optional[int] = ..., supervisor: _Optional[_Union[Supervisor, _Mapping]] = ..., processes: _Optional[_Iterable[_Union[Process, _Mapping]]] = ..., note: _Optional[str] = ..., clock: _Optional[_Union[Clock, _Mapping]] = ...) -> None: ...

class Supervisor(_message.Message):
    __slots__ = ("pid", "uptime_s")
    PID_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    pid: int
    uptime_s: float
    def __init__(self, pid: _Optional[int] = ..., uptime_s: _Optional[float] = ...) -> None: ...

class Process(_message.Message):
    __slots__ = ("name", "kind", "pid", "state", "restarts", "uptime_s", "note", "counters", "source")
    class CountersEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: int
        def __init__(self, key: _Optional[str] = ..., value: _Optional[int] = ...) -> None: ...
    NAME_FIELD_NUMBER: _ClassVar[int]
    KIND_FIELD_NUMBER: _ClassVar[int]
    PID_FIELD_NUMBER: _ClassVar[int]
    STATE_FIELD_NUMBER: _ClassVar[int]
    RESTARTS_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    NOTE_FIELD_NUMBER: _ClassVar[int]
    COUNTERS_FIELD_NUMBER: _ClassVar[int]
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    name: str
    kind: str
    pid: int
    state: str
    restarts: int
    uptime_s: float
    note: str
    counters: _containers.ScalarMap[str, int]
    source: SourceState
    def __init__(self, name: _Optional[str] = ..., kind: _Optional[str] = ..., pid: _Optional[int] = ..., state: _Optional[str] = ..., restarts: _Optional[int] = ..., uptime_s: _Optional[float] = ..., note: _Optional[str] = ..., counters: _Optional[_Mapping[str, int]] = ..., source: _Optional[_Union[SourceState, _Mapping]] = ...) -> None: ...

class SourceState(_message.Message):
    __slots__ = ("quality", "reason", "cycle", "rate_hz", "overruns", "real_time")
    QUALITY_FIELD_NUMBER: _ClassVar[int]
    REASON_FIELD_NUMBER: _ClassVar[int]
    CYCLE_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    OVERRUNS_FIELD_NUMBER: _ClassVar[int]
    REAL_TIME_FIELD_NUMBER: _ClassVar[int]
    quality: str
    reason: str
    cycle: int
    rate_hz: float
    overruns: int
    real_time: bool
    def __init__(self, quality: _Optional[str] = ..., reason: _Optional[str] = ..., cycle: _Optional[int] = ..., rate_hz: _Optional[float] = ..., overruns: _Optional[int] = ..., real_time: bool = ...) -> None: ...

class StepRequest(_message.Message):
    __slots__ = ("dt_ns",)
    DT_NS_FIELD_NUMBER: _ClassVar[int]
    dt_ns: int
    def __init__(self, dt_ns: _Optional[int] = ...) -> None: ...

class StepsRequest(_message.Message):
    __slots__ = ("dt_ns", "count")
    DT_NS_FIELD_NUMBER: _ClassVar[int]
    COUNT_FIELD_NUMBER: _ClassVar[int]
    dt_ns: int
    count: int
    def __init__(self, dt_ns: _Optional[int] = ..., count: _Optional[int] = ...) -> None: ...

class StepsResponse(_message.Message):
    __slots__ = ("steps",)
    STEPS_FIELD_NUMBER: _ClassVar[int]
    steps: _containers.RepeatedCompositeFieldContainer[Step]
    def __init__(self, steps: _Optional[_Iterable[_Union[Step, _Mapping]]] = ...) -> None: ...

class SetStepSizeRequest(_message.Message):
    __slots__ = ("dt_ns",)
    DT_NS_FIELD_NUMBER: _ClassVar[int]
    dt_ns: int
    def __init__(self, dt_ns: _Optional[int] = ...) -> None: ...

class PlayRequest(_message.Message):
    __slots__ = ("dt_ns", "rate")
    DT_NS_FIELD_NUMBER: _ClassVar[int]
    RATE_FIELD_NUMBER: _ClassVar[int]
    dt_ns: int
    rate: float
    def __init__(self, dt_ns: _Optional[int] = ..., rate: _Optional[float] = ...) -> None: ...

class PauseRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ReleaseRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class WatchClockRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Clock(_message.Message):
    __slots__ = ("virtual", "step", "time_ns", "step_size_ns", "playing", "rate", "note")
    VIRTUAL_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    STEP_SIZE_NS_FIELD_NUMBER: _ClassVar[int]
    PLAYING_FIELD_NUMBER: _ClassVar[int]
    RATE_FIELD_NUMBER: _ClassVar[int]
    NOTE_FIELD_NUMBER: _ClassVar[int]
    virtual: bool
    step: int
    time_ns: int
    step_size_ns: int
    playing: bool
    rate: float
    note: str
    def __init__(self, virtual: bool = ..., step: _Optional[int] = ..., time_ns: _Optional[int] = ..., step_size_ns: _Optional[int] = ..., playing: bool = ..., rate: _Optional[float] = ..., note: _Optional[str] = ...) -> None: ...

class ReplayRequest(_message.Message):
    __slots__ = ("paused", "speed", "loop", "seek", "until", "change", "event", "jump", "sources")
    PAUSED_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    LOOP_FIELD_NUMBER: _ClassVar[int]
    SEEK_FIELD_NUMBER: _ClassVar[int]
    UNTIL_FIELD_NUMBER: _ClassVar[int]
    CHANGE_FIELD_NUMBER: _ClassVar[int]
    EVENT_FIELD_NUMBER: _ClassVar[int]
    JUMP_FIELD_NUMBER: _ClassVar[int]
    SOURCES_FIELD_NUMBER: _ClassVar[int]
    paused: bool
    speed: float
    loop: bool
    seek: str
    until: str
    change: str
    event: str
    jump: bool
    sources: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, paused: bool = ..., speed: _Optional[float] = ..., loop: bool = ..., seek: _Optional[str] = ..., until: _Optional[str] = ..., change: _Optional[str] = ..., event: _Optional[str] = ..., jump: bool = ..., sources: _Optional[_Iterable[str]] = ...) -> None: ...

class ReplayResponse(_message.Message):
    __slots__ = ("sources",)
    SOURCES_FIELD_NUMBER: _ClassVar[int]
    sources: _containers.RepeatedCompositeFieldContainer[Playing]
    def __init__(self, sources: _Optional[_Iterable[_Union[Playing, _Mapping]]] = ...) -> None: ...

class Playing(_message.Message):
    __slots__ = ("source", "time_s", "position_s", "length_s", "speed", "paused", "loop", "over", "until_s")
    SOURCE_FIELD_NUMBER: _ClassVar[int]
    TIME_S_FIELD_NUMBER: _ClassVar[int]
    POSITION_S_FIELD_NUMBER: _ClassVar[int]
    LENGTH_S_FIELD_NUMBER: _ClassVar[int]
    SPEED_FIELD_NUMBER: _ClassVar[int]
    PAUSED_FIELD_NUMBER: _ClassVar[int]
    LOOP_FIELD_NUMBER: _ClassVar[int]
    OVER_FIELD_NUMBER: _ClassVar[int]
    UNTIL_S_FIELD_NUMBER: _ClassVar[int]
    source: str
    time_s: float
    position_s: float
    length_s: float
    speed: float
    paused: bool
    loop: bool
    over: bool
    until_s: float
    def __init__(self, source: _Optional[str] = ..., time_s: _Optional[float] = ..., position_s: _Optional[float] = ..., length_s: _Optional[float] = ..., speed: _Optional[float] = ..., paused: bool = ..., loop: bool = ..., over: bool = ..., until_s: _Optional[float] = ...) -> None: ...

class SaveSnapshotRequest(_message.Message):
    __slots__ = ("name", "partial")
    NAME_FIELD_NUMBER: _ClassVar[int]
    PARTIAL_FIELD_NUMBER: _ClassVar[int]
    name: str
    partial: bool
    def __init__(self, name: _Optional[str] = ..., partial: bool = ...) -> None: ...

class RestoreSnapshotRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class ListSnapshotsRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class ListSnapshotsResponse(_message.Message):
    __slots__ = ("snapshots",)
    SNAPSHOTS_FIELD_NUMBER: _ClassVar[int]
    snapshots: _containers.RepeatedCompositeFieldContainer[Snapshot]
    def __init__(self, snapshots: _Optional[_Iterable[_Union[Snapshot, _Mapping]]] = ...) -> None: ...

class DeleteSnapshotRequest(_message.Message):
    __slots__ = ("name",)
    NAME_FIELD_NUMBER: _ClassVar[int]
    name: str
    def __init__(self, name: _Optional[str] = ...) -> None: ...

class DeleteSnapshotResponse(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class Snapshot(_message.Message):
    __slots__ = ("name", "instance", "saved_s", "time_ns", "step", "size_bytes", "left_out", "problem")
    class LeftOutEntry(_message.Message):
        __slots__ = ("key", "value")
        KEY_FIELD_NUMBER: _ClassVar[int]
        VALUE_FIELD_NUMBER: _ClassVar[int]
        key: str
        value: str
        def __init__(self, key: _Optional[str] = ..., value: _Optional[str] = ...) -> None: ...
    NAME_FIELD_NUMBER: _ClassVar[int]
    INSTANCE_FIELD_NUMBER: _ClassVar[int]
    SAVED_S_FIELD_NUMBER: _ClassVar[int]
    TIME_NS_FIELD_NUMBER: _ClassVar[int]
    STEP_FIELD_NUMBER: _ClassVar[int]
    SIZE_BYTES_FIELD_NUMBER: _ClassVar[int]
    LEFT_OUT_FIELD_NUMBER: _ClassVar[int]
    PROBLEM_FIELD_NUMBER: _ClassVar[int]
    name: str
    instance: str
    saved_s: float
    time_ns: int
    step: int
    size_bytes: int
    left_out: _containers.ScalarMap[str, str]
    problem: str
    def __init__(self, name: _Optional[str] = ..., instance: _Optional[str] = ..., saved_s: _Optional[float] = ..., time_ns: _Optional[int] = ..., step: _Optional[int] = ..., size_bytes: _Optional[int] = ..., left_out: _Optional[_Mapping[str, str]] = ..., problem: _Optional[str] = ...) -> None: ...
