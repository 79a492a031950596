"""The processes of an instance. It carries out the decisions of ``policy``."""

from __future__ import annotations

import os
import selectors
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Final

from shmio.plan.processes import Job
from shmio.segment import ProcessSpec, Segment, Supervised, stale_segment
from shmio.supervisor import policy
from shmio.supervisor.managed import ManagedProcess, log, log_step
from shmio.supervisor.policy import Limits
from shmio.supervisor.process import AdoptedProcess, ChildProcess
from shmio.supervisor.reconcile import CurrentProcess, digest
from shmio.supervisor.states import PHASES, Action, Event, State

TICK_S: Final = 0.1
"""How often heartbeats are checked."""


class Fleet:
    """All processes of a segment, by name.

    The data of its selector keys are functions without arguments.
    """

    def __init__(
        self, segment: Segment, selector: selectors.BaseSelector, limits: Limits, modules: Mapping[str, str]
    ) -> None:
        self._segment = segment
        self._selector = selector
        self._limits = limits
        self._modules = modules
        self._managed: dict[str, ManagedProcess] = {}
        self._ticked_ns = time.monotonic_ns()
        for slot in segment.processes:
            self._managed[slot.name] = ManagedProcess(slot)

    def __iter__(self) -> Iterator[ManagedProcess]:
        return iter(self._managed.values())

    @property
    def names(self) -> list[str]:
        """The names of all processes."""
        return list(self._managed)

    def named(self, name: str) -> ManagedProcess:
        """Return the process of this name; KeyError if there is none."""
        return self._managed[name]

    @property
    def ranked(self) -> list[tuple[int, policy.Life]]:
        """Rank and life of each process, in order of iteration."""
        return [(managed.rank, managed.life) for managed in self]

    def present(self) -> dict[str, CurrentProcess]:
        """Return the present processes for comparison with a plan.

        A process in FATAL is not well.
        """
        return {
            m.name: CurrentProcess(m.slot.kind, m.slot.digest, m.life.state not in (State.STOPPED, State.FATAL))
            for m in self
        }

    def assign(self, job: Job) -> None:
        """Set the job for a process that does not run; a new process gets a slot."""
        managed = self._managed.get(job.name)
        if managed is None:
            slot = self._segment.processes.add(ProcessSpec(job.name, job.kind))
            managed = self._managed[job.name] = ManagedProcess(slot)
        managed.renew(job)

    def drop(self, name: str) -> None:
        """Forget a process that has ended, and free its slot."""
        managed = self._managed.pop(name)
        self._segment.processes.remove(managed.slot)

    def adopt(self, managed: ManagedProcess, child: AdoptedProcess) -> None:
        """Supervise a running process of another supervisor."""
        managed.adopt(child)
        self._watch(managed, child)

    def start_due(self) -> None:
        """Start the processes whose turn has come."""
        self._apply_all(policy.to_start(self.ranked), Event.START)

    def stop_due(self) -> None:
        """Stop the processes whose turn has come, when all are to stop."""
        self._apply_all(policy.to_stop(self.ranked), Event.STOP)

    def _apply_all(self, indices: list[int], event: Event) -> None:
        managed = list(self)
        for index in indices:
            self.apply(managed[index], event)

    def look(self, now_ns: int) -> None:
        """Check all heartbeats and time limits."""
        # If the supervisor itself was paused (host suspended, container paused), so were the others: that time does
        # not count against them.
        elapsed_ns = min(now_ns - self._ticked_ns, round(2 * TICK_S * 1e9))
        self._ticked_ns = now_ns
        for managed in self:
            quiet_ns = managed.quiet_ns(elapsed_ns)
            if managed.life.state is State.STARTING:
                self._evict(managed)
            late = managed.life.state is State.STARTING and now_ns >= (managed.life.due_ns or now_ns)
            waited_ns = managed.child.waited_ns() if late and managed.child else 0
            event = policy.due(
                managed.life,
                now_ns,
                ready=managed.ready,
                quiet_ns=quiet_ns,
                limits=self._limits,
                waited_ns=waited_ns,
            )
            if event is not None:
                dying = managed.child if managed.life.killed else None
                self.apply(managed, event, stale_segment.survivor(dying.pid) if dying else "")

    def _evict(self, managed: ManagedProcess) -> None:
        """Kill a process that holds the role but is not ours.

        A dead supervisor started it too late to be seen at the take-over. The loop does not wait
        for its end.
        """
        if managed.child is None:
            return
        spared = (0, managed.child.pid, managed.evicted_pid)
        if managed.slot.report.pid in spared:
            return
        worker = stale_segment.holder(managed.slot, self._segment.shared)
        if worker is None:
            return
        if worker.pid not in spared:  # the child may have taken the slot since the first look
            log.warning("%s is held by pid %d, which no supervisor knows: killed", managed.name, worker.pid)
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(worker.pidfd, signal.SIGKILL)
            managed.evicted_pid = worker.pid
        os.close(worker.pidfd)

    def apply(self, managed: ManagedProcess, event: Event, note: str = "") -> None:
        """Apply an event to a process, and carry out the resulting action."""
        before = managed.life
        managed.life, action = policy.step(before, event, time.monotonic_ns(), self._limits, note)
        if managed.life == before:
            return
        if action is Action.SPAWN:
            self._publish(managed)  # before the process can report
            self._spawn(managed)
            return
        if managed.child is not None and action is Action.TERMINATE:
            managed.child.terminate()
        elif managed.child is not None and action is Action.KILL:
            managed.child.kill()
        self._publish(managed)
        log_step(managed, before, action, self._limits)
        managed.answer()

    def _spawn(self, managed: ManagedProcess) -> None:
        job = managed.job
        place = self._segment.instance, self._segment.header.epoch
        description = job.describe(*place)
        managed.slot.digest = digest(job.identify(*place))
        try:
            child = ChildProcess.spawn(self._modules[job.kind], description, job.log_file)
        except OSError as error:
            self.apply(managed, Event.EXIT, f"cannot be started: {error.strerror}")
            return
        managed.child = child
        self._watch(managed, child)

    def _watch(self, managed: ManagedProcess, child: ChildProcess | AdoptedProcess) -> None:
        self._selector.register(child.pidfd, selectors.EVENT_READ, lambda: self._on_exit(managed, child))

    def _on_exit(self, managed: ManagedProcess, child: ChildProcess | AdoptedProcess) -> None:
        self._selector.unregister(child.pidfd)
        code = child.reap()
        note = managed.end_note(child.pid, code)
        managed.child = None
        self.apply(managed, policy.ended(code), note)

    def _publish(self, managed: ManagedProcess) -> None:
        life = managed.life
        managed.slot.supervised = Supervised(PHASES[life.state], life.restarts, life.spawned_ns, life.note)
