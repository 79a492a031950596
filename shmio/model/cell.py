"""The interface of a running cell, on this host or another one; see docs/reference/cell.md."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self, Unpack

if TYPE_CHECKING:
    from shmio.layout.model import Layout
    from shmio.model.clock import Clock
    from shmio.model.event import Event
    from shmio.model.injection import Declared, Injection, InjectionEvent, Lifted
    from shmio.model.replay import ReplayChanges, ReplayStatus
    from shmio.model.snapshot import SnapshotInfo
    from shmio.model.values import Outcome, Provenance, Quality, Reading


class Closable(Protocol):
    """A resource that a program closes, by :meth:`close` or by leaving its ``with`` block."""

    def close(self) -> None:
        """Release the resource."""

    def __enter__(self) -> Self:
        """Return the object itself."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        """Close the resource."""


class Update(Protocol):
    """One frame of a source, and the registers that may have changed with it."""

    @property
    def source(self) -> str:
        """Name of the source."""

    @property
    def frame(self) -> int:
        """Number of the frame."""

    @property
    def cycle(self) -> int:
        """Cycle of the source's schedule; in virtual time, the number of the step."""

    @property
    def incarnation(self) -> int:
        """Number of times that the source's process has been started, including the present start."""

    @property
    def clock_ns(self) -> int:
        """The instance's clock when the frame was published, in ns."""

    @property
    def source_ns(self) -> int:
        """The source's time stamp, UTC in ns; 0 if the source has never delivered values."""

    @property
    def quality(self) -> Quality:
        """Quality of the frame. A stale frame is bad."""

    @property
    def reason(self) -> str:
        """Reason why the quality is not good; empty if it is good. If ``ended``, what a reload has removed."""

    @property
    def provenance(self) -> Provenance:
        """Origin of the values that the source delivered; injections do not change it."""

    @property
    def missed(self) -> int:
        """Number of frames lost since the previous update; counted only with ``every_frame``."""

    @property
    def ended(self) -> bool:
        """True if a reload has removed the source or its subscribed registers.

        No more updates of the source follow. When all sources have ended, the iteration waits until
        it is closed or the instance ends.
        """

    @property
    def readings(self) -> Sequence[Reading]:
        """Readings of the registers that may have changed since the previous update.

        The first update has readings of all subscribed registers. Use the readings of an update
        before you take the next update.
        """


class Subscription(Closable, Protocol):
    """Iterator over updates. Use it in one thread; any thread may close it, which ends the iteration."""

    def __iter__(self) -> Iterator[Update]:
        """Return the object itself."""

    def __next__(self) -> Update:
        """Wait for the next update.

        Raises:
            PathError: A pattern matches no register; only the first call raises this.
            ValueRangeError: There is no pattern, or an option is wrong; only the first call raises
                this.
            NotRunningError: The instance has ended.
        """


class Events(Closable, Protocol):
    """Iterator over events. Use it in one thread; any thread may close it, which ends the iteration.

    Events of one source come in order. When a reload has removed all sources, the iteration waits
    until it is closed or the instance ends.
    """

    def __iter__(self) -> Iterator[Event]:
        """Return the object itself."""

    def __next__(self) -> Event:
        """Wait for the next event. Raise NotRunningError if the instance has ended."""


class Shadow(Closable, Protocol):
    """An injection to which this program gives values.

    Closing the object lifts the injection, unless the program created it with ``keep``.
    """

    @property
    def number(self) -> int:
        """Number of the injection. Any program may lift the injection by its number."""

    def set(self, values: Mapping[str, object]) -> list[Outcome]:
        """Give values by path to the injection, and return the outcome of each value.

        An outcome is ``rejected`` if the injection does not cover the path, or has been lifted.

        On a remote cell, all values of one call have the same outcome: the worst of them. There, a
        wrong path or value is also ``rejected``, and a lifted injection may raise RemoteError.

        Raises:
            PathError: There is no such register (only on this host).
            ValueRangeError: A value does not fit its register, or has a type that no register has.
            CommandError: The injection has ended, or the source's queue has no room.
        """


