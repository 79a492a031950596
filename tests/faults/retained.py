"""Checks the broker's retained messages: the present state, and no topics of earlier layouts."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from paho.mqtt.client import Client, MQTTMessage, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode

from shmio.config import Address
from tests.faults.checker import SLACK_NS
from tests.faults.checks import Source, ValueCheck
from tests.faults.configuration import DECLARED
from tests.faults.remote import UNDER_WAY_NS

TURN_S: Final = 0.1
MOST_S: Final = 5.0
WORDS: Final = ("stamp", "command", "remote", "shown", "guarded", "declared", "chained")


def retained(address: Address, prefix: str) -> dict[str, bytes]:
    """Return the retained messages by topic, without the prefix. The result is empty without a broker."""
    found: dict[str, bytes] = {}
    client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5, reconnect_on_failure=False)
    quiet = False

    def ask(client: Client, *_: object) -> None:
        client.subscribe(f"{prefix}/#")

    def take(_client: Client, _data: Any, message: MQTTMessage) -> None:
        nonlocal quiet
        if message.retain:
            found[message.topic.removeprefix(f"{prefix}/")] = bytes(message.payload)
            quiet = False

    client.on_connect, client.on_message = ask, take
    until_s = time.monotonic() + MOST_S
    try:
        client.connect(address.host, address.port)
        while time.monotonic() < until_s and not (found and quiet):  # retained messages come first, all at once
            look_s, quiet = time.monotonic() + TURN_S, True
            while time.monotonic() < look_s:
                if client.loop(TURN_S) != MQTTErrorCode.MQTT_ERR_SUCCESS:
                    return {}
        client.disconnect()
    except OSError:
        return {}
    return found


def wrong(
    found: Mapping[str, bytes], sources: Sequence[Source], names: Mapping[str, str], slowness: float
) -> list[str]:
    """Describe what is wrong with the retained messages.

    ``names``: present name of each source's array after the first word.
    """
    return list(_wrong(found, sources, names, round((SLACK_NS + UNDER_WAY_NS) * slowness)))


def _wrong(
    found: Mapping[str, bytes], sources: Sequence[Source], names: Mapping[str, str], slack_ns: int
) -> Iterator[str]:
    if found.get("status") != b"online":
        yield f"status is {found.get('status')!r}"
    now_ns = time.monotonic_ns()
    for source in sources:
        name = source.name
        there = {topic for topic in found if topic.startswith(f"{name}/")}
        due = {f"{name}/status", *(f"{name}/{word}/out" for word in (*WORDS, names[name]))}
        if there != due:
            yield f"missing topics of {name}: {sorted(due - there)}, unexpected: {sorted(there - due)}"
            continue
        if (quality := json.loads(found[f"{name}/status"])["quality"]) != "good":
            yield f"{name} is {quality}"
        if source.truth is None:
            continue
        problems: list[str] = []
        stamp = ValueCheck(source, problems.append)
        stamp.value(int(found[f"{name}/stamp/out"]), now_ns, slack_ns=slack_ns)
        yield from problems
        if int(found[f"{name}/declared/out"]) != DECLARED:
            yield f"{name}/declared is {found[f'{name}/declared/out']!r}"
