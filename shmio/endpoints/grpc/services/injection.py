"""Injections of SimlogAPI clients.

An injection has shadow topics. From one, clients read the values that the injection diverts; to the
other, they write the values to give instead.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from typing import Final, NamedTuple, cast

from shmio.endpoints.commands_in_flight import Done
from shmio.endpoints.grpc.commands import command_client
from shmio.endpoints.grpc.commands.injections import InjectionBase, InjectionFollower
from shmio.endpoints.grpc.commands.write_subscriptions import Listener
from shmio.endpoints.grpc.encoding import Encode, ShownImage, SourceImage, Subject
from shmio.endpoints.grpc.server.connections import Peer, connected, peer_of
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outbox import EventLane, Finish, Outbox, StateLane
from shmio.endpoints.grpc.topics import Shape, TimeTopic, Topics
from shmio.errors import CommandError, ConflictError, EndpointError, PathError, ValueRangeError
from shmio.layout.topic import Topic, encode_segment, find, shorten
from shmio.layout.values.write import covering, encode
from shmio.local.writer import RETIRED
from shmio.segment import DONE, Direction, EventKind
from shmio.segment.changed_registers import ChangeScan
from shmio.segment.commands import CommandWrites, End, apply, worst

MAX_INJECTIONS: Final = 64
"""Maximum number of injections that this endpoint may have on one source."""
MAX_PATH: Final = 1024
"""Maximum length of the path or the prefix of a shadow topic, in characters."""
LOOK_S: Final = 0.25
"""Interval in s of the checks for disconnected clients. The injections of such a client end within a second."""
UNSEEN_S: Final = 10.0
"""Lifetime in s of an injection that no stream uses, if the kernel does not list its client's connection."""

_TIME_TOPICS: Final = frozenset(topic.value for topic in TimeTopic)
_SCHEME: Final = re.compile(r"^[^/:]*://")

log = logging.getLogger("shmio.grpc")

Leave = Callable[[], None]
"""Function that ends a subscription."""


class _ImageStream:
    """The listeners to an injection's originals, or to its given values. All share one encoding."""

    def __init__(self) -> None:
        self._channels: dict[str, tuple[Encode, set[Listener]]] = {}

    def __bool__(self) -> bool:
        return any(listeners for _, listeners in self._channels.values())

    def listen(self, wire: str, encode: Encode, listener: Listener) -> Leave:
        self._channels.setdefault(wire, (encode, set()))[1].add(listener)
        return partial(self._leave, wire, listener)

    def _leave(self, wire: str, listener: Listener) -> None:
        self._channels[wire][1].discard(listener)

    def show(self, shown: ShownImage) -> None:
        for to_message, listeners in self._channels.values():
            message = to_message(shown) if listeners else None
            if message is not None:
                for listener in listeners:
                    listener.deliver(message)

    def fail(self, reason: str) -> None:
        for _, listeners in self._channels.values():
            for listener in list(listeners):
                listener.fail(reason)


