"""Carries out commands about injections, and evaluates declared injections in each cycle.

The order in which injections change an image is defined in
:mod:`shmio.connectors.injection_layers`; :mod:`shmio.connectors.output` applies them.
"""

from __future__ import annotations

import hashlib
import logging
import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np

from shmio.config import Declaration
from shmio.config.declaration import contradictions
from shmio.connectors.injection_layers import (
    MAX_HELD,
    Bits,
    CycleImage,
    DeclaredLayer,
    Layer,
    LayerStack,
    Owner,
    covering,
    declared,
    shadow,
)
from shmio.connectors.injection_state import LayerState, check_configured, make_layer, save_layer
from shmio.connectors.output import LIFTED, Image, LayerPublisher, Output, in_parts, layer_event, lost, pieces
from shmio.errors import ConfigError, SegmentError, SnapshotError
from shmio.injection import Program, compile_program
from shmio.injection._numbers import evaluate_all
from shmio.injection.activation import State
from shmio.injection.program import NEVER, Condition, compile_condition
from shmio.layout.model import Layout
from shmio.layout.values.write import Write, apply
from shmio.model.injection import Running
from shmio.model.values import NO_WRITER
from shmio.segment import Block, Command, CommandKind, Direction, EventKind, Frame, Quality, Record, Segment
from shmio.segment.block import Layouts
from shmio.segment.events import EVENT_SLOTS
from shmio.segment.injection_list import InjectionEntry

if TYPE_CHECKING:
    from shmio.injection._numbers import Steps

LOOK_NS: Final = 400_000_000
"""Interval in ns for checking owners, so short that an injection ends within 1 s after its client."""
SEED_BITS: Final = 53
"""Length of a generated seed in bits; every JSON reader represents such integers exactly."""
NO_OWNER: Final = "no live process owns the queue from which the command came"
CONFIGURED: Final = Owner(NO_WRITER, 0)
"""The owner of injections that the configuration declares."""

Blocks = Callable[[], Mapping[str, Block]]
"""Function that returns the present blocks of the instance by source name."""
OwnerOf = Callable[[int], Owner | None]
"""Function that returns the process that uses a writer's command queue; None if no live process does."""

_DECODER: Final = msgspec.json.Decoder(Declaration)
_OVER, _BAD = State.OVER, Quality.BAD
"""Each cycle needs these, and looking up a member of an enum is slow."""

log = logging.getLogger("shmio.source")


def owner_of(segment: Segment, writer: int) -> Owner | None:
    """Return the process that uses the command queue ``writer`` at present; None if no live process does."""
    segment.refresh()
    for slot in (*segment.processes, *segment.processes.external):
        if slot.writer == writer and slot.alive():
            return Owner(writer, slot.report.pid)
    return None


def blocks_of(segment: Segment) -> Mapping[str, Block]:
    """Return the present blocks of all sources by source name."""
    segment.refresh()
    return segment.blocks


# -- declared injections -----------------------------------------------------------------------------------------------


class Conditions:
    """The conditions of one source's declared injections.

    Injections are not applied to the images that conditions read, so that no injection can influence
    its own condition. A value is unknown if its source has bad quality or its register has a bad status.
    After a reload, a condition is unknown until it is compiled for the new layouts.
    """

    def __init__(self, layers: Sequence[DeclaredLayer], own: str, blocks: Mapping[str, Block]) -> None:
        """Collect the conditions of all layers.

        Args:
            layers: The declared injections.
            own: The name of their source.
            blocks: The blocks of all sources.

        """
        layouts = Layouts(blocks)
        self._conditions = tuple(_steps(layer, layouts) for layer in layers)
        self._own = own
        self._blocks = blocks
        self.foreign = frozenset(source for steps in self._conditions if steps for source, _ in steps[2]) - {own}
        """The names of the other sources that conditions read."""

    def evaluate_all(self, image: Image, before: int | None) -> list[bool]:
        """Return for each injection whether its condition is true; True if it has no condition.

        Args:
            image: The source's next image.
            before: The number of the present step; None outside steps. If another source has already
                completed this step, its values from before the step count.

        """
        known = image.quality is not _BAD and image.source_ns != 0
        images: dict[str, bytes | None] = {self._own: image.raw if known else None}
        for source in self.foreign:
            images[source] = self._fetch(source, before)
        return evaluate_all(self._conditions, images)

    def _fetch(self, source: str, before: int | None) -> bytes | None:
        block = self._blocks.get(source)
        try:
            frame = None if block is None else newest(block, before)
        except SegmentError:
            return None
        if block is None or frame is None or block.retired or frame.source_ns == 0:
            return None
        return None if block.assess(frame)[0] is Quality.BAD else frame.raw


