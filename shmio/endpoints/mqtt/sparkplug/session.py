"""An instance as an edge node of Sparkplug B.

By a connection of its own: a connection has one will, and the bridge's says something else.
"""

from __future__ import annotations

import logging
import selectors
import time
from collections.abc import Callable, Sequence
from typing import Final

import msgspec
from paho.mqtt.client import MQTTMessage

from shmio.config import Mqtt, Sparkplug
from shmio.endpoints.mqtt.backlog import Backlog
from shmio.endpoints.mqtt.broker.directory import own_socket
from shmio.endpoints.mqtt.channel import Message
from shmio.endpoints.mqtt.connection.connection import BrokerConnection
from shmio.endpoints.mqtt.connection.limits import FEW_IN_FLIGHT
from shmio.endpoints.mqtt.connection.target import ReconnectPolicy, targets
from shmio.endpoints.mqtt.feed import Feed
from shmio.endpoints.mqtt.outbox import OVERHEAD_BYTES
from shmio.endpoints.mqtt.sparkplug.device import Device, DeviceEvent
from shmio.endpoints.mqtt.sparkplug.node import NAMESPACE, EdgeNode, Sample
from shmio.errors import CommandError, PathError, ValueRangeError
from shmio.layout.glob import Glob
from shmio.layout.model import Register
from shmio.layout.topic import shorten
from shmio.segment import DONE, EventKind, Segment

SAMPLE_BYTES: Final = 96
"""Of one in memory, about, beside its value."""
ELEMENT_BYTES: Final = 32
"""Of a number in memory, with its place in a list."""


class DeviceBacklog(Backlog[list[Sample]]):
    """Of each device what its frames brought, in order."""

    def keep(self, device: str, samples: list[Sample]) -> None:
        """Keep what one frame brought."""
        self.put(samples, OVERHEAD_BYTES + sum(map(_size, samples)), row=device, changes=len(samples))

    def take(self, device: str) -> list[Sample]:
        """The oldest of a device; empty: there is nothing."""
        return self.pop(device) or []


def _size(sample: Sample) -> int:
    register = sample.metric.register
    return SAMPLE_BYTES + max(ELEMENT_BYTES * register.count, register.size)


AHEAD_MS: Final = 86_400_000
"""The clock of a host may be ahead of ours, by no more than this."""

log = logging.getLogger("shmio.mqtt")


class _State(msgspec.Struct):
    online: bool
    timestamp: int | float


class PrimaryHost:
    """What it says on the present connection."""

    def __init__(self, name: str) -> None:
        self.topic = f"{NAMESPACE}/STATE/{name}"
        self.online: bool | None = None
        """None: it has said nothing."""
        self._at_ms = float("-inf")

    def forget(self) -> None:
        """There is another connection: each broker has been told at another time."""
        self.online, self._at_ms = None, float("-inf")

    def update(self, payload: bytes) -> None:
        """Take in what it says, unless it is older than what it said before: the late will of a session before."""
        try:
            state = msgspec.json.decode(payload, type=_State)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            log.warning("%s: expected JSON with online, true or false, and a timestamp", self.topic)
            return
        if state.timestamp > time.time() * 1000 + AHEAD_MS:  # none that comes would be newer
            log.warning("%s: the timestamp is more than a day ahead; it is in ms since 1970", self.topic)
        elif state.timestamp >= self._at_ms:
            self.online, self._at_ms = state.online, state.timestamp


TURN_SAMPLES: Final = 2000
"""So many of those that were kept are sent before what else there is to do has its turn."""

HOST_S: Final = 10.0
"""For a primary host to say at one of several brokers that it is there."""


