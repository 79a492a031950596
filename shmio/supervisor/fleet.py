"""Manages the processes of an instance: carries out the decisions of ``policy``."""

from __future__ import annotations

import errno
import hashlib
import logging
import os
import selectors
import signal
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Final

from shmio.control import Answer
from shmio.local.status import complaint as complaint_of
from shmio.logs import fields
from shmio.plan.processes import Job, rank
from shmio.realtime import ProcessorTime
from shmio.segment import Activity, ProcessSlot, ProcessSpec, Segment, Supervised, stale_segment
from shmio.supervisor import policy
from shmio.supervisor.policy import NOT_LATE, PHASES, Action, Event, Life, Limits, State
from shmio.supervisor.process import AdoptedProcess, ChildProcess, describe_end

TICK_S: Final = 0.1
"""Interval in s at which heartbeats are checked."""
LATE_S: Final = 0.4
"""Time in s without a heartbeat after which the heartbeat is late: two intervals between heartbeats."""
_LOST: Final = {"mqtt": ("dropped", "changes"), "alerts": ("failed", "notices")}
"""For each kind of process, the counter of what it loses during a problem, and the noun for that in messages."""

log = logging.getLogger("shmio.supervisor")


class ManagedProcess:
    """A process slot with its job, its state (``life``), and its process (``child``; None if there is none)."""

    def __init__(self, slot: ProcessSlot) -> None:
        self.slot = slot
        self.life = Life()
        self.child: ChildProcess | AdoptedProcess | None = None
        self.waiting: list[Answer] = []
        self.evicted_pid = 0
        """Pid of the foreign process that was killed last, because it occupied this slot."""
        self.complaint = ""
        """The problem that the running process reported at the last :meth:`listen`; "" if none."""
        self._missed = 0
        self._job: Job | None = None
        self._beat_ns = 0
        self._quiet_ns = 0
        self._used: ProcessorTime | None = None
        """How the process had been scheduled when its heartbeat was first late; None: it is not late."""

    @property
    def name(self) -> str:
        """The name of the process."""
        return self.slot.name

    @property
    def rank(self) -> int:
        """The process's place in the order of start; a process of an unknown kind stops last."""
        return rank(self.slot.name, self.slot.kind)

    @property
    def job(self) -> Job:
        """The present job of the process.

        Raises:
            LookupError: The process has no job, because it was adopted only to be stopped.

        """
        if self._job is None:
            raise LookupError(f"{self.name} has no job")
        return self._job

    def renew(self, job: Job) -> None:
        """Assign another job to the slot, and reset the state."""
        self._job = job
        self.life = Life()

    def keep(self, job: Job) -> bool:
        """Continue the process with its job from a new plan. If the job has rules, signal it to reread them.

        Rules are the part of the configuration that a process can read again while it runs.

        Returns:
            True if the process was signalled, and its rules are not empty or, as far as known, were
            not empty before.

        """
        reported = self.rereads(job)
        blind = self._job is None and job.rules is not None
        self._job = job
        if self.child is not None and (reported or blind):
            self.child.reread()
        return reported

    def rereads(self, job: Job) -> bool:
        """Return what :meth:`keep` would return, without any change."""
        known = job.rules or (self._job and self._job.rules)
        return bool(self.child is not None and job.rules is not None and known)

    def can_follow(self, job: Job) -> bool:
        """Return whether the process is running, and can change to a job and keep its connection to the device."""
        known = self._job is not None and job.connects_like(self._job)
        return known and self.ready and self.life.state is State.RUNNING

    def follow(self, job: Job) -> None:
        """Continue the process with a job whose description it has received, and wake it."""
        self._job = job
        if self.child is not None:
            self.child.reread()

    def reports(self, activity: Activity) -> bool:
        """Return whether the present process has reported this activity last."""
        report = self.slot.report
        return self.child is not None and report.pid == self.child.pid and report.activity is activity

    def adopt(self, child: AdoptedProcess) -> None:
        """Adopt a running process that another supervisor has started."""
        supervised = self.slot.supervised
        self.child = child
        self.life = policy.adopted(supervised.spawned_ns, supervised.restarts)

    @property
    def well(self) -> bool:
        """True if the process runs, starts or is being restarted."""
        return self.life.state not in (State.STOPPED, State.FATAL)

    @property
    def ready(self) -> bool:
        """True if the present process has reported that it runs.

        Reports of its predecessor do not count.
        """
        return self.reports(Activity.RUNNING)

    @property
    def advice(self) -> str:
        """Advice for the message about a failed start if the start timed out; "" for other failures."""
        late = self.life.hang and self.life.hang in self.life.note
        return f"; see its log, {self.job.log_file}; the host may be overloaded" if late else ""

    def listen(self) -> None:
        """Read the problem that the process reports; if a problem has ended, log how much was lost during it."""
        running = self.life.state is State.RUNNING
        complaint = complaint_of(self.slot.kind, self.slot.report.note) if running else ""
        lost = _LOST.get(self.slot.kind, ("missed", "frames and events"))
        missed = self.slot.counters.get(lost[0], 0) if running else 0  # the process counts from its start
        if self.complaint and running and not complaint:
            log.info("%s has recovered; %d %s were lost", self.name, max(0, missed - self._missed), lost[1])
        if not complaint:
            self._missed = missed
        self.complaint = complaint

    def quiet_ns(self, elapsed_ns: int) -> int:
        """Return the time in ns since the last heartbeat, not counting pauses of the supervisor itself.

        ``elapsed_ns`` is the time since the last call, without such pauses.
        """
        beat_ns = self.slot.heartbeat_ns
        # The first check of a running process also starts the count.
        fresh = beat_ns != self._beat_ns or self.life.state is not State.RUNNING
        self._beat_ns = beat_ns
        self._quiet_ns = 0 if fresh else self._quiet_ns + elapsed_ns
        if self._quiet_ns < LATE_S * 1e9:
            self._used = None
        elif self._used is None and self.child is not None:
            self._used = self.child.processor_time()
        return self._quiet_ns

    def processor_time(self) -> ProcessorTime:
        """Return how long the process has run, and waited for a processor.

        The times are counted from the start of the process or, if its heartbeat is late, from the time
        at which the heartbeat became late.
        """
        return NOT_LATE if self.child is None else self.child.processor_time().since(self._used or NOT_LATE)

    def end_note(self, pid: int, code: int | None) -> str:
        """Return why the process ``pid`` ended, with its last message if there is one.

        ``code`` is the exit code; None if it is unknown.
        """
        end = describe_end(code)
        if code is not None and code <= 0:
            return end
        report = self.slot.report
        words = report.note if report.pid == pid and report.note else ""
        words = words or (self.child.last_words() if self.child else "")
        return f"{words} ({end})" if words else end

    def answer(self) -> None:
        """Answer the clients that wait for a restart, if the restart is over."""
        state = self.life.state
        if self.life.stuck:
            for answer in self.waiting:
                answer.error(f"{self.name}: {self.life.note}; it starts again as soon as the old process has ended")
            self.waiting.clear()
        if state not in (State.RUNNING, State.BACKOFF, State.FATAL, State.STOPPED):
            return
        for answer in self.waiting:
            if state is State.RUNNING:
                answer.ok()
            else:
                answer.error(f"{self.name} did not start again: {self.life.note or state.value}")
        self.waiting.clear()


