"""What a change of the wire format breaks, and a client that knows only the wire format of an earlier version."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import grpc
from google.protobuf import descriptor_pb2, descriptor_pool, empty_pb2, message_factory, struct_pb2, timestamp_pb2

from shmio.wire import shmio_v1_pb2, simlog_v1_pb2, simlog_v2_pb2, simserver_pb2, sparkplug_b_pb2

Files = descriptor_pb2.FileDescriptorSet
Field = descriptor_pb2.FieldDescriptorProto


def present() -> Files:
    """Return the descriptors of this version."""
    found = Files()
    for module in (shmio_v1_pb2, simlog_v1_pb2, simlog_v2_pb2, simserver_pb2, sparkplug_b_pb2):
        module.DESCRIPTOR.CopyToProto(found.file.add())
    return found


def stored(folder: Path) -> Files:
    """Return the descriptors of the version of a baseline."""
    return Files.FromString((folder / "wire.binpb").read_bytes())


def broken(old: Files, new: Files) -> list[str]:
    """Return what programs that were built with ``old`` can no longer rely on, as messages that name the thing."""
    now = {file.package: file for file in new.file}
    found: list[str] = []
    for file in old.file:
        if file.package not in now:
            found.append(f"package {file.package} is gone")
            continue
        was, is_ = dict(_parts(file)), dict(_parts(now[file.package]))
        for name, what in was.items():
            if name not in is_:
                found.append(f"{name} ({what}) is gone")
            elif is_[name] != what:
                found.append(f"{name} was {what!r}, and is {is_[name]!r}")
    return found


def _parts(file: descriptor_pb2.FileDescriptorProto) -> Iterator[tuple[str, str]]:
    """Yield each field, enum value and call of a file, with all that programs depend on."""
    for message in file.message_type:
        yield from _message(message, file.package)
    for enum in file.enum_type:
        yield from _enum(enum, file.package)
    for service in file.service:
        for call in service.method:
            yield (
                f"call {file.package}.{service.name}/{call.name}",
                _flow(call.input_type, call.client_streaming)
                + " returns "
                + _flow(call.output_type, call.server_streaming),
            )


def _kind(streaming: bool) -> str:
    return "stream" if streaming else "unary"


def _flow(name: str, streaming: bool) -> str:
    return f"stream {name}" if streaming else name


def _message(message: descriptor_pb2.DescriptorProto, scope: str) -> Iterator[tuple[str, str]]:
    name = f"{scope}.{message.name}"
    yield f"message {name}", "message"
    for field in message.field:
        kind = (
            field.type_name or descriptor_pb2.FieldDescriptorProto.Type.Name(field.type).removeprefix("TYPE_").lower()
        )
        label = descriptor_pb2.FieldDescriptorProto.Label.Name(field.label).removeprefix("LABEL_").lower()
        part = ""
        if field.HasField("oneof_index"):
            part = " optional" if field.proto3_optional else f" of oneof {message.oneof_decl[field.oneof_index].name}"
        yield f"field {field.number} of {name}", f"{label} {kind} {field.name}{part}"
    for enum in message.enum_type:
        yield from _enum(enum, name)
    for inner in message.nested_type:
        yield from _message(inner, name)


def _enum(enum: descriptor_pb2.EnumDescriptorProto, scope: str) -> Iterator[tuple[str, str]]:
    for value in enum.value:
        yield f"value {value.number} of {scope}.{enum.name}", value.name


class OldClient:
    """A client whose messages and calls come from stored descriptors alone, as if generated from the old ``.proto``."""

    def __init__(self, files: Files, channel: grpc.Channel) -> None:
        self._channel = channel
        self._pool = descriptor_pool.DescriptorPool()
        for module in (empty_pb2, struct_pb2, timestamp_pb2):
            self._pool.AddSerializedFile(module.DESCRIPTOR.serialized_pb)
        for file in files.file:
            self._pool.AddSerializedFile(file.SerializeToString())

    def message(self, name: str, /, **fields: Any) -> Any:
        """Return a message by its full name."""
        return message_factory.GetMessageClass(self._pool.FindMessageTypeByName(name))(**fields)

    def call(self, service: str, method: str, request: Any = None, /, **fields: Any) -> Any:
        """Make a call; return its response, or the stream of its responses.

        ``fields`` are the fields of the request. If the client streams, ``request`` is an iterator of dictionaries
        with the fields of each.
        """
        described = self._pool.FindServiceByName(service).FindMethodByName(method)
        name = described.input_type.full_name
        kind = f"{_kind(described.client_streaming)}_{_kind(described.server_streaming)}"
        asked, answer = (message_factory.GetMessageClass(one) for one in (described.input_type, described.output_type))
        invoke = getattr(self._channel, kind)(f"/{service}/{method}", asked.SerializeToString, answer.FromString)
        return invoke(self._each(name, request) if described.client_streaming else asked(**fields), timeout=60)

    def _each(self, name: str, requests: Iterable[dict[str, Any]]) -> Iterator[Any]:
        for fields in requests:
            yield self.message(name, **fields)
