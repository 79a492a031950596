"""A supervised process: its slot, job and life, and the log lines about it."""

from __future__ import annotations

import logging

from shmio.local.status import complaint as complaint_of
from shmio.logs import fields
from shmio.plan.processes import Job, rank
from shmio.segment import Activity, ProcessSlot
from shmio.supervisor import policy
from shmio.supervisor.control import Answer
from shmio.supervisor.policy import Life, Limits
from shmio.supervisor.process import AdoptedProcess, ChildProcess, describe_end
from shmio.supervisor.states import Action, State

log = logging.getLogger("shmio.supervisor")


class ManagedProcess:
    """A slot with its job, its life, and its process while there is one."""

    def __init__(self, slot: ProcessSlot) -> None:
        self.slot = slot
        self.life = Life()
        self.child: ChildProcess | AdoptedProcess | None = None
        self.waiting: list[Answer] = []
        self.evicted_pid = 0
        """The process last killed because it held this role."""
        self.complaint = ""
        """The problem that the running process reports, as of :meth:`listen`.

        Empty if there is none.
        """
        self._missed = 0
        self._job: Job | None = None
        self._beat_ns = 0
        self._quiet_ns = 0

    @property
    def name(self) -> str:
        """The name of the process."""
        return self.slot.name

    @property
    def rank(self) -> int:
        """Place in the order of start. Unknown kinds stop last."""
        return rank(self.slot.name, self.slot.kind)

    @property
    def job(self) -> Job:
        """The job it runs; LookupError for a process that was found and is only to be stopped."""
        if self._job is None:
            raise LookupError(f"{self.name} has no job")
        return self._job

    def renew(self, job: Job) -> None:
        """Begin a new life with another job."""
        self._job = job
        self.life = Life()

    def keep(self, job: Job) -> bool:
        """Continue with a job from a new plan.

        A process that another supervisor started may have had rules, so it is signalled in any
        case.

        Returns:
            Whether the process was signalled to read its rules again.

        """
        before, self._job = self._job, job
        known = bool(job.rules or (before and before.rules))
        if self.child is None or job.rules is None or not (known or before is None):
            return False
        self.child.reread()
        return known

    def adopt(self, child: AdoptedProcess) -> None:
        """Adopt a running process of another supervisor."""
        supervised = self.slot.supervised
        self.child = child
        self.life = policy.adopted(supervised.spawned_ns, supervised.restarts)

    @property
    def ready(self) -> bool:
        """Whether the present process itself has reported that it runs."""
        report = self.slot.report
        return self.child is not None and report.pid == self.child.pid and report.activity is Activity.RUNNING

    @property
    def advice(self) -> str:
        """The end of a message about a failed start: what to do if the process was too late; else empty."""
        late = self.life.hang and self.life.hang in self.life.note
        return f"; see its log, {self.job.log_file}; the host may be overloaded" if late else ""

    def listen(self) -> None:
        """Read the problem that the process reports; log its end and what was lost."""
        running = self.life.state is State.RUNNING
        complaint = complaint_of(self.slot.kind, self.slot.report.note) if running else ""
        lost = ("dropped", "changes") if self.slot.kind == "mqtt" else ("missed", "frames and events")
        missed = self.slot.counters.get(lost[0], 0) if running else 0  # a process counts from its start
        if self.complaint and running and not complaint:
            log.info("%s has recovered; %d %s were lost", self.name, max(0, missed - self._missed), lost[1])
        if not complaint:
            self._missed = missed
        self.complaint = complaint

    def quiet_ns(self, elapsed_ns: int) -> int:
        """Return the time without a heartbeat, not counting pauses of the supervisor, in ns."""
        beat_ns = self.slot.heartbeat_ns
        # The first look at a running process starts the count, too.
        fresh = beat_ns != self._beat_ns or self.life.state is not State.RUNNING
        self._beat_ns = beat_ns
        self._quiet_ns = 0 if fresh else self._quiet_ns + elapsed_ns
        return self._quiet_ns

    def end_note(self, pid: int, code: int | None) -> str:
        """Return why the process ended, with its last message if there is one."""
        end = describe_end(code)
        if code is not None and code <= 0:
            return end
        report = self.slot.report
        words = report.note if report.pid == pid and report.note else ""
        words = words or (self.child.last_words() if self.child else "")
        return f"{words} ({end})" if words else end

    def answer(self) -> None:
        """Answer the clients that wait for a restart, if it is over."""
        state = self.life.state
        if self.life.stuck:
            for answer in self.waiting:
                answer.error(f"{self.name}: {self.life.note}; it starts again as soon as it has ended")
            self.waiting.clear()
        if state not in (State.RUNNING, State.BACKOFF, State.FATAL, State.STOPPED):
            return
        for answer in self.waiting:
            if state is State.RUNNING:
                answer.ok()
            else:
                answer.error(f"{self.name} did not come back: {self.life.note or state.value}")
        self.waiting.clear()


def log_step(managed: ManagedProcess, before: Life, action: Action | None, limits: Limits) -> None:
    """Log one change of state, if it is worth a line."""
    name, life = managed.name, managed.life
    if life.stuck:
        if not before.stuck:
            log.error("%s: %s", name, life.note)
    elif life.state is State.RUNNING:
        log.info("%s running", name, extra=fields(pid=managed.child.pid) if managed.child else None)
    elif life.state is State.HUNG:
        log.warning("%s hangs, %s: killed", name, life.note)
    elif life.state is State.FATAL:
        log.error("%s cannot work as configured: %s", name, life.note)
    elif life.state is State.BACKOFF:
        wait_s = policy.backoff_s(life.crashes, limits)
        when = f"in {wait_s:g} s" if wait_s else "at once"
        log.warning("%s crashed: %s; starting it again %s", name, life.note, when)
    elif life.state is State.STOPPED:
        log.info("%s stopped", name)
    elif action is Action.KILL and before.state is life.state:
        log.warning("%s does not stop: killed", name)


def brief(error: Exception) -> str:
    """Return an unexpected error in one line. Its traceback belongs into the log."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]