def _steps(layer: DeclaredLayer, layouts: Mapping[str, Layout]) -> Steps | None:
    """Return the condition of a layer as :func:`evaluate_all` expects it; None if the layer has no condition."""
    condition = layer.program.condition
    if condition is None:
        return None
    if not condition.fits(layouts):
        condition = NEVER
    return condition.expression.codes, condition.expression.operands, condition.reads, layer.memory.seen


def newest(block: Block, before: int | None) -> Frame | None:
    """Return the newest frame of a block.

    If ``before`` is a step, return the newest frame before this step. So in each run, a source sees
    the same frames of other sources, whichever of them completes the step first (the Jacobi
    method).
    """
    frame = block.latest()
    while frame is not None and before is not None and block.came_with(frame, before):
        frame = block.read(frame.number - 1)
    return frame


class DeclaredInjections:
    """Adds, evaluates and lifts the declared injections of one source.

    The loop's thread evaluates the injections whenever it publishes an image, and calls
    :meth:`release` and :meth:`forget`. The command thread calls the other methods.
    """

    def __init__(self, publisher: LayerPublisher, blocks: Blocks) -> None:
        self._publisher = publisher
        self._stack = publisher.injections
        self._output = publisher.output
        self._own = publisher.output.writer.block
        self._blocks_of = blocks
        self._blocks = self._present_blocks()
        self._configuration: int | None = None
        self._layers: list[DeclaredLayer] = []
        self._conditions = Conditions((), self._own.source, self._blocks)
        self._steady: tuple[list[bool], int, float] | None = None
        """Conditions for which no injection changes its state, from a time until before another; None: none known."""

    @property
    def overload(self) -> str:
        """Why the source can accept no write at present; empty if it can accept writes."""
        full = next((layer for layer in self._layers if layer.full), None)
        return f"the injection {full.name} delays {MAX_HELD} writes already, which is the maximum" if full else ""

    @property
    def reads_other_sources(self) -> bool:
        """True if a condition names registers of other sources, which may change on a reload."""
        return any(layer.program.foreign for layer in self._layers)

    def seen(self, frame: Frame) -> None:
        """Continue from ``frame``, the last frame of the source's previous process."""
        time_ns = self._time_ns(frame.cycle) if self._own.playhead is None else frame.clock_ns
        self._publisher.injections.now = CycleImage(frame.cycle, time_ns, frame.raw)

    def resume(self, entry: InjectionEntry, running: Running[Declaration], seen: Bits) -> None:
        """Resume an injection of the source's previous process.

        ``seen`` is the image that readers saw last.
        """
        owner = Owner(entry.writer, entry.pid)
        try:
            program = self._program(running.declaration)
            layer = declared(entry.number, program, owner, running.seed, keep=entry.keep)
            layer.resume(running, seen)
        except (ConfigError, ValueError) as error:
            log.warning("injection %s cannot be resumed: %s", entry.name, error)
            return
        self._publisher.restore(layer)
        self._settle()

    def declare(self, command: Command, owner: Owner) -> str:
        """Add the injection that a command declares; return "", or why it cannot be added."""
        try:
            declaration = _DECODER.decode(b"".join(write.data for write in command.writes))
            for complaint in contradictions(declaration):
                return complaint
            program = self._program(declaration)
        except (msgspec.MsgspecError, UnicodeDecodeError, ConfigError, RecursionError) as error:
            return str(error)
        layer = declared(command.id, program, owner, _seed(declaration), keep=command.keep)
        return self._add(layer, command)

    def lift(self, layer: DeclaredLayer, command: Command) -> str:
        """Lift a configured injection; return "", or why it cannot be lifted.

        The injection stays lifted until its declaration changes.
        """
        if layer.activation.state is State.LIFTED:
            return f"the injection {layer.name} was lifted already"
        with self._output.lock:
            layer.activation.state = State.LIFTED
            self._publisher.publish()
            records = [*lost(layer, "the injection was lifted"), *self._publisher.computed(self._output.base)]
            self._output.show([*records, layer_event(EventKind.LIFTED, layer, LIFTED, command)])
        return ""

    def follow(self) -> None:
        """Add, replace and lift configured injections if the configuration has changed."""
        sequence = self._own.declared.sequence
        if sequence == self._configuration or sequence % 2:  # odd: a write is in progress, and a wake-up follows
            return
        self._configuration = sequence
        wanted = {declaration.name: declaration for declaration in self._own.declared.read()}
        stale = {x.id for x in self._layers if x.configured and wanted.get(x.name) != x.program.declaration}
        if stale:
            self._publisher.lift(
                lambda layer: layer.id in stale, "the configuration has removed or changed the injection"
            )
            self.settle()
        there = {layer.name for layer in self._layers if layer.configured}
        for declaration in wanted.values():
            if declaration.name not in there:
                self._add_configured(declaration)

    def settle(self) -> None:
        """Update the list of declared injections after injections were added or lifted."""
        with self._output.lock:
            self._settle()

    def compiled(self, saved: Sequence[LayerState]) -> list[Layer]:
        """Return the injections of a snapshot.

        Raises:
            SnapshotError: The injections are damaged, or do not fit the configuration.

        """
        layers = [make_layer(one, self._own.layout.size, self._program) for one in saved]
        check_configured(layers, {declaration.name: declaration for declaration in self._own.declared.read()})
        return layers

    def restored(self) -> None:
        """Continue with restored injections of a snapshot. The caller holds the output's ``lock``."""
        self._settle()

    def _settle(self) -> None:
        self._layers = [layer for layer in self._publisher.injections.layers if isinstance(layer, DeclaredLayer)]
        self._collect()
        self._output.advance = self._advance if self._layers else None

    def _collect(self) -> None:
        self._conditions = Conditions(self._layers, self._own.source, self._blocks)
        self._steady = None

    def _add_configured(self, declaration: Declaration) -> None:
        try:
            program = self._program(declaration)
        except ConfigError as error:
            log.warning("injection %s: %s", declaration.name, error)
            return
        document = msgspec.json.encode(declaration)
        number = int.from_bytes(hashlib.sha256(document).digest()[:8], "little") | 1
        layer = declared(number, program, CONFIGURED, _seed(declaration), keep=True)
        if reason := self._add(layer, None):
            log.warning("injection %s was not created: %s", declaration.name, reason)

    def _add(self, layer: DeclaredLayer, command: Command | None) -> str:
        with self._output.lock:
            if reason := self._publisher.add(layer):
                return reason
            if self._output.advance is None:  # evaluate the injection from the next cycle on
                injections = self._publisher.injections
                injections.now = msgspec.structs.replace(injections.now, cycle=self._output.cycle)
            self._settle()
            for record in _injected_events(layer, command):  # before any frame: the layer changes nothing yet
                self._output.writer.event(record)
        return ""

    def _program(self, declaration: Declaration) -> Program:
        """Compile a declaration.

        Raises:
            ConfigError: The declaration is wrong or targets another source.

        """
        self.rebind()
        layouts = Layouts(self._blocks)
        periods_ns = {source: block.period_ns for source, block in self._blocks.items()}
        program = compile_program(declaration, layouts, periods_ns)
        if program.source != self._own.source:
            raise ConfigError(
                f"target: it names source {program.source}, but the declaration was sent to source {self._own.source}"
            )
        return program

    def rebind(self) -> None:
        """Find the present blocks, and compile conditions again if a reload has changed a source that they name."""
        blocks = self._present_blocks()
        layouts = Layouts(blocks)
        compiled = [
            (layer, self._compiled_again(layer, condition, layouts))
            for layer in self._layers
            if (condition := layer.program.condition) is not None and not condition.fits(layouts)
        ]
        if not compiled and blocks == self._blocks:
            return
        with self._output.lock:
            for layer, condition in compiled:
                layer.program = replace(layer.program, condition=condition)
                layer.memory.seen.clear()
            self._blocks = blocks
            self._collect()

    def _compiled_again(self, layer: DeclaredLayer, before: Condition, layouts: Mapping[str, Layout]) -> Condition:
        try:
            return compile_condition(layer.program.declaration.when or "", layouts)
        except ConfigError as error:
            log.warning("injection %s cannot start until the configuration is changed: %s", layer.name, error)
            return replace(NEVER, layouts={source: layouts.get(source) for source in before.layouts})

    def _present_blocks(self) -> dict[str, Block]:
        """Return the blocks of all sources by source name; of this source, the block that this process writes."""
        return {**self._blocks_of(), self._own.source: self._own}

    # -- called by the loop's thread -----------------------------------------------------------------------------------

    def _advance(self, image: Image) -> list[Record]:
        """Evaluate all declared injections for the next image, and return events about the changes.

        The caller holds the output's ``lock``. Conditions are evaluated only for the first image of
        a cycle, because the number of further images depends on timing, which must not influence
        the result.
        """
        stack, cycle = self._stack, image.cycle
        looked = stack.now.cycle
        time_ns = image.at.clock_ns if image.at else self._time_ns(cycle)
        stack.now = CycleImage(cycle, time_ns, image.raw)
        if cycle == looked:
            return []
        conditions = self._conditions
        holds = conditions.evaluate_all(image, self._step() if conditions.foreign else None)
        steady = self._steady
        if steady is None or steady[0] != holds or not steady[1] <= time_ns < steady[2]:
            events, over = self._change(holds)
        else:
            events, over = [], False
        if len(stack.layers) > len(self._layers):  # clients' layers get values from declared ones
            events = [*self._publisher.computed(image.base), *events]
        return events + self._lift_finished() if over else events

    def _change(self, holds: list[bool]) -> tuple[list[Record], bool]:
        """Update the state of all injections.

        Args:
            holds: For each injection, whether its condition is true.

        Returns:
            Events about the changes, and whether an injection may have to be lifted.

        """
        now = self._publisher.injections.now
        changed = over = False
        steady = True
        events = []
        for layer, condition in zip(self._layers, holds, strict=True):
            before, met = layer.active, layer.activation.met
            if layer.advance(now, holds=condition):
                changed = True
                if layer.active is not before:
                    events.append(_activation_event(layer))
            steady = steady and layer.activation.met is met
            over = over or (layer.activation.state is _OVER and not layer.configured)
        if changed:
            self._publisher.publish()
        limits = [layer.activation.steady_until(now.time_ns) for layer in self._layers]
        self._steady = (holds, now.time_ns, min(limits)) if steady and not changed and not over else None
        return events, over

    def _step(self) -> int | None:
        """Return the number of the present step; None outside steps."""
        state = self._own.clock.last_written()
        return state.step if self._own.attributes.stepped and state.virtual else None

    def _lift_finished(self) -> list[Record]:
        """Lift the injections that are over, and return the events about them."""
        if not any(_finished(layer) for layer in self._layers):
            return []
        over = {layer.id for layer in self._layers if _finished(layer)}
        records = self._publisher.removed(lambda layer: layer.id in over, "over")
        self._settle()
        return records

    def release(self, cycle: int) -> list[tuple[DeclaredLayer, Write]]:
        """Return the delayed writes that are due in ``cycle``, each with the injection that delayed it."""
        for layer in self._layers:
            if layer.held:
                break
        else:
            return []
        now = CycleImage(cycle, self._time_ns(cycle), b"")
        with self._output.lock:
            return [(layer, write) for layer in self._layers for write in layer.due(now)]

    def forget(self, reason: str) -> None:
        """Discard all delayed writes, because the connection to the device was lost."""
        if any(layer.held for layer in self._layers):
            with self._output.lock:
                records = [record for layer in self._layers for record in lost(layer, reason)]
            for record in records:
                self._output.writer.event(record)

    def _time_ns(self, cycle: int) -> int:
        """Return the instance time of a cycle in ns; in wall time, its scheduled time."""
        state = self._own.clock.last_written()
        if state.virtual:
            return state.time_ns
        period_ns = self._own.period_ns
        if self._own.attributes.stepped:
            return (cycle - state.lead(period_ns)) * period_ns
        return cycle * period_ns + state.offset_ns  # the cycles of a device always follow real time


