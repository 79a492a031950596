"""A change of a running instance under way: what must go is stopped, the blocks are changed, what is new is started."""

from __future__ import annotations

from shmio.segment import Block, Segment
from shmio.supervisor import policy
from shmio.supervisor.fleet import Fleet
from shmio.supervisor.plan import Job, Plan
from shmio.supervisor.reconcile import reconcile
from shmio.supervisor.states import Event, State

SETTLED = (State.RUNNING, State.BACKOFF, State.FATAL, State.STOPPED)


class Change:
    """Brings an instance to a plan, a step at each call of :meth:`step`; what is as planned already is not touched."""

    def __init__(self, fleet: Fleet, segment: Segment, plan: Plan) -> None:
        """Begin. SegmentError: no room for what is new; then nothing has changed."""
        self.plan = plan
        present = fleet.present()
        self.changes = reconcile(plan, segment.header.epoch, present, segment.blocks.values())
        self._unwell = {name for name, found in present.items() if not found.well}
        self._fleet = fleet
        self._segment = segment
        self._jobs = {job.name: job for job in plan.jobs}
        self._stopped = False
        self._injections: list[str] = []
        segment.processes.require(len(self.changes.started) - len(self.changes.stopped))
        segment.reserve(self.changes.add)  # the last to fail: what it takes is not given back
        self._told = [name for name in self.changes.kept if self._fleet.named(name).keep(self._jobs[name])]

    @property
    def _leaving(self) -> tuple[str, ...]:
        return (*self.changes.stopped, *self.changes.replaced)

    @property
    def _coming(self) -> list[Job]:
        names = {*self.changes.started, *self.changes.replaced}
        return [job for job in self.plan.jobs if job.name in names]

    def step(self) -> bool:
        """Do what can be done now; whether the change is over: each new process runs, or has failed once."""
        if not self._stopped:
            self._stopped = self._stop()
            if self._stopped:
                self._turn()
        if self._stopped:
            self._fleet.start_due()
        return self._stopped and all(self._has_come(job.name) for job in self._coming)

    def _has_come(self, name: str) -> bool:
        life = self._fleet.named(name).life
        return life.starts > 0 and life.state in SETTLED

    @property
    def stuck(self) -> str:
        """Which processes must end and do not, if that is what is waited for."""
        leaving = [] if self._stopped else [self._fleet.named(name) for name in self._leaving]
        return "; ".join(f"{managed.name}: {managed.life.note}" for managed in leaving if managed.life.stuck)

    def _stop(self) -> bool:
        """Have all end that must, rank by rank, so that a recorder has the last of a source; whether they have."""
        leaving = [self._fleet.named(name) for name in self._leaving]
        for index in policy.to_stop([(managed.rank, managed.life) for managed in leaving]):
            self._fleet.apply(leaving[index], Event.STOP)
        return policy.all_gone([(managed.rank, managed.life) for managed in leaving])

    def _turn(self) -> None:
        """Between the old and the new."""
        if self.changes.add or self.changes.retire:
            self._segment.change(self.changes.add, self.changes.retire)
        for spec in self.plan.blocks:  # new ones have theirs; the others' processes follow without a restart
            self._declare(self._segment.blocks[spec.source], spec.declared)
        for name in self.changes.stopped:
            self._fleet.drop(name)
        for job in self._coming:
            self._fleet.assign(job)

    def _declare(self, block: Block, declared: bytes) -> None:
        before = {declaration.name: declaration for declaration in block.declared.read()}
        block.declared.write(declared)
        block.commands.wake()
        after = {declaration.name: declaration for declaration in block.declared.read()}
        for name in {**before, **after}:
            if before.get(name) != after.get(name):
                what = "laid" if name not in before else "changed" if name in after else "lifted"
                self._injections.append(f"injection {name}: {what} at {block.source}")

    def outcome(self) -> tuple[list[str], list[str]]:
        """What was done, and what came out badly, a line each."""
        done = [*(f"{name}: stopped" for name in self.changes.stopped), *self._injections]
        done += [f"{name}: told to take its tokens and roles anew" for name in self._told]
        problems = []
        for job in self._coming:
            managed = self._fleet.named(job.name)
            how = "restarted, as its configuration has changed" if job.name in self.changes.replaced else "started"
            if job.name in self.changes.replaced and job.name in self._unwell:
                how = "started again, as it was not running"
            if managed.life.state is State.RUNNING:
                done.append(f"{job.name}: {how}")
            else:
                why = managed.life.note or managed.life.state.value
                problems.append(f"{job.name}: {how}, but it does not run: {why}")
        return done, problems
