from google.protobuf import empty_pb2 as _empty_pb2
from google.protobuf.internal import containers as _containers
from google.protobuf.internal import enum_type_wrapper as _enum_type_wrapper
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class StatusCode(int, metaclass=_enum_type_wrapper.EnumTypeWrapper):
    __slots__ = ()
    ERROR: _ClassVar[StatusCode]
    CREATED: _ClassVar[StatusCode]
    EXISTING: _ClassVar[StatusCode]
ERROR: StatusCode
CREATED: StatusCode
EXISTING: StatusCode

class StepSizeRequest(_message.Message):
    __slots__ = ("step",)
    STEP_FIELD_NUMBER: _ClassVar[int]
    step: int
    def __init__(self, step: _Optional[int] = ...) -> None: ...

class StepRequest(_message.Message):
    __slots__ = ()
    def __init__(self) -> None: ...

class StepResponse(_message.Message):
    __slots__ = ("code",)
    CODE_FIELD_NUMBER: _ClassVar[int]
    code: int
    def __init__(self, code: _Optional[int] = ...) -> None: ...

class TopicDescriptor(_message.Message):
    __slots__ = ("path", "msgType")
    PATH_FIELD_NUMBER: _ClassVar[int]
    MSGTYPE_FIELD_NUMBER: _ClassVar[int]
    path: str
    msgType: str
    def __init__(self, path: _Optional[str] = ..., msgType: _Optional[str] = ...) -> None: ...

class InjectRequest(_message.Message):
    __slots__ = ("injected", "target")
    INJECTED_FIELD_NUMBER: _ClassVar[int]
    TARGET_FIELD_NUMBER: _ClassVar[int]
    injected: TopicDescriptor
    target: TopicDescriptor
    def __init__(self, injected: _Optional[_Union[TopicDescriptor, _Mapping]] = ..., target: _Optional[_Union[TopicDescriptor, _Mapping]] = ...) -> None: ...

class PubRequest(_message.Message):
    __slots__ = ("topic", "data")
    TOPIC_FIELD_NUMBER: _ClassVar[int]
    DATA_FIELD_NUMBER: _ClassVar[int]
    topic: TopicDescriptor
    data: ROSMessage
    def __init__(self, topic: _Optional[_Union[TopicDescriptor, _Mapping]] = ..., data: _Optional[_Union[ROSMessage, _Mapping]] = ...) -> None: ...

class ROSMessage(_message.Message):
    __slots__ = ("type", "value", "joint_trajectory", "point", "point_stamped", "quaternion", "joint_trajectory_point", "timeStamp", "safety_zone", "safety_zone_cmd")
    TYPE_FIELD_NUMBER: _ClassVar[int]
    VALUE_FIELD_NUMBER: _ClassVar[int]
    JOINT_TRAJECTORY_FIELD_NUMBER: _ClassVar[int]
    POINT_FIELD_NUMBER: _ClassVar[int]
    POINT_STAMPED_FIELD_NUMBER: _ClassVar[int]
    QUATERNION_FIELD_NUMBER: _ClassVar[int]
    JOINT_TRAJECTORY_POINT_FIELD_NUMBER: _ClassVar[int]
    TIMESTAMP_FIELD_NUMBER: _ClassVar[int]
    SAFETY_ZONE_FIELD_NUMBER: _ClassVar[int]
    SAFETY_ZONE_CMD_FIELD_NUMBER: _ClassVar[int]
    type: str
    value: str
    joint_trajectory: JointTrajectory
    point: Point
    point_stamped: PointStamped
    quaternion: Quaternion
    joint_trajectory_point: JointTrajectoryPoint
    timeStamp: Header
    safety_zone: SafetyZone
    safety_zone_cmd: SafetyZoneCmd
    def __init__(self, type: _Optional[str] = ..., value: _Optional[str] = ..., joint_trajectory: _Optional[_Union[JointTrajectory, _Mapping]] = ..., point: _Optional[_Union[Point, _Mapping]] = ..., point_stamped: _Optional[_Union[PointStamped, _Mapping]] = ..., quaternion: _Optional[_Union[Quaternion, _Mapping]] = ..., joint_trajectory_point: _Optional[_Union[JointTrajectoryPoint, _Mapping]] = ..., timeStamp: _Optional[_Union[Header, _Mapping]] = ..., safety_zone: _Optional[_Union[SafetyZone, _Mapping]] = ..., safety_zone_cmd: _Optional[_Union[SafetyZoneCmd, _Mapping]] = ...) -> None: ...

class Result(_message.Message):
    __slots__ = ("success",)
    SUCCESS_FIELD_NUMBER: _ClassVar[int]
    success: bool
    def __init__(self, success: bool = ...) -> None: ...

