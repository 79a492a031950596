"""Publishes an instance as an edge node of Sparkplug B.

The edge node has its own connection, because a connection has only one will, and the bridge's
connection has a different will.
"""

from __future__ import annotations

import logging
import selectors
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final

import msgspec
from paho.mqtt.client import MQTTMessage

from shmio.audit.trail import Actor, Attempt, acting
from shmio.config import Mqtt, Sparkplug
from shmio.endpoints.mqtt.broker.directory import own_socket
from shmio.endpoints.mqtt.commands import RETAINED
from shmio.endpoints.mqtt.connection.connection import FEW_IN_FLIGHT, BrokerConnection
from shmio.endpoints.mqtt.connection.reconnect import ReconnectPolicy, targets
from shmio.endpoints.mqtt.feed import Feed
from shmio.endpoints.mqtt.outbox import OVERHEAD_BYTES, Backlog
from shmio.endpoints.mqtt.sparkplug.device import Device, DeviceEvent
from shmio.endpoints.mqtt.sparkplug.node import NAMESPACE, EdgeNode, Sample
from shmio.endpoints.mqtt.topics import Message
from shmio.errors import CommandError, PathError, ValueRangeError
from shmio.layout.glob import Glob
from shmio.layout.model import Register
from shmio.layout.topic import shorten
from shmio.segment import DONE, Block, EventKind, Segment

SAMPLE_BYTES: Final = 96
"""Approximate memory that a sample needs in addition to its value, in bytes."""
ELEMENT_BYTES: Final = 32
"""Approximate memory that each number in a list needs, in bytes."""
TURN_SAMPLES: Final = 2000
"""Maximum number of samples of the backlog that are sent in one go, before the bridge does other work."""
AHEAD_MS: Final = 86_400_000
"""Maximum time in ms by which the clock of a primary host may be ahead of the clock of this computer."""
HOST_S: Final = 10.0
"""Time in s that a primary host has to announce itself at one of several brokers."""

log = logging.getLogger("shmio.mqtt")


class DeviceBacklog(Backlog[list[Sample]]):
    """A backlog with a row for each device. Each item of a row has the samples of one frame."""

    def keep(self, device: str, samples: list[Sample]) -> None:
        """Add the samples of one frame."""
        self.put(samples, OVERHEAD_BYTES + sum(map(_size, samples)), row=device, changes=len(samples))

    def take(self, device: str) -> list[Sample]:
        """Remove and return a device's oldest samples, those of one frame; an empty list if there are none."""
        return self.pop(device) or []


class _State(msgspec.Struct):
    online: bool
    timestamp: int | float


class PrimaryHost:
    """The state of the primary host, as the host has published it at the present broker."""

    def __init__(self, name: str) -> None:
        self.topic = f"{NAMESPACE}/STATE/{name}"
        self.online: bool | None = None
        """True if the host is online; None if the host has published no state here."""
        self._at_ms = float("-inf")

    def forget(self) -> None:
        """Forget the state, because at another broker the published state may be older."""
        self.online, self._at_ms = None, float("-inf")

    def update(self, payload: bytes) -> None:
        """Adopt the state in a message.

        A message that is older than the last one is ignored: it may be the late will of an earlier
        session.
        """
        try:
            state = msgspec.json.decode(payload, type=_State)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            log.warning(
                "the bridge ignored a state message on %s, which is not JSON such as "
                '{"online": true, "timestamp": 1700000000000}',
                self.topic,
            )
            return
        if state.timestamp > time.time() * 1000 + AHEAD_MS:  # no later message would be newer
            log.warning("%s: the timestamp is more than a day ahead; it has to be in ms since 1970", self.topic)
        elif state.timestamp >= self._at_ms:
            self.online, self._at_ms = state.online, state.timestamp