class Injection(InjectionFollower):
    """An injection over the registers of ``shape``, from its creation to its end.

    ``shape`` has the registers that ``target`` names in the layout of ``feed``. The *originals* of
    an injection are the values that it diverts: over ``/out``, those that the source or inner
    injections deliver; over ``/in``, those that writers send. The *given values* are those that
    clients send to the injection to replace the originals. Use it only in the event loop's thread.
    """

    def __init__(self, target: Topic, shape: Shape, feed: Feed, name: str) -> None:
        """Start creating the injection.

        Args:
            target: The topic of the injection.
            shape: The registers that the target names.
            feed: The feed of the source.
            name: Name of the injection in the list of all injections.

        """
        self.target = target
        self.shape = shape
        self.feed = feed
        self.inward = target.direction == "in"
        self.over = ""
        """Why the injection has ended; empty while it lasts."""
        self.ends: dict[object, Callable[[], object]] = {}
        """Functions to call when the injection ends, by the object that added them."""
        frame = feed.block.latest()
        self._base = InjectionBase(feed.block, frame.image if frame else b"")
        self._given_image = bytearray(self._base.given)
        self._scan = ChangeScan(shape.registers, feed.block.statuses)
        self._subjects: dict[Subject, None] = {}
        self._diverted, self._given = _ImageStream(), _ImageStream()
        self._creating = asyncio.get_running_loop().create_task(self._create(name))
        self._creating.add_done_callback(lambda task: task.cancelled() or task.exception())  # created() raises it
        self._lifting: asyncio.Task[None] | None = None

    # ---- created, and lifted --------------------------------------------------------------------------------------

    async def created(self) -> None:
        """Wait until the source has created the injection.

        Raises:
            CommandError: The source refused the injection, or does not answer.

        """
        await asyncio.shield(self._creating)

    async def _create(self, name: str) -> None:
        direction = Direction.IN if self.inward else Direction.OUT
        try:
            if self.feed.block.retired:
                raise CommandError(RETIRED)
            answer = command_client.Answer()
            bits = covering(self.shape.registers, self.feed.block.layout.size)
            self._base.number = self.feed.commands.inject(bits, self, answer.done, direction=direction, name=name)
            ((kind, reason),) = await answer
            if kind is not EventKind.INJECTED:
                raise CommandError(f"{kind}: {reason}")
        except CommandError as error:
            self._finish(str(error))
            raise CommandError(f"{self.target}: {error}") from None
        finally:
            if self.over:  # ended meanwhile, or the source may have created it without answering
                self._have_it_lifted()

    def end(self, reason: str) -> None:
        """Lift the injection.

        Args:
            reason: Why the injection is lifted. It becomes :attr:`over`.

        """
        if not self.over:
            self._finish(reason)
            if self._creating.done():
                self._have_it_lifted()

    def _have_it_lifted(self) -> None:
        lifting = command_client.have_lifted(self.feed.commands, self._base.number, str(self.target))
        self._lifting = asyncio.get_running_loop().create_task(lifting)

    def _finish(self, reason: str) -> None:
        self.over = self.over or reason
        ends, self.ends = self.ends, {}
        for call in ends.values():
            call()

    # ---- given values ------------------------------------------------------------------------

    def ready(self, values: Mapping[str, object]) -> bool:
        """Return whether :meth:`give` would send these values without waiting."""
        return self._creating.done() and self.feed.commands.ready(values)

    async def give(self, values: Mapping[str, object], done: Done, accepted: Callable[[], None] | None = None) -> None:
        """Send given values of this injection to the source.

        Args:
            values: Values by register path.
            done: Called once, with the outcome of each write.
            accepted: Called if the source accepts the command; None to call nothing.

        Raises:
            PathError: The injection has ended.
            CommandError: The source does not answer. Nothing was sent.
            ValueRangeError: A value does not fit its register. Nothing was sent.

        """
        await self.created()
        if self.over:
            raise PathError(f"the injection over {self.target} has ended: {self.over}")
        shown = False

        def show() -> None:
            nonlocal shown
            if not shown:
                shown = True
                self._show_given(values)

        def on_accepted() -> None:
            show()
            if accepted is not None:
                accepted()

        def on_done(ends: Sequence[End]) -> None:
            if worst(ends)[0] in DONE:
                show()
            done(ends)

        await self.feed.commands.give(self._base.number, values, on_done, on_accepted)

    def _show_given(self, values: Mapping[str, object]) -> None:
        layout = self.feed.block.layout
        for path, value in values.items():
            apply(self._given_image, encode(find(layout, path), value, layout.byte_order))
        if self._given and (now := self.feed.present() or self.feed.block.latest()):
            self._given.show(ShownImage(now.number, now.clock_ns, bytes(self._given_image)))

    def given_values(self, wire: str, encode: Encode, lane: EventLane) -> Leave:
        """Listen to the values that are given from now on.

        Args:
            wire: Name of the encoding.
            encode: Encodes an image as a message.
            lane: Gets the messages.

        Returns:
            The function that ends the subscription.
        """
        return self._given.listen(wire, encode, lane)

    # ---- originals ---------------------------------------------------------------------------

    def originals(self, wire: str, encode: Encode, outbox: Outbox, path: str, finish: Finish = bytes) -> Leave:
        """Listen to the originals. Over ``/out``, the listener gets the present value first.

        Args:
            wire: Name of the encoding.
            encode: Encodes an image as a message.
            outbox: The stream that gets the messages.
            path: Path of the topic, for the text of a failure.
            finish: Completes a message when it is sent.

        Returns:
            The function that ends the subscription.

        """
        if self.inward:
            return self._diverted.listen(wire, encode, EventLane(outbox, path, finish))
        subject = Subject(
            f"{wire} originals of {id(self)}",
            self.shape.path,
            self.shape.registers,
            lambda picture: encode(self._original(cast(SourceImage, picture))),
            self._changed,
        )
        self._subjects.setdefault(subject)
        lane = StateLane(outbox, finish)
        self.feed.listen(subject, lane)
        return partial(self.feed.leave, subject, lane)

    def present(self) -> ShownImage | None:
        """Return the present originals of an injection over ``/out``.

        Returns:
            The image; None if the quality is not good, or if the injection is over ``/in``.

        """
        frame = None if self.inward else self.feed.present()
        return None if frame is None else self._original(frame)

    def _original(self, frame: SourceImage) -> ShownImage:
        return ShownImage(frame.number, frame.clock_ns, self._base.image(frame.raw))

    def _changed(self, shown: SourceImage, frame: SourceImage) -> bool:
        return bool(self._scan.changed(self._original(shown).image, self._original(frame).image))

    def _tell_again(self) -> None:
        for subject in self._subjects:
            self.feed.deliver_again(subject)

    # ---- events of the source ----------------------------------------------------------------

    def divert(self, diverted: CommandWrites) -> None:
        """Handle a command whose values were diverted to the injection."""
        self._base.divert(diverted.writes)
        if self.inward:
            self._diverted.show(ShownImage(*self.feed.commands.stamp(diverted.event), bytes(self._base.given)))
        else:
            self._base.restack()
            self._tell_again()

    def restack(self) -> None:
        """Handle a change of the source's injections, this one included."""
        if not self.inward and self._base.restack():
            self._tell_again()

    def lifted(self, reason: str) -> None:
        """Handle the end of an injection that another program has lifted, or that ended with its source."""
        self._finish(f"it was lifted: {reason}" if reason != "lifted" else "another program has lifted it")

    def fail(self, reason: str) -> None:
        """End the streams of originals with an error, because events were missed."""
        self._diverted.fail(reason)