class time(_message.Message):
    __slots__ = ("sec", "nsec")
    SEC_FIELD_NUMBER: _ClassVar[int]
    NSEC_FIELD_NUMBER: _ClassVar[int]
    sec: int
    nsec: int
    def __init__(self, sec: _Optional[int] = ..., nsec: _Optional[int] = ...) -> None: ...

class duration(_message.Message):
    __slots__ = ("msec",)
    MSEC_FIELD_NUMBER: _ClassVar[int]
    msec: int
    def __init__(self, msec: _Optional[int] = ...) -> None: ...

class Header(_message.Message):
    __slots__ = ("seq", "stamp", "frame_id")
    SEQ_FIELD_NUMBER: _ClassVar[int]
    STAMP_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    seq: int
    stamp: time
    frame_id: str
    def __init__(self, seq: _Optional[int] = ..., stamp: _Optional[_Union[time, _Mapping]] = ..., frame_id: _Optional[str] = ...) -> None: ...

class JointTrajectoryPoint(_message.Message):
    __slots__ = ("positions", "velocities", "accelerations", "effort", "time_from_start")
    POSITIONS_FIELD_NUMBER: _ClassVar[int]
    VELOCITIES_FIELD_NUMBER: _ClassVar[int]
    ACCELERATIONS_FIELD_NUMBER: _ClassVar[int]
    EFFORT_FIELD_NUMBER: _ClassVar[int]
    TIME_FROM_START_FIELD_NUMBER: _ClassVar[int]
    positions: _containers.RepeatedScalarFieldContainer[float]
    velocities: _containers.RepeatedScalarFieldContainer[float]
    accelerations: _containers.RepeatedScalarFieldContainer[float]
    effort: _containers.RepeatedScalarFieldContainer[float]
    time_from_start: duration
    def __init__(self, positions: _Optional[_Iterable[float]] = ..., velocities: _Optional[_Iterable[float]] = ..., accelerations: _Optional[_Iterable[float]] = ..., effort: _Optional[_Iterable[float]] = ..., time_from_start: _Optional[_Union[duration, _Mapping]] = ...) -> None: ...

class JointTrajectory(_message.Message):
    __slots__ = ("header", "joint_names", "points")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    JOINT_NAMES_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    header: Header
    joint_names: _containers.RepeatedScalarFieldContainer[str]
    points: _containers.RepeatedCompositeFieldContainer[JointTrajectoryPoint]
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., joint_names: _Optional[_Iterable[str]] = ..., points: _Optional[_Iterable[_Union[JointTrajectoryPoint, _Mapping]]] = ...) -> None: ...

class Point(_message.Message):
    __slots__ = ("x", "y", "z")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ...) -> None: ...

class Quaternion(_message.Message):
    __slots__ = ("x", "y", "z", "w")
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    W_FIELD_NUMBER: _ClassVar[int]
    x: float
    y: float
    z: float
    w: float
    def __init__(self, x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ..., w: _Optional[float] = ...) -> None: ...

class Pose(_message.Message):
    __slots__ = ("position", "orientation")
    POSITION_FIELD_NUMBER: _ClassVar[int]
    ORIENTATION_FIELD_NUMBER: _ClassVar[int]
    position: Point
    orientation: Quaternion
    def __init__(self, position: _Optional[_Union[Point, _Mapping]] = ..., orientation: _Optional[_Union[Quaternion, _Mapping]] = ...) -> None: ...

class PointStamped(_message.Message):
    __slots__ = ("header", "point")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    POINT_FIELD_NUMBER: _ClassVar[int]
    header: Header
    point: Point
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., point: _Optional[_Union[Point, _Mapping]] = ...) -> None: ...

class SafetyZone(_message.Message):
    __slots__ = ("header", "zone", "level", "object1", "object2")
    HEADER_FIELD_NUMBER: _ClassVar[int]
    ZONE_FIELD_NUMBER: _ClassVar[int]
    LEVEL_FIELD_NUMBER: _ClassVar[int]
    OBJECT1_FIELD_NUMBER: _ClassVar[int]
    OBJECT2_FIELD_NUMBER: _ClassVar[int]
    header: Header
    zone: str
    level: float
    object1: str
    object2: str
    def __init__(self, header: _Optional[_Union[Header, _Mapping]] = ..., zone: _Optional[str] = ..., level: _Optional[float] = ..., object1: _Optional[str] = ..., object2: _Optional[str] = ...) -> None: ...

class SafetyZoneCmd(_message.Message):
    __slots__ = ("zone", "cmd")
    ZONE_FIELD_NUMBER: _ClassVar[int]
    CMD_FIELD_NUMBER: _ClassVar[int]
    zone: str
    cmd: str
    def __init__(self, zone: _Optional[str] = ..., cmd: _Optional[str] = ...) -> None: ...
