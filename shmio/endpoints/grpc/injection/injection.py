"""One injection of this endpoint's clients: what it diverts goes to them, what they give goes to its source."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple, cast

from shmio.endpoints.grpc.commands import command_client
from shmio.endpoints.grpc.commands.followers import InjectionFollower
from shmio.endpoints.grpc.commands.path_kind import Shape
from shmio.endpoints.grpc.commands.write_subscriptions import Listener
from shmio.endpoints.grpc.injection.injection_base import InjectionBase
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outbox import EventLane, Finish, Outbox, StateLane
from shmio.endpoints.grpc.streams.subject import Encode, SourceImage, Subject
from shmio.endpoints.in_flight import Done, End, worst
from shmio.errors import CommandError, PathError
from shmio.layout.topic import Topic, find
from shmio.layout.values.write import covering, encode
from shmio.local.writer import RETIRED
from shmio.segment import DONE, Direction, EventKind
from shmio.segment.changed_registers import ChangeScan
from shmio.segment.pending_commands import CommandWrites, apply

Leave = Callable[[], None]


class ShownImage(NamedTuple):
    """An image as one of an injection's topics shows it."""

    number: int
    clock_ns: int
    image: bytes


class _Tap:
    """Those who are shown every value that goes one way; each wire's message is made once."""

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
    """One, from being laid until it is lifted, by whomever. For the event loop, but what a feed calls.

    It is laid over the registers of ``shape``, which is what ``target`` names in the layout of ``feed``. Its
    *originals* are what it diverts: over ``/out`` what comes from the source, or from injections beneath it; over
    ``/in`` what is written. Its *gifts* are what its clients give instead.
    """

    def __init__(self, target: Topic, shape: Shape, feed: Feed, name: str) -> None:
        """``name``: what it is called in the list of all; laying begins at once."""
        self.target = target
        self.shape = shape
        self.feed = feed
        self.inward = target.direction == "in"
        self.over = ""
        """Why it stands no more; empty: it does, or is about to."""
        self.ends: dict[object, Callable[[], object]] = {}
        """What is called when it is over, by whom it is for."""
        frame = feed.block.latest()
        self._base = InjectionBase(feed.block, frame.image if frame else b"")
        self._given_image = bytearray(self._base.given)
        self._scan = ChangeScan(shape.registers)
        self._subjects: dict[Subject, None] = {}
        self._diverted, self._given = _Tap(), _Tap()
        self._laid = asyncio.get_running_loop().create_task(self._lay(name))
        self._laid.add_done_callback(lambda laid: laid.cancelled() or laid.exception())  # told to who waits, if any
        self._lifting: asyncio.Task[None] | None = None

    # ---- laid, and lifted --------------------------------------------------------------------------------------

    async def laid(self) -> None:
        """Wait until it stands. CommandError: the source refuses it, or does not answer."""
        await asyncio.shield(self._laid)

    async def _lay(self, name: str) -> None:
        direction = Direction.IN if self.inward else Direction.OUT
        try:
            if self.feed.block.retired:
                raise CommandError(RETIRED)
            answer = command_client.Answer()
            bits = covering(self.shape.registers, self.feed.block.layout.size)
            self._base.number = self.feed.commands.lay(bits, self, answer.done, direction=direction, name=name)
            ((kind, reason),) = await answer
            if kind is not EventKind.INJECTED:
                raise CommandError(f"{kind}: {reason}")
        except CommandError as error:
            self._finish(str(error))
            raise CommandError(f"{self.target}: {error}") from None
        finally:
            if self.over:  # by now, or because it is not known whether it stands
                self._have_it_lifted()

    def end(self, reason: str) -> None:
        """Have it lifted."""
        if not self.over:
            self._finish(reason)
            if self._laid.done():
                self._have_it_lifted()

    def _have_it_lifted(self) -> None:
        lifting = command_client.have_lifted(self.feed.commands, self._base.number, str(self.target))
        self._lifting = asyncio.get_running_loop().create_task(lifting)

    def _finish(self, reason: str) -> None:
        self.over = self.over or reason
        ends, self.ends = self.ends, {}
        for call in ends.values():
            call()

    # ---- what its clients give ---------------------------------------------------------------------------------

    def ready(self, values: Mapping[str, object]) -> bool:
        """Whether :meth:`give` would not have to wait."""
        return self._laid.done() and self.feed.commands.ready(values)

    async def give(self, values: Mapping[str, object], done: Done, accepted: Callable[[], None] | None = None) -> None:
        """Send values as this injection's; ``done`` and ``accepted`` as of :meth:`CommandClient.give`.

        PathError: it stands no more; CommandError, ValueRangeError: not sent.
        """
        await self.laid()
        if self.over:
            raise PathError(f"the injection over {self.target} is over: {self.over}")
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
        """Show what its clients give from now on; how to leave again."""
        return self._given.listen(wire, encode, lane)

    # ---- what it diverts ---------------------------------------------------------------------------------------

    def originals(self, wire: str, encode: Encode, outbox: Outbox, path: str, finish: Finish = bytes) -> Leave:
        """Show what it diverts, over ``/out`` the present value first; how to leave again. ``path``: for messages."""
        if self.inward:
            return self._diverted.listen(wire, encode, EventLane(outbox, path, finish))
        subject = Subject(
            f"{wire} beneath {id(self)}",
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
        """The original of ``/out`` as of now, if it is good."""
        frame = None if self.inward else self.feed.present()
        return None if frame is None else self._original(frame)

    def _original(self, frame: SourceImage) -> ShownImage:
        return ShownImage(frame.number, frame.clock_ns, self._base.image(frame.raw))

    def _changed(self, shown: SourceImage, frame: SourceImage) -> bool:
        return bool(self._scan.changed(self._original(shown).image, self._original(frame).image))

    def _tell_again(self) -> None:
        for subject in self._subjects:
            self.feed.tell_again(subject)

    # ---- as a follower of its block ----------------------------------------------------------------------------

    def divert(self, diverted: CommandWrites) -> None:
        """A command's values went to it."""
        self._base.divert(diverted.writes)
        if self.inward:
            self._diverted.show(ShownImage(*self.feed.commands.stamp(diverted.event), bytes(self._base.given)))
        else:
            self._base.restack()
            self._tell_again()

    def restack(self) -> None:
        """An injection was laid or lifted, on the same source."""
        if not self.inward and self._base.restack():
            self._tell_again()

    def lifted(self, reason: str) -> None:
        """It was lifted, and not by us."""
        self._finish(f"it was lifted: {reason}" if reason != "lifted" else "somebody has lifted it")

    def fail(self, reason: str) -> None:
        """What comes next is not all there was."""
        self._diverted.fail(reason)
