"""Turns writes of registers into ROS messages.

A ROS message always has all its fields. shmio copies the fields that a command does not write from the
last message of the topic. If no message has arrived, the command must write all registers of the topic,
so that shmio need not invent values.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from shmio.connectors.base import Lost, WriteLostError
from shmio.connectors.ros.addresses import Address, FieldError, extract, place_of
from shmio.connectors.ros.messages import DEFINITIONS, conforms, default, plain
from shmio.connectors.ros.topics import Topic, Topics
from shmio.connectors.written_registers import written_registers
from shmio.errors import ValueRangeError
from shmio.layout.values.codec import Value
from shmio.layout.values.write import Write
from shmio.model.statuses import BAD_NO_DATA

_MISSING: Final = object()
"""Stands for an element of a sequence to which no register gives a value."""


class Publication:
    """A message to publish, and the indices of the writes that it carries out."""

    def __init__(self, topic: Topic) -> None:
        self.topic = topic
        self.begun = False
        """True if the message may have been published."""
        self.message: Any = None
        self.writes: set[int] = set()
        self.values: dict[int, Value] = {}


def plan(topics: Topics, writes: Sequence[Write]) -> tuple[list[Publication], list[str]]:
    """Turn writes into messages.

    Returns:
        The messages in their order, and for each write "" or why it is refused. No message contains
        values of a refused write.

    """
    drafts: list[Publication] = []
    outcomes = [""] * len(writes)
    open_drafts: dict[str, Publication] = {}
    for number, write in enumerate(writes):
        try:
            found = list(_touched(topics, write, open_drafts))
        except ValueError as error:
            outcomes[number] = str(error)
            continue
        for index, value in found:
            topic = topics.by_name[topics.addresses[index].topic]
            draft = open_drafts.get(topic.name)
            if draft is None or index in draft.values:  # both values of a pulse are published
                draft = open_drafts[topic.name] = Publication(topic)
                drafts.append(draft)
            draft.values[index] = value
            draft.writes.add(number)
    failed = True
    while failed:  # a message may copy fields from one that is refused now
        failed = False
        bases = {draft.topic.name: draft.topic.message for draft in drafts}
        for draft in drafts:
            try:
                draft.message = bases[draft.topic.name] = _message(topics, draft, bases[draft.topic.name])
            except ValueError as error:
                failed = True
                for number in draft.writes:
                    outcomes[number] = outcomes[number] or str(error)
        drafts = [one for one in drafts if not any(outcomes[number] for number in one.writes)]
    return drafts, outcomes


class Sending:
    """The messages of a cycle's writes, which are published one after the other."""

    def __init__(self, publications: Sequence[Publication], outcomes: list[str | Lost], until_s: float) -> None:
        """Start with the first message.

        Args:
            publications: The messages.
            outcomes: For each write, "" or why it is refused.
            until_s: Time at which to stop waiting for confirmations, in s of CLOCK_MONOTONIC.

        """
        self.outcomes, self.until_s = outcomes, until_s
        self._publications, self._place = publications, 0

    @property
    def publication(self) -> Publication | None:
        """The message whose confirmation must come next; None if all are confirmed."""
        return self._publications[self._place] if self._place < len(self._publications) else None

    def end(self, refusal: str) -> None:
        """Store the outcome of :attr:`publication`: "", or why it was refused. Go to the next message."""
        for number in self._publications[self._place].writes:
            self.outcomes[number] = self.outcomes[number] or refusal
        self._place += 1

    def lost(self, reason: str) -> WriteLostError:
        """Return the error for a lost connection, with what is known about the outcome of each write."""
        done = {number for one in self._publications[: self._place] for number in one.writes}
        for one in self._publications[self._place :]:
            for number in one.writes:
                if self.outcomes[number] == "":
                    self.outcomes[number] = Lost.UNKNOWN if one.begun or number in done else Lost.UNSENT
            done |= one.writes if one.begun else set()
        return WriteLostError(reason, self.outcomes)


def stamped(topics: Topics, topic: Topic) -> bool:
    """Return whether a register of the topic contains the time stamp of its messages' header."""
    paths = ([step.name for step in topics.addresses[index].steps[:2]] for index in topic.registers)
    return ["header", "stamp"] in paths


