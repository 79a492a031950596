"""Saves the state of an instance in virtual time, and restores it.

Computed sources, and emulators that follow the instance's clock, take part in snapshots. The program
that owns time asks their processes through the clock page. Each process then writes its state to a
file in a temporary folder, or restores its state from such a file.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Final, Protocol

from shmio import control
from shmio.config.folder import unwritable
from shmio.errors import ControlError, SnapshotError
from shmio.local.snapshot_file import (
    SnapshotHead,
    check_name,
    delete_snapshot,
    file_of,
    list_snapshots,
    read_snapshot,
    work_folder,
    write_snapshot,
)
from shmio.local.state_requests import MAX_PART_BYTES, PART, REFUSAL, read_bounded, write_new
from shmio.local.supervisor import ask_supervisor
from shmio.local.time_control import Coordinator
from shmio.model.clock import Clock
from shmio.model.snapshot import SnapshotInfo
from shmio.segment import ProcessSlot, Segment
from shmio.segment.clock import StateAction, StateRequest

PATIENCE_S: Final = 30.0
"""Time limit in s for all processes to save, check or restore their state."""
ASK_S: Final = 2.0
_TURN_NS: Final = 100_000_000
_PARTIAL: Final = "; --partial saves the rest"

Refusals = dict[str, str]
"""For each process that has refused a request, by its name: the reason."""


class States(Protocol):
    """Asks the processes that take part in snapshots for their states, and restores the states.

    ``work`` is a folder for temporary files. States and refusals are by name of the process.
    """

    def names(self) -> tuple[list[str], Refusals]:
        """Return the names of the processes that take part, and why the others do not."""

    def save(self, name: str, names: list[str], work: Path) -> tuple[dict[str, bytes], Refusals]:
        """Return the states of the processes ``names`` for the snapshot ``name``, and the refusals."""

    def check(self, name: str, states: Mapping[str, bytes], work: Path) -> Refusals:
        """Check, without any change, whether all states can be restored; return the refusals."""

    def restore(self, name: str, states: Mapping[str, bytes], work: Path) -> Refusals:
        """Restore the states that :meth:`check` has checked; return the refusals."""


class StillTime(Protocol):
    """An object that moves the instance's time, and can keep it from moving."""

    def still(self) -> AbstractContextManager[Coordinator]:
        """Own time, and do not move it, during a ``with`` block. Raise TimeError if that is not possible."""