class Session:
    """For the bridge's thread: :meth:`turn` in each of its turns.

    What changes while the broker takes nothing more is merged; while it is away it is kept, and sent as historical.
    """

    def __init__(
        self,
        settings: Mqtt,
        sparkplug: Sparkplug,
        segment: Segment,
        selector: selectors.BaseSelector,
        wake: Callable[[], object],
    ) -> None:
        """``selector``, ``wake``: as of :class:`BrokerConnection`. PathError: a pattern is none."""
        self.node = EdgeNode(sparkplug.group, sparkplug.node or segment.instance, datatypes=sparkplug.datatypes)
        client_id = f"{settings.client_id or f'shmio-{segment.instance}'}-sparkplug"
        # A session begins with its births: the broker is to keep nothing of one before (5.4).
        clean = msgspec.structs.replace(settings, session_expiry_s=0)
        self._policy = ReconnectPolicy(clean, client_id, targets(settings, own_socket(segment)))
        self.connection = BrokerConnection(self._policy, selector, wake, self.node.will, FEW_IN_FLIGHT)
        self.connection.on_message = self._command
        self.connection.on_lost = self._lose
        self._host = None if sparkplug.primary_host is None else PrimaryHost(sparkplug.primary_host)
        self._host_lost = False
        """Whether the host has gone since the births, though it may be back: it knows nothing of them then."""
        self._until_s = 0.0
        """So long the host has to say that it is there; then another broker is tried, if there is one."""
        self._elements = sparkplug.elements
        self._globs = [Glob(pattern) for pattern in sparkplug.patterns]
        self._devices: dict[str, Device] = {}
        self._waiting: dict[str, dict[int, None]] = {}
        self._pause_s = 1 / sparkplug.max_rate_hz if sparkplug.max_rate_hz else 0.0
        self._due_s: dict[str, float] = {}
        """When the next data of a device may be told."""
        self._backlog = DeviceBacklog(round(settings.backlog_mb * 1e6))
        self._keeping = False
        self._room = 0
        """How many that were kept may be sent in this turn."""
        self._rebirth_asked = False
        """Whether a host wants the births again. However often it says so: once a turn, when the broker takes them."""
        self._defined = False
        """Whether the node is told of all devices that there are."""
        self._sent = self._received = self._refused = self._missed = 0

    @property
    def counters(self) -> tuple[int, ...]:
        """As those of the bridge."""
        waiting = sum(map(len, self._waiting.values()))
        refused, connects = self._refused + self.connection.problems.refused, self.connection.connects
        missed = self._missed + sum(device.missed for device in self._devices.values())
        kept = self._backlog
        return self._sent, self._received, refused, waiting, kept.count, kept.dropped, connects, missed

    @property
    def problem(self) -> str:
        """What is wrong at present; empty: nothing."""
        problem = self.connection.problem
        if self._host is not None and self.connection.up and not self._host.online:
            problem = f"the primary host is not there ({self._host.topic}): {self._backlog.count} changes are kept"
        return f"Sparkplug: {problem}" if problem else ""

    def new_device(self, feed: Feed) -> Device:
        """What a source is to be; any thread may make it."""
        return Device(feed.block, feed.command_client, self._globs, elements=self._elements)

    def add_device(self, device: Device) -> None:
        """There is one more."""
        self._devices[device.block.source] = device
        self._defined = False

    def remove_device(self, source: str) -> None:
        """There is one less."""
        self._missed += self._devices.pop(source).missed
        self._defined = False

    def _define(self) -> None:
        """Tell the node what there is; if it is born already, it is born anew."""
        self._defined = True
        self.node.define({name: device.parts for name, device in self._devices.items()})
        for name, device in self._devices.items():
            device.set_metrics(list(self.node.metrics[name].values()))
        self._waiting = {name: {} for name in self._devices}
        self._backlog.clear()  # what is in it has other aliases
        if self.connection.up and self.node.alive:
            self._birth()

    def turn(self) -> float:
        """Do what is due; in how many seconds there is more."""
        if not self._defined:
            self._define()
        if self.connection.problem and not self.connection.up:
            self._keeping = True
        if self.connection.came_up:
            self.connection.came_up, self._keeping = False, True
            self.connection.subscribe(self.node.commands)
            if self._host is not None:
                self._host.forget()
                self._host_lost = False
                self.connection.subscribe([self._host.topic], retained=True)
                self._until_s = time.monotonic() + HOST_S
        if self._host is not None and (self._host_lost or not self._host.online):
            self._wait_for(self._host)
        elif self.connection.up and (not self.node.alive or (self._rebirth_asked and self.connection.room)):
            self._birth()
        self._room = TURN_SAMPLES
        for name, device in self._devices.items():
            for change in device.poll():
                self._publish(name, device, change.kind, change.at)
        self._flush()
        rest_s = self.connection.turn()  # behind what it was given, to hear when it takes the rest
        more = self._room <= 0 or self.connection.came_up or any(device.behind for device in self._devices.values())
        now_s = time.monotonic()
        due_s = [due_s for name, due_s in self._due_s.items() if due_s > now_s and self._waiting.get(name)]
        return 0.0 if more else min([rest_s, *(one_s - now_s for one_s in due_s)])

    def _wait_for(self, host: PrimaryHost) -> None:
        """Die if it has gone; go to where else it may be, and come back."""
        if not self.connection.up:
            return
        elsewhere = self._policy.count > 1 and (host.online is False or time.monotonic() >= self._until_s)
        if self.node.alive:
            self._send(self.node.death())
        elif not elsewhere:
            return
        self.connection.drop(f"the primary host is not there ({host.topic})", politely=True)

    def close(self) -> None:
        """Say that the node dies, and go.

        With MQTT 5 its will says so, too: the specification demands both (5.5, intentional-disconnect-ndeath, and
        6.4.25, ndeath-will-message-publisher-disconnect-mqtt50), and has hosts ignore the second, for its bdSeq.
        """
        alive = self.connection.up and self.node.alive
        if alive:
            self.connection.send(self.node.death())
        self.connection.close(will=alive)

    # ---- what goes out -----------------------------------------------------------------------------------------------

    def _birth(self) -> None:
        self._rebirth_asked = False
        self._send(self.node.birth())
        for name, device in self._devices.items():
            if device.alive:
                self._send(self.node.device_birth(name, device.samples()))
            self._waiting[name].clear()

    def _publish(self, name: str, device: Device, kind: DeviceEvent, at: Sequence[int]) -> None:
        if not (self.connection.up and self.node.alive):
            if self._keeping and kind is not DeviceEvent.DEATH:
                self._keep(name, device, range(len(device.parts)) if kind is DeviceEvent.BIRTH else at)
            return
        if kind is DeviceEvent.DATA:
            self._waiting[name] |= dict.fromkeys(at)
            self._flush_device(name, device)  # so that each frame's changes are told, as long as the broker takes them
            return
        self._waiting[name].clear()
        if kind is DeviceEvent.BIRTH:
            self._send(self.node.device_birth(name, device.samples()))
        elif self.node.is_born(name):
            self._send(self.node.device_death(name))

    def _keep(self, name: str, device: Device, at: Sequence[int]) -> None:
        """Keep what has changed, no more often than it would be told."""
        self._waiting[name] |= dict.fromkeys(at)
        if self._is_due(name):
            self._backlog.keep(name, device.samples(list(self._waiting[name])))
            self._waiting[name].clear()

    def _is_due(self, name: str) -> bool:
        """Whether data of a device may be told; from now on, not for a while."""
        now_s = time.monotonic()
        if now_s < self._due_s.get(name, 0.0):
            return False
        self._due_s[name] = now_s + self._pause_s
        return True

    def _lose(self, _unacknowledged: Sequence[Message]) -> None:
        """The connection is gone: keep what waited for it."""
        for name, device in self._devices.items():
            waiting = self._waiting[name]
            if waiting and device.alive:
                self._backlog.keep(name, device.samples(list(waiting)))
            waiting.clear()

    def _flush(self) -> None:
        for name, device in self._devices.items():
            self._flush_device(name, device)

    def _flush_device(self, name: str, device: Device) -> None:
        """What has changed, then what was kept, as history; before its birth nobody knows its metrics."""
        connection, waiting = self.connection, self._waiting[name]
        if not self.node.is_born(name):
            return
        if waiting and connection.room and self._is_due(name):
            self._send(self.node.data(name, device.samples(list(waiting))))
            waiting.clear()
        while self._room > 0 and connection.room and (samples := self._backlog.take(name)):
            self._room -= len(samples)
            self._send(self.node.data(name, samples, historical=True))

    def _send(self, message: Message) -> None:
        self._sent += 1
        self.connection.send(message)
        self.connection.push()

    # ---- what comes --------------------------------------------------------------------------------------------------

    def _command(self, message: MQTTMessage) -> None:
        try:
            topic = message.topic
        except UnicodeDecodeError:
            self._refused += 1
            return
        if self._host is not None and topic == self._host.topic:
            self._host.update(bytes(message.payload))
            self._host_lost = self._host_lost or (self.node.alive and not self._host.online)
            return
        self._received += 1
        if message.retain:  # it was there before we were
            self._refused += 1
            return
        try:
            command = self.node.command(topic, bytes(message.payload), self._check)
        except (CommandError, PathError, ValueRangeError) as error:
            self._refuse(str(error))
            return
        if command.rebirth:
            self._rebirth_asked = True
            return
        device = self._devices[command.device]
        for path, value in command.values.items():
            register = self.node.metrics[command.device][path].register
            try:
                device.command_client.send(register, value, _Outcome(f"{command.device}/{path}"))
            except (CommandError, ValueRangeError) as error:
                self._refuse(str(error))

    def _check(self, device: str, register: Register) -> None:
        self._devices[device].command_client.check(register)

    def _refuse(self, why: str) -> None:
        self._refused += 1
        log.warning("Sparkplug command: %s", shorten(why, 500))  # the topic may be as long as any


class _Outcome:
    """Sparkplug has no answer to a command but the value that comes: what was not done is in the log."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __call__(self, kind: EventKind, reason: str) -> None:
        if kind not in DONE:
            log.warning("Sparkplug command: %s: %s: %s", self._path, kind, reason)