def _log_step(managed: ManagedProcess, before: Life, action: Action | None, limits: Limits) -> None:
    """Log a change of state, if it is of interest."""
    name, life = managed.name, managed.life
    if life.stuck:
        if not before.stuck:
            log.error("%s: %s", name, life.note)
    elif life.state is State.RUNNING:
        log.info("%s is running", name, extra=fields(pid=managed.child.pid) if managed.child else None)
    elif life.state is State.HUNG:
        log.warning("%s hangs (%s); the supervisor is killing it", name, life.note)
    elif life.state is State.FATAL:
        log.error("%s cannot work as configured: %s", name, life.note)
    elif life.state is State.BACKOFF:
        wait_s = policy.backoff_s(life.crashes, limits)
        when = f"in {wait_s:g} s" if wait_s else "at once"
        log.warning("%s crashed: %s; the supervisor is starting it again %s", name, life.note, when)
    elif life.state is State.STOPPED:
        log.info("%s has stopped", name)
    elif action is Action.KILL and before.state is life.state:
        log.warning("%s does not stop; the supervisor is killing it", name)


def brief(error: Exception) -> str:
    """Return an unexpected error as one line. Its traceback is in the log."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


class Fleet:
    """All processes of a segment. The selector's data for the pidfd of a process is the function to call."""

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
        """Return the process with this name.

        Raises:
            KeyError: No process has this name.

        """
        return self._managed[name]

    @property
    def ranked(self) -> list[tuple[int, Life]]:
        """(rank, state) of each process, in the order of iteration over this object."""
        return [(managed.rank, managed.life) for managed in self]

    def assign(self, job: Job) -> None:
        """Assign a job to the process of this name, which does not run; if the name is new, add a slot for it."""
        managed = self._managed.get(job.name)
        if managed is None:
            slot = self._segment.processes.add(ProcessSpec(job.name, job.kind))
            managed = self._managed[job.name] = ManagedProcess(slot)
        managed.renew(job)

    def offer(self, managed: ManagedProcess, job: Job) -> None:
        """Give a running process the description of another job, and signal it.

        Raises:
            OSError: The process has ended, or its description cannot be replaced.

        """
        if managed.child is None:
            raise ProcessLookupError(errno.ESRCH, "it has ended")
        place = self._segment.instance, self._segment.header.epoch
        managed.child.describe_again(job.describe_again(*place, time.monotonic_ns()))

    def follow(self, managed: ManagedProcess, job: Job) -> None:
        """Let a paused process continue with the job that it was offered."""
        managed.slot.digest = digest(job.identify(self._segment.instance, self._segment.header.epoch))
        managed.follow(job)

    def drop(self, name: str) -> None:
        """Forget a process that has ended, and free its slot."""
        managed = self._managed.pop(name)
        self._segment.processes.remove(managed.slot)

    def adopt(self, managed: ManagedProcess, child: AdoptedProcess) -> None:
        """Supervise, as ``managed``, a running process that another supervisor has started."""
        managed.adopt(child)
        self._watch(managed, child)

    def start_due(self) -> None:
        """Start the processes that are next in the order of start."""
        self._apply_all(policy.to_start(self.ranked), Event.START)

    def stop_due(self) -> None:
        """Stop the processes that are next in the order of stopping. Call this again until all have stopped."""
        self._apply_all(policy.to_stop(self.ranked), Event.STOP)

    def _apply_all(self, indices: list[int], event: Event) -> None:
        managed = list(self)
        for index in indices:
            self.apply(managed[index], event)

    def check(self, now_ns: int) -> None:
        """Check the heartbeats and time limits of all processes, and act on the results."""
        # If the supervisor was paused (host suspended, container paused), so were all processes: this time
        # does not count.
        elapsed_ns = min(now_ns - self._ticked_ns, round(2 * TICK_S * 1e9))
        self._ticked_ns = now_ns
        for managed in self:
            quiet_ns = managed.quiet_ns(elapsed_ns)
            if managed.life.state is State.STARTING:
                self._evict(managed)
            late = managed.life.state is State.STARTING and now_ns >= (managed.life.due_ns or now_ns)
            hangs = quiet_ns >= self._limits.hang_s * 1e9
            used = managed.processor_time() if late or hangs else NOT_LATE
            event = policy.due(
                managed.life,
                now_ns,
                ready=managed.ready,
                quiet_ns=quiet_ns,
                limits=self._limits,
                used=used,
            )
            if event is not None:
                dying = managed.child if managed.life.killed else None
                evidence = f"meanwhile {used}" if late or hangs else ""
                self.apply(managed, event, stale_segment.survivor(dying.pid) if dying else evidence)

    def _evict(self, managed: ManagedProcess) -> None:
        """Kill a foreign process that occupies the slot of one of our processes.

        An earlier supervisor started it just before its own end, so the take-over did not find it. This
        method does not wait until the process has ended.
        """
        if managed.child is None:
            return
        spared = (0, managed.child.pid, managed.evicted_pid)
        if managed.slot.report.pid in spared:
            return
        worker = stale_segment.holder(managed.slot, self._segment.shared)
        if worker is None:
            return
        if worker.pid not in spared:  # our child may have occupied the slot since the check above
            log.warning(
                "pid %d occupies the slot of %s, but this supervisor did not start that process and is killing it",
                worker.pid,
                managed.name,
            )
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(worker.pidfd, signal.SIGKILL)
            managed.evicted_pid = worker.pid
        os.close(worker.pidfd)

    def apply(self, managed: ManagedProcess, event: Event, note: str = "") -> None:
        """Apply an event to the state of a process, and carry out the resulting action.

        ``note`` says how a process ended.
        """
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
        _log_step(managed, before, action, self._limits)
        managed.answer()

    def _spawn(self, managed: ManagedProcess) -> None:
        job = managed.job
        place = self._segment.instance, self._segment.header.epoch
        identity = job.identify(*place)
        description = job.describe(*place) if job.rules else identity  # with a layout, it is large
        managed.slot.digest = digest(identity)
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


def digest(description: bytes) -> bytes:
    """Return the SHA-256 digest of a process description, to compare it with another."""
    return hashlib.sha256(description).digest()