class Snapshots:
    """Saves, restores, lists and deletes the snapshots of an instance. Use it in one thread at a time."""

    def __init__(
        self,
        segment: Segment,
        moves_time: StillTime,
        states: States | None = None,
        folder: Callable[[], Path] | None = None,
    ) -> None:
        """Prepare to save and restore.

        Args:
            segment: The instance's segment.
            moves_time: Moves the instance's time.
            states: The processes' states; None: those of the segment's processes.
            folder: Returns the folder of the snapshots; None: the supervisor knows it.
        """
        self._segment = segment
        self._time = moves_time
        self._states = states or ProcessStates(segment)
        self._folder = folder or partial(snapshot_folder, segment)

    def save(self, name: str, *, partial: bool = False) -> SnapshotInfo:
        """Save the instance's state. A snapshot of the same name is replaced.

        Args:
            name: Name of the snapshot.
            partial: Whether to save the rest if some processes cannot save their state.

        Raises:
            SnapshotError: The state of a process cannot be saved, or the file cannot be written.
            TimeError: Time is real, or another program owns it.
        """
        check_name(name)
        folder = self._folder()
        with self._time.still() as coordinator, work_folder(folder) as work:
            names, left_out = self._states.names()
            _refuse_any({} if partial else left_out, "cannot be saved", _PARTIAL if names else "")
            states, refusals = self._states.save(name, names, work)
            _refuse_any({} if partial else refusals, "cannot be saved", _PARTIAL if states else "")
            now = coordinator.read()
            head = SnapshotHead(
                self._segment.instance, time.time(), now.step, now.done, now.time_ns, now.step_size_ns,
                self._sources(), left_out | refusals,
            )  # fmt: skip
            return write_snapshot(file_of(folder, name), work, head, states)

    def restore(self, name: str) -> SnapshotInfo:
        """Restore a snapshot, of this instance or of another one with the same configuration.

        Raises:
            SnapshotError: There is no such snapshot, it is damaged or does not fit the instance, and
                nothing was changed; or a process could not restore its state, and has its old state
                or bad data.
            TimeError: Time is real, or another program owns it.
        """
        folder = self._folder()
        file = file_of(folder, name)
        found, head, states = read_snapshot(file)
        with self._time.still() as coordinator, work_folder(folder) as work:
            names, _ = self._states.names()
            self._check_fit(file, head, names, states)
            wanted = {name: states[name] for name in names if name in states}
            what = f"the snapshot {name} does not fit the instance"
            _refuse_any(self._states.check(name, wanted, work), what, "; nothing was changed")
            coordinator.jump(
                Clock(step=head.step, done=head.done, time_ns=head.time_ns, step_size_ns=head.step_size_ns)
            )
            try:
                refusals = self._states.restore(name, wanted, work)
            except SnapshotError as error:
                coordinator.announce()
                raise SnapshotError(
                    f"the snapshot {name} was restored only in part: {error}; restore it again"
                ) from None
            coordinator.announce()
            _refuse_any(refusals, f"the snapshot {name} was restored only in part", "; restore it again")
        return found

    def all(self) -> list[SnapshotInfo]:
        """Return the snapshots, the oldest first.

        Raises:
            SnapshotError: The folder cannot be read.
        """
        return list_snapshots(self._folder())

    def delete(self, name: str) -> None:
        """Delete a snapshot.

        Raises:
            SnapshotError: There is no such snapshot, or it cannot be deleted.
        """
        delete_snapshot(file_of(self._folder(), name))

    def _sources(self) -> dict[str, str]:
        return {source: block.layout.hash.hex() for source, block in self._segment.blocks.items()}

    def _check_fit(self, file: Path, head: SnapshotHead, names: list[str], states: Mapping[str, bytes]) -> None:
        """Check that a snapshot has the sources and processes of this instance.

        Raises:
            SnapshotError: It differs; the message names each difference.
        """
        faults: list[str] = []
        here = self._sources()
        for source in head.sources.keys() | here.keys():
            if source not in here:
                faults.append(f"the instance has no source {source}")
            elif source not in head.sources:
                faults.append(f"the snapshot has no source {source}")
            elif head.sources[source] != here[source]:
                faults.append(f"source {source} has another layout")
        lost = head.sources.keys() - here.keys()
        faults += [
            f"the snapshot has no state of {one}"
            for one in names
            if one not in states and one not in head.left_out and (one in head.sources or one not in here)
        ]
        faults += [f"the instance cannot restore {one}" for one in states if one not in names and one not in lost]
        if not 0 <= head.done <= head.step or not 0 <= head.time_ns < 1 << 62 or not 0 < head.step_size_ns < 1 << 62:
            faults.append("its clock is invalid")
        if faults:
            raise SnapshotError(f"{file}: {'; '.join(sorted(faults))}; nothing was changed")


def _refuse_any(refusals: Refusals, what: str, remedy: str) -> None:
    if refusals:
        raise SnapshotError(f"{what}: {'; '.join(f'{name}: {why}' for name, why in refusals.items())}{remedy}")


def snapshot_folder(segment: Segment) -> Path:
    """Ask the supervisor for the instance's folder of snapshots.

    Raises:
        ControlError: The supervisor does not answer.
    """
    answer = ask_supervisor(segment, control.Where(), ASK_S)
    try:
        return Path(answer["snapshot_dir"])
    except KeyError:
        raise ControlError("the supervisor is of an older version of shmio; restart the instance") from None


