"""A structure, or a whole source, as one topic: all its registers in one message of JSON, in place of one for each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from shmio.config import MqttTopic
from shmio.endpoints.mqtt.channel import Message, Showing, json_payload
from shmio.layout.codec import codec
from shmio.layout.model import Layout, Register
from shmio.layout.text import json_value
from shmio.layout.topic import decode_segment
from shmio.segment import Provenance
from shmio.segment.view import injected

Value = Callable[[bytes], Any]
"""From an image to what JSON shows of it."""


class StructureChannel:
    """For the bridge's thread."""

    json = True

    def __init__(self, showing: Showing, path: str, registers: Sequence[Register], topic: str, rule: MqttTopic) -> None:
        """``path``: of the structure that the registers are below; empty: the source."""
        self.registers = registers
        self.topic = topic
        self.limited = rule.max_rate_hz is not None
        self._showing = showing
        self._qos, self._retain = rule.qos, rule.retain
        self._pause_ns = round(1e9 / rule.max_rate_hz) if rule.max_rate_hz else 0
        depth = path.count("/") + 1 if path else 0
        parts = [(register.path.split("/")[depth:], register) for register in registers]
        self._value = _members(parts, showing.block.layout)
        self.due_ns = 0

    def moved(self, _image: bytes) -> bool:
        """Every change is one."""
        return True

    def message(self, *, late: bool = False) -> Message:
        """As of now; while it is bad, with the values known last."""
        block, (frame, quality, reason) = self._showing.block, self._showing.shown
        self.due_ns = block.now_ns() + self._pause_ns
        value, provenance = None, Provenance.LIVE
        if frame is not None:
            provenance = Provenance.INJECTED if injected(block, self.registers, frame) else frame.provenance
            value = self._value(frame.image) if frame.source_ns else None
        payload = json_payload(value, quality, reason, str(provenance), frame, late=late)
        return Message(self.topic, payload, self._qos, self._retain and not late, True, frame.source_ns if frame else 0)


def _members(parts: Sequence[tuple[list[str], Register]], layout: Layout) -> Value:
    """``parts``: the names that lead to each register from here."""
    groups: dict[str, list[tuple[list[str], Register]]] = {}
    for (name, *rest), register in parts:
        groups.setdefault(decode_segment(name), []).append((rest, register))
    members = {
        name: _members(inner, layout) if inner[0][0] else _member(inner[0][1], layout) for name, inner in groups.items()
    }
    return lambda image: {name: value(image) for name, value in members.items()}


def _member(register: Register, layout: Layout) -> Value:
    decode, element = codec(register, layout.byte_order).decode, register.element
    return lambda image: json_value(decode(image), element)