class Campaign(Closable, Protocol):
    """Declared injections that this program has created, and their events.

    Iterate over the campaign to get the events. The iteration ends when all injections are lifted.
    Closing the campaign lifts the remaining injections, unless they were created with ``keep``.
    """

    @property
    def declared(self) -> tuple[Declared, ...]:
        """The created injections, in the order of the declarations."""

    def __iter__(self) -> Iterator[InjectionEvent]:
        """Return the object itself."""

    def __next__(self) -> InjectionEvent:
        """Wait for the next event. Raise NotRunningError if the instance has ended."""


class ReadsClock(Protocol):
    """Function that reads the instance's clock."""

    def __call__(self) -> Clock:
        """Return the present state of the clock."""


class Cell(Closable, Protocol):
    """A running cell.

    :func:`shmio.attach` returns a cell on this host; :func:`shmio.connect` returns a remote cell,
    which uses gRPC. The methods raise the errors of :mod:`shmio.errors`. If the instance has ended
    or cannot be reached, every method raises NotRunningError, except ``sources`` and ``clock`` of a
    cell on this host: they return the last state.
    """

    @property
    def sources(self) -> list[str]:
        """Names of the sources."""

    def layouts(self, *sources: str) -> Mapping[str, Layout]:
        """Return the layouts of these sources, by source; of all sources if none is named.

        Raises:
            PathError: There is no such source.
        """

    def get(self, *patterns: str) -> list[Reading]:
        """Read registers, whatever their quality.

        Args:
            patterns: Paths, array elements, slices, structures, globs, or names of sources.

        Returns:
            One reading of each register that matches a pattern, in the order of the patterns. All
            readings of one source come from the same frame.

        Raises:
            PathError: A pattern matches no register.
        """

    def subscribe(self, *patterns: str, every_frame: bool = False, max_rate_hz: float = 0.0) -> Subscription:
        """Follow registers: the iterator returns first their present values, then each change.

        Args:
            patterns: As for :meth:`get`.
            every_frame: Whether to return an update for each frame, in order, and to count lost
                frames. Otherwise, a slow reader gets only the newest values.
            max_rate_hz: Maximum number of updates per second of each source; 0: no limit. It must
                be 0 with ``every_frame``.
        """

    def events(self, *sources: str) -> Events:
        """Follow the events of these sources from now on; of all sources if none is named.

        Events are about commands and their outcomes, injections, changes of quality, notes, and
        starts and stops of a source's process.

        Raises:
            PathError: There is no such source.
        """

    def set(self, values: Mapping[str, object], timeout_s: float | None = None) -> list[Outcome]:
        """Write values to one source as one command, and wait for the outcomes.

        Args:
            values: Values by path: registers, whole arrays, elements, slices or bits.
            timeout_s: Time in s that the values may wait for a cycle of the source; None: 2 s, or
                three cycles if that is longer.

        Returns:
            The outcome of each value, with the path that you gave, in the order of ``values``.

        Raises:
            PathError: A path names no register. On this host also: the paths belong to several sources,
                there are no values, or a path ends in ``/out``.
            ValueRangeError: A value does not fit its register, or a register is given twice. On a
                remote cell also: the values belong to several sources, or there are none.
            CommandError: A register is not writable, or the source's queue has no room. On a remote
                cell also: a path ends in ``/out``.
                After each of these errors, the source has received nothing.
        """

    def inject(self, *patterns: str, priority: int = 0, keep: bool = False, name: str = "") -> Shadow:
        """Create an injection over registers of one source, for consumers or for the device.

        Args:
            patterns: As for :meth:`get`. Patterns that end in ``/in`` cover the values that are
                written to the device. Patterns that end in ``/out``, or in neither, cover the
                values that consumers see. All patterns must have the same direction.
            priority: An injection with a higher priority covers those with a lower one.
            keep: Whether the injection stays when this program ends, until a program lifts it.
            name: Name of the injection in events and lists.

        Raises:
            PathError: A pattern matches no register, or the patterns differ in source or direction.
            CommandError: The source refuses the injection, or does not answer.
        """

    def declare(self, declarations: Iterable[Any], *, keep: bool = False) -> Campaign:
        """Create all of these declared injections, or none. Their sources run them on their own.

        Args:
            declarations: Mappings with the keys of an ``[[injection]]`` table, or
                :class:`shmio.config.Declaration` objects.
            keep: Whether the injections stay when this program ends, until they are over or lifted.

        Raises:
            ValueRangeError: A declaration is wrong; nothing was created.
            CommandError: A source refuses an injection, or does not answer; nothing was created.
        """

    def injections(self, *sources: str) -> list[Injection[Mapping[str, Any]]]:
        """Return the existing injections of these sources; of all sources if none is named.

        Within a source, the innermost injection comes first.
        """

    def lift(self, source: str, number: int) -> None:
        """Lift the injection with this number, whichever program created it.

        Raises:
            PathError: There is no such source or injection.
            CommandError: The source does not answer.
        """

    def lift_all(self, *sources: str) -> list[Lifted]:
        """Lift all injections of these sources, whichever program created them.

        Without arguments, lift the injections of all sources.

        Returns:
            The result for each injection.

        Raises:
            CommandError: Some injections were not lifted; the message gives the reasons.
        """

    @property
    def clock(self) -> ReadsClock:
        """Function that reads the instance's clock: ``cell.clock()`` returns the clock's state."""

    def real_sources(self) -> list[str]:
        """Return the names of the sources that steps do not advance, such as those with a real device."""

    def step(self, dt_s: float | None = None, count: int = 1) -> Clock:
        """Take control of time, advance it by steps, and wait until all sources have done the steps.

        Args:
            dt_s: Length of each step in s, from 1 us to 1 h; None: the step size.
            count: Number of steps.

        Returns:
            The state of the clock after the last step.

        Raises:
            TimeError: Another program owns time, or a step failed.
            ValueRangeError: The length is out of range, or the count is below 1.
        """

    def play(self, rate: float = 1.0, dt_s: float | None = None) -> Clock:
        """Take control of time, and step it in the background until :meth:`pause`.

        Return the clock's state at once.

        Args:
            rate: Speed relative to real time; above 0, at most 1000.
            dt_s: Length of each step in s, from 1 us to 1 h; None: the step size.

        Raises:
            TimeError: Another program owns time.
            ValueRangeError: The rate or the length is out of range.
        """

    def pause(self) -> Clock:
        """Take control of time, and stop it until the next :meth:`step` or :meth:`play`.

        Return the clock's state.

        Raises:
            TimeError: Another program owns time, or a step failed while time was played.
        """

    def release(self) -> Clock:
        """Return to real time, and return the clock's state.

        The clock continues from the present virtual time.

        Raises:
            TimeError: Another program owns time, or time was virtual from the instance's start.
        """

    def save_snapshot(self, name: str, *, partial: bool = False) -> SnapshotInfo:
        """Save the state of the instance to a file of this name, in the instance's folder.

        The snapshot has the state of the clock, the models, the images, the injections, and the
        emulators that follow the instance's clock. It replaces a snapshot of the same name.

        Args:
            name: Name of the snapshot: letters, digits, ``_``, ``-`` and ``.``.
            partial: Whether to save the rest if the state of some processes cannot be saved. The
                result's ``left_out`` names these processes.

        Raises:
            SnapshotError: The state of a process cannot be saved, or the file cannot be written.
            TimeError: Time is real, or another program owns it.
        """

    def restore_snapshot(self, name: str) -> SnapshotInfo:
        """Restore a snapshot of this instance, or of one with the same configuration.

        Time continues from the time of the snapshot, so it may go back. Processes that are not in
        the snapshot keep their present state; the result's ``left_out`` names them.

        Raises:
            SnapshotError: There is no such snapshot, or it does not fit the instance, and nothing
                was changed; or a process could not restore its state, and its data are bad.
            TimeError: Time is real, or another program owns it.
        """

    def snapshots(self) -> list[SnapshotInfo]:
        """Return the instance's snapshots, the oldest first."""

    def delete_snapshot(self, name: str) -> None:
        """Delete a snapshot.

        Raises:
            SnapshotError: There is no such snapshot, or it cannot be deleted.
        """

    def replay(self, **changes: Unpack[ReplayChanges]) -> list[ReplayStatus]:
        """Change the replays of recordings, and return their status.

        Without arguments, only return the status.

        Args:
            changes: Requested changes: see :class:`shmio.model.replay.ReplayChanges`.

        Raises:
            CommandError: The instance replays no recording, or a source does not answer.
            PathError: There is no such source or register.
            ValueRangeError: A speed or a time is out of range.
        """
