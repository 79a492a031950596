"""Changes an instance to match a plan, after a reload or a take-over. ``changes`` compares the two.

Processes and blocks that already match the plan are not touched. For a reload, a thread makes the
plan, so that supervision continues meanwhile. The supervisor's loop then applies the plan.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Final

from shmio.control import Answer
from shmio.errors import ShmioError
from shmio.logs import fields
from shmio.plan.processes import Job, Plan
from shmio.segment import Activity, Block, Segment
from shmio.supervisor import policy
from shmio.supervisor.changes import injection_changes, preview, reconcile, refusal, register_changes
from shmio.supervisor.fleet import Fleet, brief, log
from shmio.supervisor.health import Notifier
from shmio.supervisor.policy import Event, Limits, State

PAUSE_S: Final = 6.0
"""Time in s within which a process whose registers change must pause; otherwise, the supervisor restarts it."""
FOLLOW_S: Final = 20.0
"""Time in s within which such a process must then run with its new registers; otherwise, it is restarted."""
_SETTLED = (State.RUNNING, State.BACKOFF, State.FATAL, State.STOPPED)


class _Followers:
    """The sources and emulators whose registers change while they keep their process and its connections.

    Each receives its new description and pauses. When the segment has been changed, the emulators
    change what they serve, and then the sources continue with their new blocks, so that no source
    asks its emulator for registers that are not there yet. A process that ends or takes too long is
    restarted instead, so that nothing waits for it for ever.
    """

    def __init__(self, fleet: Fleet, jobs: list[Job]) -> None:
        self._fleet = fleet
        self._jobs = {job.name: job for job in jobs}
        self._pids: dict[str, int] = {}
        self._waiting: list[str] = []
        """The names of the processes that pause."""
        self._before: dict[str, tuple[str, tuple[int, ...]]] = {}
        """By name, why a source has not kept its connection, and its attempts to connect before the change."""
        self.failed: dict[str, str] = {}
        """Why the other processes are restarted, by name."""
        self._deadline_s = time.monotonic() + PAUSE_S
        for job in sorted(jobs, key=lambda job: job.rank):
            managed = fleet.named(job.name)
            try:
                fleet.offer(managed, job)
            except OSError as error:
                self._fail(job.name, error.strerror or str(error))
            else:
                self._pids[job.name] = managed.child.pid if managed.child else 0

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the processes that are not restarted."""
        return tuple(self._pids)

    def _fail(self, name: str, why: str) -> None:
        self._pids.pop(name, None)
        self.failed[name] = why
        log.warning("the supervisor is restarting %s, because it cannot keep its connection: %s", name, why)

    def _all(self, activity: Activity, names: Iterable[str]) -> bool:
        """Return whether processes have reported an activity. Give up those that have ended or are late."""
        done = True
        for name in names:
            if (pid := self._pids.get(name)) is None:
                continue
            managed = self._fleet.named(name)
            if managed.life.state is not State.RUNNING or managed.child is None or managed.child.pid != pid:
                self._fail(name, managed.life.note or "its process has ended")
            elif not managed.reports(activity):
                if time.monotonic() >= self._deadline_s:
                    self._fail(name, "it was not ready in time")
                else:
                    done = False
        return done

    def paused(self) -> bool:
        """Return whether all remaining processes wait for the change of the segment."""
        return self._all(Activity.PAUSED, self.names)

    def go_on(self) -> None:
        """Let the remaining processes continue, the emulators first. Call this when the segment has been changed."""
        self._waiting = list(self._pids)
        emulators = [name for name in self._pids if self._jobs[name].kind == "emulator"]
        self._continue(emulators or self._waiting)

    def _continue(self, names: Iterable[str]) -> None:
        self._deadline_s = time.monotonic() + FOLLOW_S
        for name in tuple(names):
            self._waiting.remove(name)
            if name in self._pids:
                self._before[name] = self._fleet.named(name).slot.report.note, self._attempts(name)
                self._fleet.follow(self._fleet.named(name), self._jobs[name])

    def _attempts(self, name: str) -> tuple[int, ...]:
        """Return how often a source has connected, and how often it has failed. For an emulator, return nothing."""
        counters = self._fleet.named(name).slot.counters
        return tuple(counters[key] for key in ("connects", "failures") if key in counters)

    def outcome(self) -> Iterator[str]:
        """Yield a line for each process that was not restarted."""
        for name in self._pids:
            why, before = self._before[name]
            after = self._attempts(name)
            if self._jobs[name].kind == "emulator":
                yield f"{name}: changed, and keeps its clients"
            elif after == before:
                yield f"{name}: changed, and keeps its connection"
            elif after[0] > before[0]:
                yield f"{name}: changed, and connected again: {why or 'its connection was lost during the change'}"
            else:
                note = self._fleet.named(name).slot.report.note
                yield f"{name}: changed, but not connected: {note or why or 'its connection was lost'}"

    def running(self) -> bool:
        """Return whether all remaining processes run again. Restart those that have ended or take too long."""
        before = self.names
        done = self._all(Activity.RUNNING, [name for name in self._pids if name not in self._waiting])
        for name in set(before) - set(self._pids):
            self._fleet.apply(self._fleet.named(name), Event.RESTART)
        if done and self._waiting:
            self._continue(self._waiting)
            return False
        return done