class Session:
    """The Sparkplug session of an instance. Call :meth:`run_once` in each turn of the bridge's thread.

    While the broker is slow, changes of a metric are merged. While there is no broker, changes are
    kept, and are sent later as historical values.
    """

    def __init__(
        self,
        settings: Mqtt,
        sparkplug: Sparkplug,
        segment: Segment,
        selector: selectors.BaseSelector,
        wake: Callable[[], object],
    ) -> None:
        """Create the session, without devices.

        Args:
            settings: The configuration's ``[mqtt]`` section.
            sparkplug: The configuration's ``[mqtt.sparkplug]`` section.
            segment: The instance's shared memory.
            selector: The connection registers its socket here.
            wake: Called, from any thread, when :meth:`run_once` must run.

        Raises:
            PathError: A pattern is not valid.

        """
        self.node = EdgeNode(sparkplug.group, sparkplug.node or segment.instance, datatypes=sparkplug.datatypes)
        client_id = f"{settings.client_id or f'shmio-{segment.instance}'}-sparkplug"
        # A session begins with births: the broker must keep nothing of the session before (5.4).
        clean = msgspec.structs.replace(settings, session_expiry_s=0)
        self._policy = ReconnectPolicy(clean, client_id, targets(settings, own_socket(segment)))
        self.connection = BrokerConnection(self._policy, selector, wake, self.node.will, FEW_IN_FLIGHT)
        self.connection.on_message = self._command
        self.connection.on_lost = self._lose
        self._host = None if sparkplug.primary_host is None else PrimaryHost(sparkplug.primary_host)
        self._host_lost = False
        """True if the host went offline after the births. When it returns, it needs new births."""
        self._until_s = 0.0
        """Deadline for the host to announce itself. Then the session tries the next broker."""
        self._elements = sparkplug.elements
        self._globs = [Glob(pattern) for pattern in sparkplug.patterns]
        self._devices: dict[str, Device] = {}
        self._waiting: dict[str, dict[int, None]] = {}
        self._pause_s = 1 / sparkplug.max_rate_hz if sparkplug.max_rate_hz else 0.0
        self._due_s: dict[str, float] = {}
        """Time at which the next data of each device may be sent."""
        self._backlog = DeviceBacklog(round(settings.backlog_mb * 1e6))
        self._keeping = False
        self._room = 0
        """Number of samples of the backlog that may still be sent in this turn."""
        self._rebirth_asked = False
        """True if a host has asked for the births.

        A turn sends the births at most once, and only if there is room.
        """
        self._defined = False
        """True if the node's definition includes all current devices."""
        self._sent = self._received = self._refused = self._missed = 0

    @property
    def counters(self) -> tuple[int, ...]:
        """The counters, in the same order as the bridge's."""
        waiting = sum(map(len, self._waiting.values()))
        refused, connects = self._refused + self.connection.problems.refused, self.connection.connects
        missed = self._missed + sum(device.missed for device in self._devices.values())
        kept = self._backlog
        return (
            self._sent, self._received, refused, waiting, kept.count, kept.dropped, connects, missed,
            self.connection.sent_bytes,
        )  # fmt: skip

    @property
    def readers(self) -> Iterator[tuple[Block, int]]:
        """The blocks that the session reads, each with the number of the last frame read."""
        return ((device.block, device.last) for device in self._devices.values())

    @property
    def problem(self) -> str:
        """The current problem; empty if there is none."""
        problem = self.connection.problem
        if self._host is not None and self.connection.up and not self._host.online:
            problem = f"the primary host is offline ({self._host.topic}): {self._backlog.count} changes are kept"
        return f"Sparkplug: {problem}" if problem else ""

    def new_device(self, feed: Feed) -> Device:
        """Create the device of a source. You may call this from any thread."""
        return Device(feed.block, feed.command_client, self._globs, elements=self._elements)

    def add_device(self, device: Device) -> None:
        """Add a device."""
        self._devices[device.block.source] = device
        self._defined = False

    def remove_device(self, source: str) -> None:
        """Remove a device."""
        self._missed += self._devices.pop(source).missed
        self._defined = False

    def _define(self) -> None:
        """Define the node's devices. If the node is born already, publish new births."""
        self._defined = True
        self.node.define({name: device.parts for name, device in self._devices.items()})
        for name, device in self._devices.items():
            device.set_metrics(list(self.node.metrics[name].values()))
        self._waiting = {name: {} for name in self._devices}
        self._backlog.clear()  # its samples have the old aliases
        if self.connection.up and self.node.alive:
            self._birth()

    def run_once(self) -> float:
        """Do the work that is due. Return the time in s after which to call this method again."""
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
        rest_s = self.connection.run_once()  # after sending, because it returns when there is room for more
        more = self._room <= 0 or self.connection.came_up or any(device.behind for device in self._devices.values())
        now_s = time.monotonic()
        due_s = [due_s for name, due_s in self._due_s.items() if due_s > now_s and self._waiting.get(name)]
        return 0.0 if more else min([rest_s, *(one_s - now_s for one_s in due_s)])

    def _wait_for(self, host: PrimaryHost) -> None:
        """While the host is offline, publish the node's death, and try other brokers."""
        if not self.connection.up:
            return
        elsewhere = self._policy.count > 1 and (host.online is False or time.monotonic() >= self._until_s)
        if self.node.alive:
            self._send(self.node.death())
        elif not elsewhere:
            return
        self.connection.drop(f"the primary host is offline ({host.topic})", politely=True)

    def close(self) -> None:
        """Publish the death of the node, and disconnect.

        With MQTT 5 the broker also publishes the will. The specification demands both (5.5,
        intentional-disconnect-ndeath, and 6.4.25, ndeath-will-message-publisher-disconnect-mqtt50).
        Hosts ignore the second message by its bdSeq.
        """
        alive = self.connection.up and self.node.alive
        if alive:
            self.connection.send(self.node.death())
        self.connection.close(will=alive)

    # ---- sending -----------------------------------------------------------------------------------------------------

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
            self._flush_device(name, device)  # publishes the changes of each frame as long as the broker keeps up
            return
        self._waiting[name].clear()
        if kind is DeviceEvent.BIRTH:
            self._send(self.node.device_birth(name, device.samples()))
        elif self.node.is_born(name):
            self._send(self.node.device_death(name))

    def _keep(self, name: str, device: Device, at: Sequence[int]) -> None:
        """Keep changes in the backlog, at the rate at which they would be sent."""
        self._waiting[name] |= dict.fromkeys(at)
        if self._is_due(name):
            self._backlog.keep(name, device.samples(list(self._waiting[name])))
            self._waiting[name].clear()

    def _is_due(self, name: str) -> bool:
        """Return whether data of a device may be sent now.

        If so, this starts the pause before the next data.
        """
        now_s = time.monotonic()
        if now_s < self._due_s.get(name, 0.0):
            return False
        self._due_s[name] = now_s + self._pause_s
        return True

    def _lose(self, _unacknowledged: Sequence[Message]) -> None:
        """Move the waiting changes to the backlog, because the connection was lost."""
        for name, device in self._devices.items():
            waiting = self._waiting[name]
            if waiting and device.alive:
                self._backlog.keep(name, device.samples(list(waiting)))
            waiting.clear()

    def _flush(self) -> None:
        for name, device in self._devices.items():
            self._flush_device(name, device)

    def _flush_device(self, name: str, device: Device) -> None:
        """After a device's birth, send its changes, then its backlog as historical values."""
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

    # ---- receiving ---------------------------------------------------------------------------------------------------

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
        with acting(Actor("anonymous", "", f"broker {self.connection.at}"), "sparkplug"):
            self._carry_out(topic, message)

    def _carry_out(self, topic: str, message: MQTTMessage) -> None:
        whole = Attempt("write", {"topic": topic})
        if message.retain:  # the broker stored it before we connected
            self._refused += 1
            whole.end("refused", RETAINED)
            return
        try:
            with whole:
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
                with Attempt("write", {f"{command.device}/{path}": value}) as attempt:
                    device.command_client.send(register, value, _Outcome(f"{command.device}/{path}"), attempt)
            except (CommandError, ValueRangeError) as error:
                self._refuse(str(error))

    def _check(self, device: str, register: Register) -> None:
        self._devices[device].command_client.check(register)

    def _refuse(self, why: str) -> None:
        self._refused += 1
        log.warning("the node refused a Sparkplug command: %s", shorten(why, 500))  # the topic may be long


class _Outcome:
    """Logs a failed command, because Sparkplug answers a command only by the new value."""

    def __init__(self, path: str) -> None:
        self._path = path

    def __call__(self, kind: EventKind, reason: str) -> None:
        if kind not in DONE:
            log.warning("the Sparkplug command for %s was not carried out: %s: %s", self._path, kind, reason)


def _size(sample: Sample) -> int:
    register = sample.metric.register
    return SAMPLE_BYTES + max(ELEMENT_BYTES * register.count, register.size)