def _seed(declaration: Declaration) -> int:
    return secrets.randbits(SEED_BITS) if declaration.seed is None else declaration.seed


def _finished(layer: DeclaredLayer) -> bool:
    """Return whether the injection is over and must be lifted.

    Injections of the configuration stay in the list when they are over.
    """
    return layer.activation.state is _OVER and not layer.configured and not layer.held


def _activation_event(layer: DeclaredLayer) -> Record:
    kind = EventKind.ACTIVATED if layer.active else EventKind.DEACTIVATED
    return layer_event(kind, layer, layer.name)._replace(item=layer.activation.runs)


def _injected_events(layer: DeclaredLayer, command: Command | None) -> Iterator[Record]:
    """Yield the events about a new injection, whose data together are its declaration with the seed."""
    document = msgspec.json.encode(msgspec.structs.replace(layer.program.declaration, seed=layer.seed))
    return in_parts(layer_event(EventKind.INJECTED, layer, layer.name, command), document)


# -- injections of clients, and commands -------------------------------------------------------------------------------


class InjectionProcessor:
    """Adds and lifts the injections of one source, and stores the values that clients supply for them."""

    def __init__(self, output: Output, writable: bytes, refuse_in: str, owner_of: OwnerOf, blocks: Blocks) -> None:
        """Create the processor, and resume the injections of the source's previous process.

        Args:
            output: Publishes the source's images and events.
            writable: The bits that commands may write, as an image of the block.
            refuse_in: Why injections over ``/in`` are refused; empty if they are allowed.
            owner_of: Returns the process that uses a command queue.
            blocks: Returns the blocks of all sources.

        """
        self._output = output
        self._writer = output.writer
        self._owner_of = owner_of
        self._look_ns = 0  # time of the next check by CLOCK_MONOTONIC
        self._publisher = LayerPublisher(output, writable, refuse_in)
        self.declared = DeclaredInjections(self._publisher, blocks)
        self.release = self.declared.release
        self._resume()
        self.declared.follow()

    @property
    def injections(self) -> LayerStack:
        """All layers of the source."""
        return self._output.injections

    @property
    def patience_ns(self) -> int:
        """Time in ns until :meth:`follow_changes` must be called; negative if no call is needed."""
        if all(layer.keep for layer in self.injections.layers) and not self.declared.reads_other_sources:
            return -1
        return max(0, self._look_ns - time.monotonic_ns())

    @property
    def overload(self) -> str:
        """Why the source can accept no write at present; empty if it can accept writes."""
        return self.declared.overload

    def forget(self, reason: str) -> None:
        """Discard all delayed writes, because the connection to the device was lost."""
        self.declared.forget(reason)

    def toward_device(self, command: Command) -> Layer | None:
        """Return the injection over ``/in`` by which a command sends values to the device; None if there is none."""
        layer = self.injections.find(command.injection) if command.kind is CommandKind.SHADOW else None
        if layer is None or layer.direction is not Direction.IN or isinstance(layer, DeclaredLayer):
            return None
        return layer

    def take(self, command: Command) -> str:
        """Carry out an INJECT, DECLARE or LIFT command, or a SHADOW command over ``/out``.

        Returns:
            "", or why the command is rejected.

        """
        if command.kind in (CommandKind.INJECT, CommandKind.DECLARE):
            owner = self._owner_of(command.writer)
            if owner is None:
                return NO_OWNER
            if command.kind is CommandKind.DECLARE:
                return self.declared.declare(command, owner)
            return self._add(command, owner)
        layer = self.injections.find(command.injection)
        if layer is None:
            return f"there is no injection {command.injection}; it may have been lifted"
        if command.kind is not CommandKind.LIFT:
            return self._shadow(layer, command)
        if isinstance(layer, DeclaredLayer) and layer.configured:
            return self.declared.lift(layer, command)
        self._publisher.lift(lambda other: other is layer, LIFTED, command)
        self.declared.settle()
        return ""

    def save(self) -> list[LayerState]:
        """Return the state of all injections, the innermost first. The caller holds the output's ``lock``."""
        return [save_layer(layer) for layer in self.injections.layers]

    def prepare_restore(self, saved: Sequence[LayerState], now: CycleImage, base: bytes) -> Callable[[], list[Record]]:
        """Check the state of a snapshot, and return the function that restores it.

        The caller of that function holds the output's ``lock``, and then publishes an image and the
        returned events. An injection without ``keep`` is kept nevertheless if its client no longer
        runs.

        Args:
            saved: The state of all injections.
            now: The image at which conditions were evaluated last.
            base: The image to which injections are applied.

        Raises:
            SnapshotError: The state is damaged, or does not fit the configuration.

        """
        layers = self.declared.compiled(saved)

        def restore() -> list[Record]:
            before = {layer.id: layer for layer in self.injections.layers}
            for layer in layers:
                layer.keep = layer.keep or self._owner_of(layer.owner.writer) != layer.owner
            self.injections.now = now
            try:
                self._publisher.replace(layers, base)
            except ValueError as error:
                raise SnapshotError(str(error)) from None
            self.declared.restored()
            return list(self._changes(before, {layer.id: layer for layer in layers}))

        return restore

    def _changes(self, before: Mapping[int, Layer], after: Mapping[int, Layer]) -> Iterator[Record]:
        """Yield the events about the injections that a snapshot ends, creates, or makes active or inactive."""
        reason = "a snapshot was restored"
        for layer in before.values():
            if isinstance(layer, DeclaredLayer):
                yield from lost(layer, reason)
            if layer.id not in after:
                yield layer_event(EventKind.LIFTED, layer, reason)
        for layer in after.values():
            known = before.get(layer.id)
            if not isinstance(layer, DeclaredLayer):
                if known is None:
                    yield from self._publisher.created(layer, layer_event(EventKind.INJECTED, layer, layer.name))
                continue
            if known is None:
                yield from _injected_events(layer, None)
            if layer.active != (known is not None and known.active):
                yield _activation_event(layer)

    def follow_changes(self) -> None:
        """Follow changes of the configuration; every ``LOOK_NS``, also check owners and conditions.

        This lifts each injection without ``keep`` whose client has ended, and compiles conditions
        again if they read sources that a reload has changed.
        """
        self.declared.follow()
        if self.patience_ns != 0:
            return
        self._look_ns = time.monotonic_ns() + LOOK_NS
        self.declared.rebind()
        gone = {
            layer.id
            for layer in self.injections.layers
            if not layer.keep and self._owner_of(layer.owner.writer) != layer.owner
        }
        if gone:
            self._publisher.lift(lambda layer: layer.id in gone, "the injection's client has ended")
            self.declared.settle()

    def _add(self, command: Command, owner: Owner) -> str:
        try:
            cover = covering(self._writer.block.layout.size, command.writes)
        except ValueError as error:
            return str(error)
        with self._output.lock:
            layer = Layer(
                command.id, command.direction, command.priority, command.keep, command.name, owner, cover, cover
            )
            if reason := self._publisher.add(layer):
                return reason
            layer.values = self.injections.before(self._output.base, layer)
            above = [layer, *self.injections.outer(layer)] if layer.direction is Direction.OUT else []
            end = layer_event(EventKind.INJECTED, layer, command.name, command)
            self._output.show([*self._publisher.inner_values(above, end), *self._publisher.created(layer, end)])
        return ""

    def _shadow(self, layer: Layer, command: Command) -> str:
        if isinstance(layer, DeclaredLayer):
            return f"the injection {layer.name} computes its values, so clients cannot set them"
        with self._output.lock:
            if reason := shadow(layer, command.writes):
                return reason
            diverted = [
                record
                for place, write in enumerate(command.writes)
                for other, parts in self.injections.onward(self._output.base, layer, write)
                for record in pieces(EventKind.DIVERTED, command, place, parts, other)
            ]
            shadowed = [
                record
                for place, write in enumerate(command.writes)
                for record in pieces(EventKind.SHADOWED, command, place, [write], layer)
            ]
            self._output.show(diverted + shadowed)
        return ""

    def _resume(self) -> None:
        """Resume the injections of the source's previous process; readers see the same values."""
        block = self._writer.block
        last = block.latest()
        raw, image = (last.raw, last.image) if last else (bytes(block.layout.size),) * 2
        seen = np.frombuffer(image, np.uint8)
        if last is not None:
            self.declared.seen(last)
        present = block.injections.read()
        covers = [_cover(one, block.layout.size) for one in present]
        for place, one in enumerate(present):
            if one.running is not None:
                self.declared.resume(one, one.running, seen)
                continue
            direction = Direction.IN if one.direction == "in" else Direction.OUT
            owner = Owner(one.writer, one.pid)
            layer = Layer(one.number, direction, one.priority, one.keep, one.name, owner, covers[place], seen.copy())
            self._publisher.restore(layer)
            hidden = np.zeros(block.layout.size, np.uint8)
            for outer, cover in zip(present[place + 1 :], covers[place + 1 :], strict=True):
                if outer.direction == "out" and outer.active:
                    hidden |= cover & layer.cover
            if direction is Direction.OUT and hidden.any():
                layer.values ^= (layer.values ^ self._given(layer, raw)) & hidden

    def _given(self, layer: Layer, raw: bytes) -> Bits:
        """Return the image that ``layer`` receives, overwritten with the values that its client gave.

        These values are read from the events in the segment, because outer layers may hide them in
        the last image.
        """
        values = self.injections.before(raw, layer)
        events = self._writer.block.events
        for number in range(max(1, events.head() - EVENT_SLOTS + 1), events.head() + 1):
            event = events.read(number)
            if event is not None and event.kind == EventKind.SHADOWED and event.injection == layer.id:
                apply(Write(event.offset, event.mask, event.data), values.data)
        return values


def _cover(entry: InjectionEntry, size: int) -> Bits:
    cover = np.zeros(size, np.uint8)
    for offset, count, mask in entry.ranges:
        cover[offset : offset + count] = mask
    return cover
