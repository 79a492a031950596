import datetime

from google.protobuf import empty_pb2 as _empty_pb2
from google.protobuf import struct_pb2 as _struct_pb2
from google.protobuf import timestamp_pb2 as _timestamp_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class ValueType(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    UNRECOGNIZED_TYPE: _ClassVar[ValueType]
    NULL: _ClassVar[ValueType]
    BOOL: _ClassVar[ValueType]
    NUMBER: _ClassVar[ValueType]
    STRING: _ClassVar[ValueType]
    STRUCT: _ClassVar[ValueType]
    LIST: _ClassVar[ValueType]

class DirectionType(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    UNRECOGNIZED_DIRECTION: _ClassVar[DirectionType]
    IN: _ClassVar[DirectionType]
    OUT: _ClassVar[DirectionType]
    INOUT: _ClassVar[DirectionType]
UNRECOGNIZED_TYPE: ValueType
NULL: ValueType
BOOL: ValueType
NUMBER: ValueType
STRING: ValueType
STRUCT: ValueType
LIST: ValueType
UNRECOGNIZED_DIRECTION: DirectionType
IN: DirectionType
OUT: DirectionType
INOUT: DirectionType

class TopicInfoRequest(_message.Message):
    __slots__ = ("path",)
    PATH_FIELD_NUMBER: _ClassVar[int]
    path: str
    def __init__(self, path: _Optional[str] = ...) -> None: ...

class TopicInfo(_message.Message):
    __slots__ = ("path", "type", "direction", "exists")
    PATH_FIELD_NUMBER: _ClassVar[int]
    TYPE_FIELD_NUMBER: _ClassVar[int]
    DIRECTION_FIELD_NUMBER: _ClassVar[int]
    EXISTS_FIELD_NUMBER: _ClassVar[int]
    path: str
    type: ValueType
    direction: DirectionType
    exists: bool
    def __init__(self, path: _Optional[str] = ..., type: _Optional[_Union[ValueType, str]] = ..., direction: _Optional[_Union[DirectionType, str]] = ..., exists: bool = ...) -> None: ...

class Subscriber(_message.Message):
    __slots__ = ("name", "uuid")
    NAME_FIELD_NUMBER: _ClassVar[int]
    UUID_FIELD_NUMBER: _ClassVar[int]
    name: str
    uuid: str
    def __init__(self, name: _Optional[str] = ..., uuid: _Optional[str] = ...) -> None: ...

class SubscriptionRequest(_message.Message):
    __slots__ = ("path", "subscriberUUID")
    PATH_FIELD_NUMBER: _ClassVar[int]
    SUBSCRIBERUUID_FIELD_NUMBER: _ClassVar[int]
    path: str
    subscriberUUID: str
    def __init__(self, path: _Optional[str] = ..., subscriberUUID: _Optional[str] = ...) -> None: ...

class InjectRequest(_message.Message):
    __slots__ = ("targetPath", "shadowPathPrefix")
    TARGETPATH_FIELD_NUMBER: _ClassVar[int]
    SHADOWPATHPREFIX_FIELD_NUMBER: _ClassVar[int]
    targetPath: str
    shadowPathPrefix: str
    def __init__(self, targetPath: _Optional[str] = ..., shadowPathPrefix: _Optional[str] = ...) -> None: ...

class InjectResponse(_message.Message):
    __slots__ = ("shadowPathIn", "shadowPathOut")
    SHADOWPATHIN_FIELD_NUMBER: _ClassVar[int]
    SHADOWPATHOUT_FIELD_NUMBER: _ClassVar[int]
    shadowPathIn: str
    shadowPathOut: str
    def __init__(self, shadowPathIn: _Optional[str] = ..., shadowPathOut: _Optional[str] = ...) -> None: ...

class PubRequest(_message.Message):
    __slots__ = ("topic", "data")
    TOPIC_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    topic: str
    data: SimlogMessage
    def __init__(self, topic: _Optional[str] = ..., data: _Optional[_Union[SimlogMessage, _Mapping]] = ...) -> None: ...

class SimlogMessage(_message.Message):
    __slots__ = ("header", "type", "value")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    TYPE_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    header: Header
    type: ValueType
    value: _struct_pb2.Value
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., type: _Optional[_Union[ValueType, str]] = ..., value: _Optional[_Union[_struct_pb2.Value, _Mapping]] = ...) -> None: ...

class Header(_message.Message):
    __slots__ = ("timestamp", "path")
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    PATH_FIELD_NUMBER: _ClassVar[int]
    timestamp: _timestamp_pb2.Timestamp
    path: str
    def __init__(self, timestamp: _Optional[_Union[datetime.datetime, _timestamp_pb2.Timestamp, _Mapping]] = ..., path: _Optional[str] = ...) -> None: ...

class ReadRequest(_message.Message):
    __slots__ = ("path",)
    PATH_FIELD_NUMBER: _ClassVar[int]
    path: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, path: _Optional[_Iterable[str]] = ...) -> None: ...

class ReadResponse(_message.Message):
    __slots__ = ("messages",)
    MESSAGES_FIELD_NUMBER: _ClassVar[int]
    messages: _containers.RepeatedCompositeFieldContainer[SimlogMessage]
    def __init__(self, messages: _Optional[_Iterable[_Union[SimlogMessage, _Mapping]]] = ...) -> None: ...