class ProcessStates:
    """Asks the processes of an instance for their states through the clock page: see :class:`States`."""

    def __init__(self, segment: Segment) -> None:
        self._segment = segment

    def names(self) -> tuple[list[str], Refusals]:
        """Return the names of the processes that take part, and why the others do not.

        Raises:
            SnapshotError: A source replays a recording, or a process does not run.
        """
        self._segment.refresh()
        names, left_out = [], {}
        for slot in self._segment.processes:
            block = self._segment.blocks.get(slot.name) if slot.kind == "source" else None
            if block is not None and block.attributes.replay:
                raise SnapshotError(f"source {slot.name} replays a recording, which snapshots do not support")
            if slot.kind not in ("source", "emulator"):
                continue
            if block is not None and not block.attributes.stepped:
                left_out[slot.name] = "its device continues in real time"
            elif block is not None and block.attributes.remote:
                left_out[slot.name] = "another program computes it"
            elif block is None and self._segment.clock.delivered(slot.index) is None:
                left_out[slot.name] = 'the emulator continues in real time, unless it has clock = "instance"'
            elif not slot.alive():
                raise SnapshotError(f"{slot.name}: its process does not run")
            else:
                names.append(slot.name)
        return names, left_out

    def save(self, name: str, names: list[str], work: Path) -> tuple[dict[str, bytes], Refusals]:
        """Ask the processes to save their states; return the states and the refusals."""
        refusals = self._ask(StateAction.SAVE, name, names, work)
        return {one: self._read(work / f"{one}{PART}") for one in names if one not in refusals}, refusals

    def check(self, name: str, states: Mapping[str, bytes], work: Path) -> Refusals:
        """Ask the processes to check their states; return the refusals."""
        try:
            for one, state in states.items():
                write_new(work / f"{one}{PART}", state)
        except OSError as error:
            raise SnapshotError(f"{work}: {error.strerror}") from None
        return self._ask(StateAction.CHECK, name, list(states), work)

    def restore(self, name: str, states: Mapping[str, bytes], work: Path) -> Refusals:
        """Ask the processes to restore the states that they have checked; return the refusals."""
        return self._ask(StateAction.RESTORE, name, list(states), work)

    def _ask(self, action: StateAction, name: str, names: list[str], work: Path) -> Refusals:
        """Ask processes, wait for their answers, and return their refusals.

        Raises:
            SnapshotError: A process does not answer.
        """
        clock = self._segment.clock
        slots = [self._segment.processes.find(one) for one in names]
        number = clock.state_request().number + 1
        clock.request_state(StateRequest(number, action, work.name, name, os.getpid()))
        for slot in slots:
            clock.slot_bell(slot.index).ring()
        until_ns = time.monotonic_ns() + round(PATIENCE_S * 1e9)
        while True:
            seen = clock.delivered_bell.value()
            waiting = [slot for slot in slots if clock.state_answer(slot.index)[0] != number]
            if not waiting:
                break
            _check_alive(waiting)
            rest_ns = until_ns - time.monotonic_ns()
            if rest_ns <= 0:
                raise SnapshotError(f"{waiting[0].name} did not answer within {PATIENCE_S:g} s")
            clock.delivered_bell.wait(seen, min(rest_ns, _TURN_NS))  # a process that dies rings no doorbell
        refused = [one for one, slot in zip(names, slots, strict=True) if not clock.state_answer(slot.index)[1]]
        return {one: _reason(work / f"{one}{REFUSAL}") for one in refused}

    @staticmethod
    def _read(file: Path) -> bytes:
        try:
            return read_bounded(file, MAX_PART_BYTES)
        except OSError as error:
            raise SnapshotError(f"{file}: {error.strerror}") from None


def _reason(file: Path) -> str:
    """Return the reason that a process has written for its refusal; if it could not write, why not."""
    try:
        reason = read_bounded(file, MAX_PART_BYTES).decode(errors="replace")
    except OSError:
        reason = ""
    if reason:
        return reason
    folder = file.parent.parent
    if obstacle := unwritable(folder):
        return obstacle.reason
    return (
        f"it could not use the folder of snapshots, {folder}; "
        "check whether the disk was full, and run shmio as the instance's user"
    )


def _check_alive(slots: list[ProcessSlot]) -> None:
    for slot in slots:
        if not slot.alive():
            raise SnapshotError(f"the process of {slot.name} has ended")
