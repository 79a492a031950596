from google.protobuf import empty_pb2 as _empty_pb2
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from typing import ClassVar as _ClassVar, Optional as _Optional

DESCRIPTOR: _descriptor.FileDescriptor

class StepRequest(_message.Message):
    __slots__ = ("deltaTime",)
    DELTATIME_FIELD_NUMBER: _ClassVar[int]
    deltaTime: int
    def __init__(self, deltaTime: _Optional[int] = ...) -> None: ...

class StartRequest(_message.Message):
    __slots__ = ("deltaTime",)
    DELTATIME_FIELD_NUMBER: _ClassVar[int]
    deltaTime: int
    def __init__(self, deltaTime: _Optional[int] = ...) -> None: ...

class SimStatus(_message.Message):
    __slots__ = ("clock", "deltaTime", "alive", "playing", "exitCode")
    CLOCK_FIELD_NUMBER: _ClassVar[int]
    DELTATIME_FIELD_NUMBER: _ClassVar[int]
    ALIVE_FIELD_NUMBER: _ClassVar[int]
    PLAYING_FIELD_NUMBER: _ClassVar[int]
    EXITCODE_FIELD_NUMBER: _ClassVar[int]
    clock: int
    deltaTime: int
    alive: bool
    playing: bool
    exitCode: int
    def __init__(self, clock: _Optional[int] = ..., deltaTime: _Optional[int] = ..., alive: bool = ..., playing: bool = ..., exitCode: _Optional[int] = ...) -> None: ...
