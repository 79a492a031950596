"""Turns writes of registers into MQTT messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import msgspec

from shmio.connectors.mqtt import json_path
from shmio.connectors.mqtt.address import Metric, Place
from shmio.connectors.mqtt.link import Publication
from shmio.connectors.mqtt.options import MqttOptions
from shmio.connectors.mqtt.store import Store
from shmio.connectors.written_registers import written_registers
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write


class Command:
    """A message to publish, the indices of the writes that it carries out, its values by register, and its outcome."""

    def __init__(self, publication: Publication, writes: set[int], values: Mapping[int, Value]) -> None:
        self.publication, self.writes, self.values = publication, writes, values
        self.number: int | None = None
        self.outcome: str | None = None
        """"" if the broker has accepted the message, or why it was refused; None if that is not known yet."""


class _Draft:
    """The registers and values of a message that is still being collected."""

    def __init__(self, target: Place | Metric) -> None:
        self.target = target
        self.writes: set[int] = set()
        self.values: dict[int, Value] = {}


def plan(store: Store, options: MqttOptions, writes: Sequence[Write]) -> tuple[list[Command], list[str]]:
    """Turn writes into messages.

    Values for the JSON of one topic share one message, and so do the metrics of one Sparkplug
    device. Each register whose payload is text has its own message.

    Returns:
        The messages in their order, and for each write "" or why it is refused. No message contains
        values of a refused write.

    """
    outcomes = [""] * len(writes)
    drafts: list[_Draft] = []
    open_drafts: dict[object, _Draft] = {}
    for number, write in enumerate(writes):
        try:
            found = list(_touched(store, write, open_drafts))
        except ValueError as error:
            outcomes[number] = str(error)
            continue
        for index, value in found:
            target = _target(store, index)
            key = _key(target)
            draft = open_drafts.get(key)
            if draft is None or index in draft.values:  # both values of a pulse are published
                draft = open_drafts[key] = _Draft(target)
                drafts.append(draft)
            draft.values[index] = value
            draft.writes.add(number)
    commands: list[Command] = []
    failed = True
    while failed:  # a write that is refused is part of no message
        failed, commands = False, []
        for draft in drafts:
            try:
                commands.append(Command(_message(store, options, draft), draft.writes, draft.values))
            except ValueError as error:
                failed = True
                for number in draft.writes:
                    outcomes[number] = outcomes[number] or str(error)
        drafts = [one for one in drafts if not any(outcomes[number] for number in one.writes)]
    return commands, outcomes


def _touched(store: Store, write: Write, open_drafts: dict[object, _Draft]) -> Iterator[tuple[int, Value]]:
    """Yield the registers that a write sets, with their values.

    Raises:
        ValueError: The write is refused; the message says why.

    """

    def present(index: int) -> Value:
        draft = open_drafts.get(_key(_target(store, index)))
        return draft.values[index] if draft is not None and index in draft.values else store.present(index)

    for index, value in written_registers(store.layout, write, present):
        register = store.layout.registers[index]
        if not register.writable:
            raise ValueError(f"{register.path}: to publish it, set `writable = true` in the tag table")
        if problem := store.offline(index):
            raise ValueError(f"{register.path}: {problem}")
        yield index, value


def _target(store: Store, index: int) -> Place | Metric:
    address = store.addresses[index]
    return address.target or address.source


def _key(target: Place | Metric) -> object:
    """Return a key that is equal for all targets that share a message."""
    if isinstance(target, Metric):
        return "sparkplug", target.owner
    return ("text", target.topic) if target.steps is None else ("json", target.topic)


def _message(store: Store, options: MqttOptions, draft: _Draft) -> Publication:
    """Return the message of a draft.

    Raises:
        ValueError: A value cannot be published; the message says why.

    """
    target = draft.target
    if isinstance(target, Metric):
        topic, payload = store.command(
            {index: store.converters[index].to_value(value) for index, value in draft.values.items()}
        )
        return Publication(topic, payload, 0, retain=False)  # as the specification demands
    document: Any = None
    payload = b""
    if target.steps is not None and target.topic in options.templates:
        document = msgspec.json.decode(options.templates[target.topic])
    for index, value in draft.values.items():
        place = _target(store, index)
        assert isinstance(place, Place)  # noqa: S101 - all targets of a draft are of one kind
        try:
            if place.steps is None:
                payload = store.converters[index].to_text(value)
            else:
                document = json_path.assign(document, place.steps, store.converters[index].to_json(value))
        except ValueError as error:
            raise ValueError(f"{store.layout.registers[index].path}: {error}") from None
    if target.steps is not None:
        payload = msgspec.json.encode(document)
    return Publication(target.topic, payload, options.write_qos, options.retain)