class InstanceChange:
    """Changes an instance to match a plan: stops processes, changes blocks, starts processes."""

    def __init__(self, fleet: Fleet, segment: Segment, plan: Plan) -> None:
        """Begin the change.

        Raises:
            SegmentError: There is no room for new processes or blocks; nothing was changed.

        """
        self.plan = plan
        self.changes = reconcile(plan, segment.header.epoch, fleet, segment.blocks.values())
        present = {block.source: block.layout for block in segment.blocks.values()}
        self._layouts = [
            f"{spec.source}: registers: {register_changes(present[spec.source], spec.layout)}"
            for spec in self.changes.add
            if spec.source in present and present[spec.source].hash != spec.layout.hash
        ]
        self._unwell = {managed.name for managed in fleet if not managed.well}
        self._fleet = fleet
        self._segment = segment
        self._jobs = {job.name: job for job in plan.jobs}
        self._stopped = False
        self._injections: list[str] = []
        segment.processes.require(len(self.changes.started) - len(self.changes.stopped))
        segment.reserve(self.changes.add)  # last, because it cannot be undone
        self._followers = _Followers(fleet, [self._jobs[name] for name in self.changes.changed])
        self._signalled = [name for name in self.changes.kept if self._fleet.named(name).keep(self._jobs[name])]

    @property
    def _leaving(self) -> tuple[str, ...]:
        return (*self.changes.stopped, *self._replaced)

    @property
    def _replaced(self) -> tuple[str, ...]:
        return (*self.changes.replaced, *self._followers.failed)

    @property
    def _coming(self) -> list[Job]:
        names = {*self.changes.started, *self._replaced}
        return [job for job in self.plan.jobs if job.name in names]

    def step(self) -> bool:
        """Carry on as far as possible without waiting; return True if the change is complete.

        The change is complete when each process that it starts runs, or has failed once.
        """
        if not self._stopped:
            self._stopped = self._stop()
            if self._stopped:
                self._apply()
        if self._stopped:
            self._fleet.start_due()
        return self._stopped and self._followers.running() and all(self._has_come(job.name) for job in self._coming)

    def _has_come(self, name: str) -> bool:
        life = self._fleet.named(name).life
        return life.starts > 0 and life.state in _SETTLED

    @property
    def stuck(self) -> str:
        """Text about the processes that do not end although the change waits for their end; "" if none."""
        leaving = [] if self._stopped else [self._fleet.named(name) for name in self._leaving]
        return "; ".join(f"{managed.name}: {managed.life.note}" for managed in leaving if managed.life.stuck)

    def _stop(self) -> bool:
        """Stop the processes to remove or replace, in order of rank: the recorder stops last.

        Returns:
            True if all of them have ended.

        """
        if not self._followers.paused():  # first, so that a recorder records their last events
            return False
        leaving = [self._fleet.named(name) for name in self._leaving]
        for index in policy.to_stop([(managed.rank, managed.life) for managed in leaving]):
            self._fleet.apply(leaving[index], Event.STOP)
        return policy.all_gone([(managed.rank, managed.life) for managed in leaving])

    def _apply(self) -> None:
        """Change jobs and blocks, after the old processes have ended."""
        for name in self.changes.stopped:
            self._fleet.drop(name)
        for job in self._coming:
            self._fleet.assign(job)
        if self.changes.add or self.changes.retire or self.changes.started or self.changes.stopped:
            # After the change of the process table, which others read anew because of this change. Without the new
            # processes, whoever moves time would neither ring their doorbells nor wait until they deliver a step.
            self._segment.change(self.changes.add, self.changes.retire)
        for spec in self.plan.blocks:  # running processes follow this change without a restart
            self._declare(self._segment.blocks[spec.source], spec.declared)
        self._followers.go_on()

    def _declare(self, block: Block, declared: bytes) -> None:
        before = {declaration.name: declaration for declaration in block.declared.read()}
        block.declared.write(declared)
        block.commands.wake()
        after = {declaration.name: declaration for declaration in block.declared.read()}
        self._injections += injection_changes(block.source, before, after)

    def outcome(self) -> tuple[list[str], list[str]]:
        """Return (done, problems): a line for each thing that was done, and one for each problem."""
        done = [*(f"{name}: stopped" for name in self.changes.stopped), *self._injections]
        done += [f"{name}: the supervisor asked it to reload its tokens and roles" for name in self._signalled]
        done += self._followers.outcome()
        problems = []
        for job in self._coming:
            managed = self._fleet.named(job.name)
            how = "restarted, because its configuration has changed" if job.name in self._replaced else "started"
            if why := self._followers.failed.get(job.name):
                how += f"; it cannot keep its connection: {why}"
            if job.name in self.changes.replaced and job.name in self._unwell:
                how = "started again, because it was not running"
            if managed.life.state is State.RUNNING:
                done.append(f"{job.name}: {how}")
            else:
                why = managed.life.note or managed.life.state.value
                problems.append(f"{job.name}: {how}, but it is not running: {why}")
        return done + self._layouts, problems