def _touched(topics: Topics, write: Write, open_drafts: Mapping[str, Publication]) -> Iterator[tuple[int, Value]]:
    """Yield the registers that a write sets, with their values.

    Raises:
        ValueError: The write is refused; the message says why.

    """
    for index, value in written_registers(topics.layout, write, lambda index: _present(topics, index, open_drafts)):
        topic = topics.by_name[topics.addresses[index].topic]
        if not topic.writable or topics.converters[index].kind is None:
            path = topics.layout.registers[index].path
            raise ValueError(f"{path}: to publish on {topic.name}, set `writable = true` in the tag table")
        yield index, value


def _present(topics: Topics, index: int, open_drafts: Mapping[str, Publication]) -> Value:
    """Return the present value of an array register, in which a write replaces some elements.

    Raises:
        ValueRangeError: The last message does not contain the array.

    """
    topic = topics.by_name[topics.addresses[index].topic]
    draft = open_drafts.get(topic.name)
    if draft is not None and index in draft.values:
        return draft.values[index]
    try:
        return topics.converters[index].value(extract(topic.message, topics.addresses[index]))
    except FieldError as error:
        raise ValueRangeError(str(error)) from None


def _message(topics: Topics, draft: Publication, base: Any) -> Any:
    """Return the message of a publication.

    ``base`` is the message from which the other fields are copied; None if there is none.

    Raises:
        ValueError: The message would be incomplete, or a value does not fit its field.

    """
    topic, layout = draft.topic, topics.layout
    kind = plain(topic.type)
    fields = {}
    for index in topic.registers:
        if index in draft.values:
            try:
                fields[index] = topics.converters[index].field(draft.values[index])
            except ValueError as error:
                raise ValueError(f"{layout.registers[index].path}: {error}") from None
    missing = [layout.registers[index].path for index in topic.registers if index not in fields]
    if base is not None and conforms(base, kind):
        message = copy.deepcopy(base)
        try:
            for index, value in fields.items():
                _assign(message, kind, topics.addresses[index], value, grow=False)
            for index in fields:  # its layout, which no register has, may state other sizes
                topics.converters[index].value(extract(message, topics.addresses[index]))
            return message
        except FieldError as error:
            if missing:
                raise ValueError(
                    f"the last message of {topic.name} has no place for a written value: {error}"
                ) from None
    if missing:
        shown = ", ".join(missing[:5]) + (", …" if len(missing) > 5 else "")
        raise ValueError(
            f"no complete message has arrived on {topic.name} yet; "
            f"write all registers of the topic in one command, including {shown}"
        )
    message = default(kind)
    try:
        for index, value in fields.items():
            _assign(message, kind, topics.addresses[index], value, grow=True)
    except FieldError as error:
        raise ValueError(str(error)) from None
    named = {address.steps[-1] for address in map(topics.addresses.__getitem__, fields) if address.steps[-1].key}
    if not conforms(message, kind) or not all(_full(message, step.name, step.key[0]) for step in named if step.key):
        raise ValueError(f"the registers of {topic.name} leave elements of a sequence without a value")
    return message


def _full(message: Any, name: str, sequence: str) -> bool:
    """Return whether a sequence at the top level of a message has as many elements as it has names."""
    if name not in message or sequence not in message:
        return True
    return len(message[name]) == len(message[sequence])


def _assign(message: Any, kind: str, address: Address, value: Any, *, grow: bool) -> None:
    """Set a field of a message. If ``grow``, lengthen sequences and add names as needed.

    Raises:
        FieldError: The message does not contain the field.

    """
    scopes: list[Any] = []
    found = message
    for step in address.steps:
        scopes.append(found)
        kind = DEFINITIONS[kind][step.name]
        last = step is address.steps[-1]
        if step.whole:
            if last:
                found[step.name] = value
                return
            found = found[step.name]
            continue
        kind, sequence = kind[:-2], found[step.name]
        if step.key and grow:
            names = next(scope[step.key[0]] for scope in reversed(scopes) if step.key[0] in scope)
            if step.key[1] not in names:
                names.append(step.key[1])
        index = step.place if step.place is not None else place_of(scopes, step, address)
        if index >= len(sequence):
            if not grow:
                raise FieldError(
                    BAD_NO_DATA, f"{address.text}: the array {step.name!r} has only {len(sequence)} elements"
                )
            sequence.extend([_MISSING] * (index + 1 - len(sequence)))
        if last:
            sequence[index] = value
            return
        if sequence[index] is _MISSING:
            sequence[index] = default(kind)
        found = sequence[index]