class ShadowKind(Enum):
    """The kinds of shadow topics."""

    GIVEN = "gifts"
    """The topic of the given values. Clients write to it, and read what all clients have written."""
    ORIGINALS = "originals"
    """The topic of the originals. Clients read from it the values that the injection diverts."""


class Shadow(NamedTuple):
    """A shadow topic: the injection that it belongs to, and its kind."""

    injection: Injection
    kind: ShadowKind


@dataclass(frozen=True, eq=False)
class _Client:
    """A client that uses an injection without a stream.

    ``peer`` is None if the kernel does not list the client's connection. Then the use ends at
    ``until_s``, in s of the monotonic clock.
    """

    peer: Peer | None
    until_s: float


class Shadows:
    """All shadow topics and their injections. An injection is lifted when no client uses it any more."""

    def __init__(self, topics: Topics) -> None:
        self._topics = topics
        self._named: dict[str, Shadow] = {}
        self._users: dict[Injection, set[object]] = {}
        self._releasing: asyncio.Task[None] | None = None

    def find(self, path: str) -> Shadow | None:
        """Return the shadow topic that a path names; None if there is none."""
        return self._named.get(self._topics.name(path)) if self._named else None

    async def create(
        self, target: Topic, shape: Shape, kinds: Mapping[str, ShadowKind], user: object, peer: str
    ) -> Injection:
        """Create an injection with these shadow topics, or join the injection that has them already.

        Args:
            target: The topic to create the injection over.
            shape: The registers that the target names.
            kinds: The kind of each shadow topic, by path.
            user: The object that keeps the injection alive until :meth:`release`.
            peer: The client, for the list of all injections.

        Raises:
            ValueRangeError: A shadow topic is the target itself.
            ConflictError: A path is in use for another target.
            EndpointError: There are too many injections.
            CommandError: The source refused the injection.
            PathError: A reload has removed the source.

        """
        target = replace(target, direction=target.direction or "out")
        injection = self._joined(target, kinds)
        if injection is None:
            feed = self._topics.feed(target.source)
            if sum(other.feed is feed for other in self._users) >= MAX_INJECTIONS:
                raise EndpointError(
                    f"{MAX_INJECTIONS} injections cover {target.source} already, which is the maximum; end one first"
                )
            injection = Injection(target, shape, feed, f"{shorten(next(iter(kinds)), 60)} of {shorten(peer, 40)}")
            self._named |= {self._topics.name(path): Shadow(injection, kind) for path, kind in kinds.items()}
            self._users[injection] = set()
            injection.ends[self] = partial(self._forget, injection)
        self._users[injection].add(user)
        try:
            await injection.created()
        except BaseException:
            self.release(injection, user)
            raise
        return injection

    async def lay_for_client(
        self, target: Topic, shape: Shape, kinds: Mapping[str, ShadowKind], peer: str
    ) -> Injection:
        """Create or join an injection, as :meth:`create` does, for a client that has no stream for it yet.

        The client's connection keeps the injection alive until a stream takes it over.
        """
        seen = peer_of(peer)
        if seen not in await asyncio.to_thread(connected):
            seen = None
        client = _Client(seen, time.monotonic() + UNSEEN_S)
        injection = await self.create(target, shape, kinds, client, peer)
        if self._releasing is None:
            self._releasing = asyncio.get_running_loop().create_task(self._release_abandoned())
        return injection

    def take_over(self, injection: Injection, stream: object) -> None:
        """Make a stream the user of an injection, in place of the clients without a stream."""
        users = self._users.get(injection, set())
        users.difference_update([user for user in users if isinstance(user, _Client)])
        users.add(stream)

    def release(self, injection: Injection, user: object) -> None:
        """End a client's use of an injection. The injection is lifted when its last use ends."""
        users = self._users.get(injection, set())
        if user in users:
            users.remove(user)
            if not users:
                injection.end("no client uses the injection any more")

    def on_sources_replaced(self, sources: Collection[str]) -> None:
        """End the injections on these sources, because a reload has replaced their blocks."""
        for injection in list(self._users):
            if injection.target.source in sources:
                injection.end(RETIRED)

    def _joined(self, target: Topic, kinds: Mapping[str, ShadowKind]) -> Injection | None:
        """Return the injection that already has these shadow topics, or None.

        Raises:
            ValueRangeError: A topic is the target itself.
            ConflictError: A topic is in use for another target.

        """
        found: Injection | None = None
        for path, kind in kinds.items():
            name = self._topics.name(path)
            if name == str(target):
                raise ValueRangeError(
                    f"{shorten(path)} is the target of the injection; choose another path for the shadow"
                )
            shadow = self._named.get(name)
            if name in _TIME_TOPICS or (shadow and (shadow.injection.target != target or shadow.kind is not kind)):
                use = f"the shadow of {shadow.injection.target}" if shadow else "served by shmio"
                raise ConflictError(f"{shorten(path)} is {use}; name another path")
            found = shadow.injection if shadow else found
        return found

    def _forget(self, injection: Injection) -> None:
        log.info("the injection over %s has ended: %s", injection.target, injection.over)
        del self._users[injection]
        self._named = {name: shadow for name, shadow in self._named.items() if shadow.injection is not injection}

    async def _release_abandoned(self) -> None:
        """Release the injections of disconnected clients that had no stream."""
        while clients := self._clients():
            await asyncio.sleep(LOOK_S)
            there = await asyncio.to_thread(connected)
            for injection, client in clients:
                gone = time.monotonic() > client.until_s if client.peer is None else client.peer not in there
                if gone:
                    self.release(injection, client)
        self._releasing = None

    def _clients(self) -> list[tuple[Injection, _Client]]:
        return [
            (injection, user) for injection, users in self._users.items() for user in users if isinstance(user, _Client)
        ]


def shadow_path(path: str) -> str:
    """Return the path that a client wants for a shadow topic, if it is usable.

    Raises:
        ValueRangeError: The path is not usable.

    """
    if not path.strip("/") or len(path) > MAX_PATH or not path.isprintable():
        raise ValueRangeError(
            f"the path of a shadow must have 1 to {MAX_PATH} printable characters, not {shorten(path)!r}"
        )
    return path


def shadow_paths(prefix: str, target: Topic) -> tuple[str, str]:
    """Return the paths of a target's two shadow topics: for given values, and for originals.

    Many targets may share a prefix.

    Raises:
        ValueRangeError: The prefix is not usable.

    """
    if len(prefix) > MAX_PATH or not prefix.isprintable():
        raise ValueRangeError(
            f"shadowPathPrefix must have at most {MAX_PATH} printable characters, not {shorten(prefix)!r}"
        )
    names = [encode_segment(name) for name in _SCHEME.sub("", prefix).split("/") if name]
    base = "/".join([*names, encode_segment(str(replace(target, direction=target.direction or "out")))])
    return f"SIMLOG://{base}/in", f"SIMLOG://{base}/out"
