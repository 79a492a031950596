"""The wire's messages with their packed arrays as bytes, for numpy.

A packed field with elements of a fixed size and a ``bytes`` field look the same on the wire
(protobuf.dev, "Encoding"). This module therefore declares the messages again, from the generated
description: where the API has numbers, these messages have the bytes of a little-endian array.
"""

from __future__ import annotations

from typing import Any

from google.protobuf import message_factory
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool

from shmio.wire import shmio_v1_pb2 as wire

_FIXED = frozenset(
    {
        FieldDescriptorProto.TYPE_BOOL,
        FieldDescriptorProto.TYPE_FIXED32,
        FieldDescriptorProto.TYPE_SFIXED32,
        FieldDescriptorProto.TYPE_SFIXED64,
        FieldDescriptorProto.TYPE_FIXED64,
        FieldDescriptorProto.TYPE_FLOAT,
        FieldDescriptorProto.TYPE_DOUBLE,
    }
)


def _declared_anew() -> DescriptorPool:
    file = FileDescriptorProto()
    wire.DESCRIPTOR.CopyToProto(file)
    for message in file.message_type:
        for field in message.field:
            if field.label == FieldDescriptorProto.LABEL_REPEATED and field.type in _FIXED:
                field.label, field.type = FieldDescriptorProto.LABEL_OPTIONAL, FieldDescriptorProto.TYPE_BYTES
    pool = DescriptorPool()
    pool.Add(file)
    return pool


_POOL = _declared_anew()


def _message(name: str) -> Any:
    return message_factory.GetMessageClass(_POOL.FindMessageTypeByName(f"{wire.DESCRIPTOR.package}.{name}"))


Values = _message("Values")
ReadResponse = _message("ReadResponse")
SubscribeResponse = _message("SubscribeResponse")
InjectRequest = _message("InjectRequest")
InjectResponse = _message("InjectResponse")
SimulateResponse = _message("SimulateResponse")
