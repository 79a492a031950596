"""No field, value or call of the wire format moves; docs/reference/compatibility.md says what may be added."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto

from tests.compatibility.wire import Files, broken, present, stored


def test_nothing_that_a_stored_version_has_was_changed(baseline: Path) -> None:
    assert broken(stored(baseline), present()) == []


def message(files: Files, name: str) -> DescriptorProto:
    return next(one for file in files.file for one in file.message_type if one.name == name)


def field(files: Files, name: str, number: int) -> FieldDescriptorProto:
    return next(one for one in message(files, name).field if one.number == number)


def renumber(files: Files) -> None:
    field(files, "Update", 4).number = 99


def rename(files: Files) -> None:
    field(files, "Update", 4).name = "process"


def retype(files: Files) -> None:
    field(files, "Update", 4).type = FieldDescriptorProto.TYPE_SINT64


def repeat(files: Files) -> None:
    field(files, "TopicDescriptor", 1).label = FieldDescriptorProto.LABEL_REPEATED


def out_of_oneof(files: Files) -> None:
    field(files, "ROSMessage", 4).ClearField("oneof_index")


def renumber_value(files: Files) -> None:
    enum = next(one for file in files.file for one in file.enum_type if one.name == "Quality")
    enum.value[1].number = 7


def unstream(files: Files) -> None:
    service = next(one for file in files.file for one in file.service if one.name == "Shmio")
    next(one for one in service.method if one.name == "Subscribe").server_streaming = False


def move_package(files: Files) -> None:
    next(file for file in files.file if file.package == "shmio.v1").package = "shmio.v2"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (renumber, "field 4 of shmio.v1.Update"),
        (rename, "field 4 of shmio.v1.Update"),
        (retype, "field 4 of shmio.v1.Update"),
        (repeat, "field 1 of simulation.server.TopicDescriptor"),
        (out_of_oneof, "field 4 of simulation.server.ROSMessage"),
        (renumber_value, "value 1 of shmio.v1.Quality"),
        (unstream, "call shmio.v1.Shmio/Subscribe"),
        (move_package, "package shmio.v1"),
    ],
)
def test_each_kind_of_change_is_found(change: Callable[[Files], None], named: str) -> None:
    changed = present()
    change(changed)
    [found] = broken(present(), changed)
    assert found.startswith(named)


def test_additions_break_nothing() -> None:
    added = present()
    message(added, "Update").field.add(name="more", number=500, type=FieldDescriptorProto.TYPE_INT32)
    assert broken(present(), added) == []