class _PendingPlan:
    """Makes a plan in a thread, because compiling takes seconds and a file system may hang."""

    def __init__(self, replan: Callable[[], Plan], limit_s: float) -> None:
        self.read_ns = time.time_ns()
        self.limit_s = limit_s
        self._deadline = time.monotonic() + limit_s
        self._plan: Plan | None = None
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(replan,), name="plan", daemon=True)
        self._thread.start()

    def _run(self, replan: Callable[[], Plan]) -> None:
        try:
            self._plan = replan()
        except BaseException as error:  # noqa: BLE001 - raised by ``result``
            self._error = error

    @property
    def over(self) -> bool:
        return not self._thread.is_alive()

    @property
    def late(self) -> bool:
        """True if the time limit has passed. A result that comes later is ignored."""
        return not self.over and time.monotonic() >= self._deadline

    def result(self) -> Plan:
        """Return the plan, or raise the error that occurred while it was made."""
        if not self.over:
            raise ShmioError(
                f"the files that the configuration names could not be read within {self.limit_s:g} s; nothing has "
                "changed; check whether a file system hangs, then reload again"
            )
        if self._plan is None:
            raise self._error or RuntimeError("there is no plan")
        return self._plan


class Reloader:
    """Holds the present plan of the instance, and carries out one change of the instance at a time."""

    def __init__(
        self,
        fleet: Fleet,
        segment: Segment,
        notifier: Notifier,
        plan: Plan,
        replan: Callable[[], Plan],
        limits: Limits,
    ) -> None:
        self.plan = plan
        self.read_ns = time.time_ns()
        """When the configuration was read, in ns since 1970."""
        self._fleet = fleet
        self._segment = segment
        self._notifier = notifier
        self._replan = replan
        self._limits = limits
        self._planning: _PendingPlan | None = None
        self._change: InstanceChange | None = None
        self._answer: Answer | None = None
        self._previewing: _PendingPlan | None = None
        self._previewers: list[Answer] = []
        self._next_previewers: list[Answer] = []

    @property
    def in_progress(self) -> bool:
        """True while processes and blocks are being changed."""
        return self._change is not None

    def busy(self) -> str | None:
        """Return why another change cannot begin now; None if it can."""
        if self._change is None:
            return None
        if stuck := self._change.stuck:
            return f"another change of the instance is in progress and waits for a process that does not end: {stuck}"
        return "another change of the instance is in progress; try again when it is done"

    def follow(self) -> None:
        """Begin to change an instance that was taken over, so that it matches the plan.

        Raises:
            SegmentError: There is no room for new processes or blocks.

        """
        self._change = InstanceChange(self._fleet, self._segment, self.plan)

    def reload(self, answer: Answer) -> None:
        """Begin a reload: make a new plan, which :meth:`step` will apply. Refuse if a reload is in progress.

        The client that waits for ``answer`` gets the outcome of the reload.
        """
        reason = self.busy() or (self._planning and "another reload is being prepared; try again when it is done")
        if reason:
            answer.error(reason)
            return
        self._notifier.reloading()
        self._planning, self._answer = _PendingPlan(self._replan, self._limits.plan_s), answer

    def preview(self, answer: Answer) -> None:
        """Begin to make a new plan, and answer later what a reload would do. This never delays a reload.

        Requests that arrive while a plan is being made share the next plan, because the files may
        have changed in the meantime.
        """
        if reason := self.busy():
            answer.error(reason)
        elif self._previewing is None:
            self._begin_preview([answer])
        elif self._previewers:
            self._next_previewers.append(answer)
        else:  # the time limit has passed
            answer.error("a file of the configuration still cannot be read; check whether a file system hangs")

    def drop(self) -> None:
        """Cancel the reload and all previews, because the instance stops."""
        waiting = [*self._previewers, *self._next_previewers]
        for answer in [self._answer, *waiting] if self._answer else waiting:
            answer.error("the instance is stopping")
        self._planning = self._change = self._answer = None
        self._previewers, self._next_previewers = [], []

    def step(self) -> None:
        """Carry on with the reload, the change and the previews, as far as possible without waiting."""
        if self._planning is not None and (self._planning.over or self._planning.late):
            planning, self._planning = self._planning, None
            self._begin(planning)
        if self._change is not None:
            self._follow(self._change)
        if self._previewing is not None:
            self._follow_preview(self._previewing)

    def _begin_preview(self, answers: list[Answer]) -> None:
        self._previewing, self._previewers = _PendingPlan(self._replan, self._limits.plan_s), answers

    def _follow_preview(self, planning: _PendingPlan) -> None:
        """Answer the clients if the plan is complete or late. While its thread hangs, start no other."""
        if not (planning.over or planning.late):
            return
        answers, self._previewers = self._previewers, []
        if answers:
            how = self._preview_answer(planning)
            for answer in answers:
                how(answer)
        if planning.over:
            self._previewing = None
            if self._next_previewers:
                answers, self._next_previewers = self._next_previewers, []
                self._begin_preview(answers)
        else:
            for answer in self._next_previewers:
                self.preview(answer)
            self._next_previewers = []

    def _preview_answer(self, planning: _PendingPlan) -> Callable[[Answer], None]:
        faults: list[str] = []
        warnings: list[str] = []
        changes: dict[str, list[str]] = {}
        if reason := self.busy():
            return lambda answer: answer.error(reason)
        try:
            plan = planning.result()
            warnings = list(plan.warnings)
            if why := refusal(plan, self.plan):
                raise ShmioError(f"{plan.config_file}: {why}")
            changes = preview(plan, self.plan, self._segment.header.epoch, self._fleet, self._segment)
        except ShmioError as error:
            faults = str(error).split("\n")
        except Exception as error:  # noqa: BLE001  as in a reload
            log.exception("a dry run failed")
            failure = f"the dry run failed: {brief(error)}"
            return lambda answer: answer.error(failure)
        return lambda answer: answer.ok(faults=faults, warnings=warnings, **changes)

    def _begin(self, planning: _PendingPlan) -> None:
        try:
            plan = planning.result()
            if reason := refusal(plan, self.plan):
                raise ShmioError(f"{plan.config_file}: {reason}")
            self._change = InstanceChange(self._fleet, self._segment, plan)
        except Exception as error:  # noqa: BLE001 - a connector's own check may raise anything; the instance goes on
            expected = isinstance(error, ShmioError)
            reason = str(error) if expected else f"the reload failed: {brief(error)}"
            log.error("the reload changed nothing: %s", reason, exc_info=None if expected else error)
            self._answer_client(lambda answer: answer.error(reason))
            return
        self.plan, self.read_ns = plan, planning.read_ns

    def _follow(self, change: InstanceChange) -> None:
        if not change.step():
            if stuck := change.stuck:
                self._answer_client(
                    lambda answer: answer.error(f"{stuck}; the reload continues as soon as that process has ended")
                )
            return
        done, problems = change.outcome()
        for line in done:
            log.info("%s", line)
        for line in problems:
            log.error("%s", line)
        kept = list(change.changes.kept)
        log.info("the reload is done", extra=fields(kept=len(kept)))
        self._change = None
        result = {"warnings": list(change.plan.warnings), "done": done, "problems": problems, "kept": kept}
        self._answer_client(lambda answer: answer.ok(**result))

    def _answer_client(self, how: Callable[[Answer], None]) -> None:
        """Answer the client that asked for the reload, unless it already has an answer."""
        if self._answer is not None:
            self._notifier.ready()
            how(self._answer)
            self._answer = None
