"""The supervisor: one thread, one selector; what happens goes to ``policy``, what it decides is done here."""

from __future__ import annotations

import os
import selectors
import signal
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from types import FrameType
from typing import Final

from shmio.errors import SegmentError, ShmioError
from shmio.logs import fields
from shmio.segment import Phase, Quality, Segment, Supervised, leftover
from shmio.segment import State as InstanceState
from shmio.supervisor import policy
from shmio.supervisor.control import Answer, ControlServer, Request, Restart, Stop, socket_path
from shmio.supervisor.managed import Managed, log, log_step
from shmio.supervisor.plan import MODULES, Plan
from shmio.supervisor.policy import Life, Limits
from shmio.supervisor.process import Child
from shmio.supervisor.states import PHASES, Action, Event, State

TICK_S: Final = 0.1
"""How often heartbeats are looked at."""
START_TICK_S: Final = 0.01
"""The same while a process starts: its report has no bell to ring."""
QUALITY_S: Final = 0.5
"""How often the sources' quality is looked at, once the start is over."""
NAME_S: Final = 1.0
"""How often it is made sure that the segment can still be found."""


class Supervisor:
    """Runs an instance from its start to its clean end. Use once, from the main thread."""

    def __init__(
        self,
        plan: Plan,
        *,
        limits: Limits | None = None,
        modules: Mapping[str, str] = MODULES,
        on_state: Callable[[InstanceState], None] = lambda _: None,
    ) -> None:
        """``on_state`` is told each new state of the instance; the folder of the log files must exist."""
        self._plan = plan
        self._limits = limits or Limits()
        self._modules = modules
        self._on_state = on_state
        self._selector = selectors.DefaultSelector()
        self._managed: list[Managed] = []
        self._state = InstanceState.STARTING
        self._stopping = False
        self._started = False
        self._failure: str | None = None
        self._stop_answers: list[Answer] = []
        self._qualities: list[Quality | None] = []
        self._qualities_ns = 0
        self._ticked_ns = 0
        self._found_ns = 0

    def run(self) -> None:
        """Start everything, watch it, and return when all is stopped as asked.

        AlreadyRunningError: another supervisor has the instance. SegmentError, ControlError: no room for the segment,
        no place for the socket. ShmioError: a process could not be started, or the segment was removed; all is stopped.
        """
        for line in leftover.clear(self._plan.instance):
            log.warning("%s", line)
        with ExitStack() as stack:
            stack.callback(self._selector.close)
            stack.enter_context(self._signals())
            self._segment = stack.enter_context(self._create())
            stack.callback(self._segment.unlink)
            self._control = ControlServer(self._segment.header.control, self._selector, self._handle)
            stack.callback(self._control.close)
            self._managed = [
                Managed(job, slot) for job, slot in zip(self._plan.jobs, self._segment.processes, strict=True)
            ]
            stack.callback(self._kill_all)
            log.info("supervising", extra=fields(instance=self._plan.instance, segment=self._segment.shared.name))
            self._ticked_ns = time.monotonic_ns()
            while not self._tick():
                for key, _ in self._selector.select(self._pause_s()):
                    key.data()
            self._segment.set_state(os.getpid(), InstanceState.STOPPED)
            self._control.retire()
            self._segment.unlink()  # before the answers: who asked may start the instance again at once
            for answer in self._stop_answers:
                answer.ok()
            log.info("stopped")
        if self._failure is not None:
            raise ShmioError(self._failure)

    def _create(self) -> Segment:
        plan = self._plan
        return Segment.create(
            plan.instance,
            plan.blocks,
            plan.processes,
            mode=plan.mode,
            control=socket_path(plan.instance),
            group=plan.group,
        )

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Signals wake the selector; nothing is done in a handler. SIGHUP counts unless it is ignored, as by nohup."""
        receiver, sender = socket.socketpair()
        with receiver, sender:
            receiver.setblocking(False)
            sender.setblocking(False)
            self._selector.register(receiver, selectors.EVENT_READ, lambda: self._on_signal(receiver.recv(64)))
            old_fd = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
            heeded = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
            if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
                heeded.remove(signal.SIGHUP)
            old = {sign: signal.signal(sign, _wake) for sign in heeded}
            try:
                yield
            finally:
                for sign, handler in old.items():
                    signal.signal(sign, handler)
                signal.set_wakeup_fd(old_fd)
                self._selector.unregister(receiver)

    def _on_signal(self, numbers: bytes) -> None:
        for number in numbers:
            log.info("%s", signal.Signals(number).name)
            if self._stopping and number != signal.SIGHUP:  # shell and kernel send one each
                self._hasten()
            self._stopping = True

    def _hasten(self) -> None:
        """Asked a second time: no more grace."""
        log.warning("killing what has not stopped yet")
        for managed in self._managed:
            self._apply(managed, Event.HASTEN)

    def _handle(self, request: Request, answer: Answer) -> None:
        if isinstance(request, Stop):
            log.info("asked to stop")
            self._stop_answers.append(answer)
            self._stopping = True
        elif isinstance(request, Restart):
            self._restart(request.name, answer)
        else:
            answer.ok(config=str(self._plan.config_file), log_dir=str(self._plan.log_dir))

    def _restart(self, name: str, answer: Answer) -> None:
        managed = next((m for m in self._managed if m.job.name == name), None)
        if managed is None:
            names = ", ".join(m.job.name for m in self._managed) or "none"
            answer.error(f"no process {name!r}; there are: {names}")
        elif self._stopping:
            answer.error("the instance is stopping")
        else:
            log.info("asked to restart %s", name)
            managed.waiting.append(answer)
            self._apply(managed, Event.RESTART)

    def _pause_s(self) -> float:
        return START_TICK_S if any(m.life.state is State.STARTING for m in self._managed) else TICK_S

    def _tick(self) -> bool:
        """Look at everything once; True when all is stopped."""
        now_ns = time.monotonic_ns()
        # If the supervisor itself was held up (host suspended, container paused), so were the others: what it did not
        # live through does not count against them.
        elapsed_ns = min(now_ns - self._ticked_ns, round(2 * TICK_S * 1e9))
        self._ticked_ns = now_ns
        for managed in self._managed:
            quiet_ns = managed.quiet_ns(elapsed_ns)
            event = policy.due(managed.life, now_ns, ready=managed.ready, quiet_ns=quiet_ns, limits=self._limits)
            if event is not None:
                self._apply(managed, event)
        self._control.expire()
        if not self._stopping and now_ns - self._found_ns >= NAME_S * 1e9:
            self._found_ns = now_ns
            self._follow_name()
        if not self._stopping and not self._started:
            self._follow_start(now_ns)
        if self._stopping:
            for index in policy.to_stop(self._ranked):
                self._apply(self._managed[index], Event.STOP)
        self._tell(now_ns)
        return self._stopping and policy.all_gone(self._ranked)

    @property
    def _ranked(self) -> list[tuple[int, Life]]:
        return [(managed.job.rank, managed.life) for managed in self._managed]

    def _follow_name(self) -> None:
        """Without its name nobody finds the segment: the instance could not even be stopped."""
        if not self._segment.shared.current():
            name = self._segment.shared.name
            self._failure = f"the shared memory {name} was removed while the instance ran: all is stopped"
            log.error("%s", self._failure)
            self._stopping = True

    def _follow_start(self, now_ns: int) -> None:
        for managed in self._managed:
            reason = policy.start_failure(managed.life, self._limits)
            if reason is not None:
                self._failure = f"{managed.job.name}: {reason}"
                log.error("the start failed: %s", self._failure)
                self._stopping = True
                return
        for index in policy.to_start(self._ranked):
            self._apply(self._managed[index], Event.START)
        since_ns = max((m.life.ready_ns or 0 for m in self._managed), default=0)
        self._started = policy.start_over(self._ranked, self._look(), since_ns, now_ns, self._limits)

    def _look(self) -> list[Quality | None]:
        """The quality of each source as of now."""
        qualities: list[Quality | None] = []
        for block in self._segment.blocks.values():
            try:
                frame = block.latest()
            except SegmentError:
                qualities.append(Quality.BAD)
            else:
                qualities.append(None if frame is None else frame.assess(block.stale_ns)[0])
        return qualities

    def _tell(self, now_ns: int) -> None:
        """Publish the state of the instance, which is the supervisor's heartbeat too."""
        state = InstanceState.STARTING
        if self._stopping:
            state = InstanceState.STOPPING
        elif self._started:
            if now_ns - self._qualities_ns >= QUALITY_S * 1e9:
                self._qualities, self._qualities_ns = self._look(), now_ns
            state = policy.assess([m.life.state is State.RUNNING for m in self._managed], self._qualities)
        self._segment.set_state(os.getpid(), state)
        if state is not self._state:
            self._state = state
            reasons = ", ".join(self._weak()) if state is InstanceState.DEGRADED else ""
            log.info("instance %s%s", state, f": {reasons}" if reasons else "")
            self._on_state(state)

    def _weak(self) -> list[str]:
        """What makes the instance degraded."""
        weak = [f"{m.job.name} is not running" for m in self._managed if m.life.state is not State.RUNNING]
        named = zip(self._segment.blocks, self._qualities, strict=True)
        return weak + [f"source {name} is bad" for name, quality in named if quality in (None, Quality.BAD)]

    def _apply(self, managed: Managed, event: Event, note: str = "") -> None:
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
        self._answer(managed)

    def _spawn(self, managed: Managed) -> None:
        job = managed.job
        try:
            child = Child.spawn(
                self._modules[job.kind],
                job.describe(self._plan.instance, self._segment.header.epoch),
                job.log_file,
            )
        except OSError as error:
            self._apply(managed, Event.EXIT, f"cannot be started: {error.strerror}")
            return
        managed.child = child
        self._selector.register(child.pidfd, selectors.EVENT_READ, lambda: self._on_exit(managed, child))

    def _on_exit(self, managed: Managed, child: Child) -> None:
        self._selector.unregister(child.pidfd)
        code = child.reap()
        note = managed.end_note(child.pid, code)
        managed.child = None
        self._apply(managed, policy.ended(code), note)

    def _publish(self, managed: Managed) -> None:
        life = managed.life
        managed.slot.supervised = Supervised(PHASES[life.state], life.restarts, life.spawned_ns, life.note)

    def _answer(self, managed: Managed) -> None:
        """Tell those who asked for a restart how it went."""
        state = managed.life.state
        if state not in (State.RUNNING, State.BACKOFF, State.FATAL, State.STOPPED):
            return
        for answer in managed.waiting:
            if state is State.RUNNING:
                answer.ok()
            else:
                answer.error(f"{managed.job.name} did not come back: {managed.life.note or state.value}")
        managed.waiting.clear()

    def _kill_all(self) -> None:
        """Leave no process behind, should the loop itself have failed; after a stop there is none."""
        for managed in self._managed:
            if managed.child is not None:
                managed.child.kill()
                managed.child.reap()
                managed.life = replace(managed.life, state=State.STOPPED)
                managed.slot.supervised = Supervised(Phase.STOPPED)


def _wake(_number: int, _frame: FrameType | None) -> None:
    """A handler must exist for the wake-up descriptor to be written."""
