"""An injection of SimlogAPI clients: they read what it diverts, and their values replace it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple, cast

from shmio.endpoints.grpc.commands import command_client
from shmio.endpoints.grpc.commands.followers import InjectionFollower
from shmio.endpoints.grpc.commands.topics import Shape
from shmio.endpoints.grpc.commands.write_subscriptions import Listener
from shmio.endpoints.grpc.injection.injection_base import InjectionBase
from shmio.endpoints.grpc.streams.channel import Encode, SourceImage, Subject
from shmio.endpoints.grpc.streams.feed import Feed
from shmio.endpoints.grpc.streams.outbox import EventLane, Finish, Outbox, StateLane
from shmio.endpoints.in_flight import Done
from shmio.errors import CommandError, PathError
from shmio.layout.topic import Topic, find
from shmio.layout.values.write import covering, encode
from shmio.local.writer import RETIRED
from shmio.segment import DONE, Direction, EventKind
from shmio.segment.changed_registers import ChangeScan
from shmio.segment.commands import CommandWrites, End, apply, worst

Leave = Callable[[], None]


class ShownImage(NamedTuple):
    """An image with number and time, as a topic of an injection shows it."""

    number: int
    clock_ns: int
    image: bytes


class _Tap:
    """The listeners to one of an injection's two directions; each encoding is made once."""

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
    """An injection over the registers of ``shape``, from laying to lifting.

    ``shape`` is what ``target`` names in the layout of ``feed``. The injection's *originals* are
    the values that it diverts: over ``/out`` those of the source or of inner injections, over
    ``/in`` those that are written. Its *given values* are what its clients send instead. For the
    event loop's thread.
    """

    def __init__(self, target: Topic, shape: Shape, feed: Feed, name: str) -> None:
        """Begin laying the injection. ``name``: its name in the list of all injections."""
        self.target = target
        self.shape = shape
        self.feed = feed
        self.inward = target.direction == "in"
        self.over = ""
        """Why the injection is over; empty: it stands, or is being laid."""
        self.ends: dict[object, Callable[[], object]] = {}
        """Functions that are called when the injection is over, by the object that added them."""
        frame = feed.block.latest()
        self._base = InjectionBase(feed.block, frame.image if frame else b"")
        self._given_image = bytearray(self._base.given)
        self._scan = ChangeScan(shape.registers)
        self._subjects: dict[Subject, None] = {}
        self._diverted, self._given = _Tap(), _Tap()
        self._laid = asyncio.get_running_loop().create_task(self._lay(name))
        self._laid.add_done_callback(lambda laid: laid.cancelled() or laid.exception())  # a waiter sees the error
        self._lifting: asyncio.Task[None] | None = None

    # ---- laid, and lifted --------------------------------------------------------------------------------------

    async def laid(self) -> None:
        """Wait until the injection stands. CommandError: the source refuses or does not answer."""
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
            if self.over:  # ended meanwhile, or it is unknown whether it stands
                self._have_it_lifted()

    def end(self, reason: str) -> None:
        """Lift the injection. ``reason``: becomes :attr:`over`."""
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

    # ---- given values ------------------------------------------------------------------------

    def ready(self, values: Mapping[str, object]) -> bool:
        """Return whether :meth:`give` of these values would not have to wait."""
        return self._laid.done() and self.feed.commands.ready(values)

    async def give(self, values: Mapping[str, object], done: Done, accepted: Callable[[], None] | None = None) -> None:
        """Send values as this injection's; the functions are those of :meth:`CommandClient.give`.

        Raises:
            PathError: The injection is over.
            CommandError: The source does not answer. Nothing was sent, as with the next error.
            ValueRangeError: A value does not fit.

        """
        await self.laid()
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
        """Listen to the values given from now on; return the function that leaves."""
        return self._given.listen(wire, encode, lane)

    # ---- originals ---------------------------------------------------------------------------

    def originals(self, wire: str, encode: Encode, outbox: Outbox, path: str, finish: Finish = bytes) -> Leave:
        """Listen to what the injection diverts; return the function that leaves.

        Over ``/out`` the present value comes first. ``path`` is named in failures.
        """
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
        """Return the present original of ``/out``; None: it is not good, or ``/in`` is diverted."""
        frame = None if self.inward else self.feed.present()
        return None if frame is None else self._original(frame)

    def _original(self, frame: SourceImage) -> ShownImage:
        return ShownImage(frame.number, frame.clock_ns, self._base.image(frame.raw))

    def _changed(self, shown: SourceImage, frame: SourceImage) -> bool:
        return bool(self._scan.changed(self._original(shown).image, self._original(frame).image))

    def _tell_again(self) -> None:
        for subject in self._subjects:
            self.feed.tell_again(subject)

    # ---- events of the source ----------------------------------------------------------------

    def divert(self, diverted: CommandWrites) -> None:
        """Take the values of a command that the injection diverted."""
        self._base.divert(diverted.writes)
        if self.inward:
            self._diverted.show(ShownImage(*self.feed.commands.stamp(diverted.event), bytes(self._base.given)))
        else:
            self._base.restack()
            self._tell_again()

    def restack(self) -> None:
        """React to another injection on the source that was laid or lifted."""
        if not self.inward and self._base.restack():
            self._tell_again()

    def lifted(self, reason: str) -> None:
        """React to the injection's end, which this endpoint did not ask for."""
        self._finish(f"it was lifted: {reason}" if reason != "lifted" else "somebody has lifted it")

    def fail(self, reason: str) -> None:
        """React to missed events: fail the listeners to originals."""
        self._diverted.fail(reason)
