"""Runs the supervisor in one thread, with one selector.

``fleet`` manages the processes, and ``reload`` changes them to match a plan.
"""

from __future__ import annotations

import os
import selectors
import signal
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Final

from shmio.audit import trail
from shmio.audit.reading import SUPERVISOR, last_events
from shmio.audit.trail import Acting, Actor, program_of, uid_actor
from shmio.control import Answer, ControlServer, Peer, Reload, Request, Restart, Stop, Where, socket_path
from shmio.errors import ShmioError
from shmio.logs import fields
from shmio.plan.processes import MODULES, Plan
from shmio.segment import Segment
from shmio.segment import State as InstanceState
from shmio.supervisor import policy
from shmio.supervisor.fleet import TICK_S, Fleet, brief, log
from shmio.supervisor.health import Health, LogFolder, Notifier
from shmio.supervisor.local_commands import LocalCommands
from shmio.supervisor.policy import Event, Limits, State
from shmio.supervisor.reload import Reloader
from shmio.supervisor.takeover import take_over
from shmio.times import utc_text
from shmio.wording import unknown

START_TICK_S: Final = 0.01
"""Interval in s of checks while a process starts, because the process's report does not wake the supervisor."""
MAX_ADDRESSES: Final = 16
"""Maximum number of listening addresses of one process in an answer."""
ACTIONS: Final = {Stop: "down", Restart: "restart", Reload: "reload"}
"""The name of each request in the audit log."""
NAME_S: Final = 1.0
"""Interval in s at which to check whether the segment still exists under its name."""


class Supervisor:
    """Runs an instance from its start to its clean end. Use an object once, in the main thread."""

    def __init__(
        self,
        plan: Plan,
        *,
        replan: Callable[[], Plan],
        limits: Limits | None = None,
        modules: Mapping[str, str] = MODULES,
        on_state: Callable[[InstanceState], None] = lambda _: None,
    ) -> None:
        """Create the supervisor.

        Args:
            plan: The instance to run. The folder of the log files must exist.
            replan: Makes a new plan from the present configuration, for a reload. It may raise
                ShmioError.
            limits: Time-outs and counts for the processes.
            modules: The Python module of each kind of process.
            on_state: Called with each new state of the instance.

        """
        self._plan = plan
        self._replan = replan
        self._limits = limits or Limits()
        self._modules = modules
        self._on_state = on_state
        self._notifier = Notifier()
        self._selector = selectors.DefaultSelector()
        self._stopping = False
        self._started = False
        self._failure: str | None = None
        self._stop_answers: list[Answer] = []
        self._found_ns = 0
        self._adopted: dict[str, int] = {}
        self.history: list[str] = []
        """Lines that say what an earlier supervisor left behind, and what was done with it."""

    def run(self) -> None:
        """Start the instance, or take over what a dead supervisor has left; return when it has stopped.

        Raises:
            AlreadyRunningError: Another supervisor runs the instance.
            SegmentError: There is not enough memory for the segment.
            ControlError: The control socket cannot be created.
            ShmioError: A process could not be started, or the segment was removed, and all processes
                were stopped; or the supervisor itself failed, and its processes continue, so that
                the next supervisor can take them over.

        """
        with ExitStack() as stack:
            stack.callback(self._selector.close)
            trail.open_trail(self._plan.audit, self._plan.instance, SUPERVISOR)
            stack.callback(trail.close_trail)
            stack.enter_context(_wake_on_signals(self._selector, self._on_signal))
            path = socket_path(self._plan.instance)
            found, self.history = take_over(self._plan, path, self._limits)
            for line in self.history:
                log.warning("%s", line)
            self._segment = stack.enter_context(found.segment if found else self._create(path))
            fresh = stack.enter_context(ExitStack())  # undone if the start fails early
            if not found:
                fresh.callback(self._segment.unlink)
            self._control = ControlServer(path, self._selector, self._handle, self._deny)
            stack.callback(self._control.close)
            self._fleet = Fleet(self._segment, self._selector, self._limits, self._modules)
            logs = LogFolder(self._plan.log_dir)
            self._health = Health(self._segment, self._fleet, self._notifier, logs, self._on_state)
            self._reloader = Reloader(
                self._fleet, self._segment, self._notifier, self._plan, self._replan, self._limits
            )
            if found:  # if this fails, the segment stays for the next attempt
                for slot, child in found.children:
                    self._fleet.adopt(self._fleet.named(slot.name), child)
                    self._adopted[slot.name] = child.pid
                self._reloader.follow()
            else:
                for job in self._plan.jobs:
                    self._fleet.assign(job)
            how = {"mode": self._plan.mode, "config": str(self._plan.config_file)}
            trail.record("up", how, "took over" if found else "done", "; ".join(self.history), who=_own_actor())
            log.info(
                "the supervisor is running",
                extra=fields(instance=self._plan.instance, segment=self._segment.shared.name),
            )
            fresh.pop_all()
            if self._plan.audit is not None:
                began = utc_text(self._segment.header.started_utc_ns / 1e9)
                known = last_events(Path(self._plan.audit.path), began) if found else {}
                stack.callback(LocalCommands(self._plan.instance, known).close)
            self._loop()
            for job in self._reloader.plan.jobs:
                job.remove_sockets()
            self._control.sweep()
            self._segment.set_state(os.getpid(), InstanceState.STOPPED)
            self._control.retire()
            self._segment.unlink()  # before answering: the client may start it again at once
            for answer in self._stop_answers:
                answer.ok()
            trail.record("stopped", {}, "failed" if self._failure else "done", self._failure or "")
            log.info("the instance is stopped, and the supervisor ends")
        if self._failure is not None:
            raise ShmioError(self._failure)

    def _loop(self) -> None:
        try:
            while not self._tick():
                for key, _ in self._selector.select(self._pause_s()):
                    key.data()
        except Exception as error:  # noqa: BLE001 - the last place to report it
            log.exception("the supervisor failed; running processes continue")
            why = f"the supervisor failed: {brief(error)}"
            raise ShmioError(f"{why}; its processes continue, and shmio-supervisor up takes them over") from None

    def _create(self, path: str) -> Segment:
        plan = self._plan
        return Segment.create(
            plan.instance,
            plan.blocks,
            plan.processes,
            mode=plan.mode,
            control=path,
            config=plan.config_file,
            group=plan.group,
            stepped=plan.stepped,
            origin=plan.origin,
        )

    def _on_signal(self, number: int) -> None:
        name = signal.Signals(number).name
        log.info("the supervisor received the signal %s", name)
        trail.record("down", {}, "accepted", who=Acting(Actor("signal", name), SUPERVISOR))
        if self._stopping and number != signal.SIGHUP:  # shell and kernel may each send a SIGHUP
            self._hasten()
        self._stop()

    def _stop(self) -> None:
        if not self._stopping:
            self._notifier.stopping()
            self._segment.set_state(os.getpid(), InstanceState.STOPPING)  # before a process receives SIGTERM
        self._stopping = True
        self._reloader.drop()

    def _hasten(self) -> None:
        """Kill the processes that have not stopped yet, after a second request to stop.

        Whoever is in a hurry may kill the supervisor next, so remove the segment's name at once.
        """
        log.warning("the supervisor is killing the processes that have not stopped yet")
        for managed in self._fleet:
            self._fleet.apply(managed, Event.HASTEN)
        self._segment.unlink()

    def _handle(self, request: Request, answer: Answer) -> None:
        if not (isinstance(request, Where) or (isinstance(request, Reload) and request.dry_run)):
            answer.ended = self._audit(request, answer.peer)
        if isinstance(request, Stop):
            log.info("a client asked to stop the instance")
            self._stop_answers.append(answer)
            self._stop()
        elif isinstance(request, Restart):
            self._restart(request.name, answer)
        elif isinstance(request, Reload):
            self._reload(answer, dry_run=request.dry_run)
        else:
            plan, read_ns = self._reloader.plan, self._reloader.read_ns
            listen = {job.name: found for job in plan.jobs if (found := job.listening[:MAX_ADDRESSES])}
            answer.ok(
                config=str(plan.config_file),
                read_ns=read_ns,
                log_dir=str(plan.log_dir),
                snapshot_dir=str(plan.snapshot_dir),
                listen=listen,
            )

    def _audit(self, request: Request, peer: Peer) -> Callable[[str], None]:
        """Write a client's request to the audit log; return a function that writes its outcome."""
        action, what = ACTIONS[type(request)], {"process": request.name} if isinstance(request, Restart) else {}
        with trail.acting(self._actor(peer), SUPERVISOR):
            attempt = trail.Attempt(action, what)
        return lambda failure: attempt.end("failed" if failure else "done", failure)

    def _deny(self, peer: Peer) -> None:
        reason = "only the supervisor's own user and root may control the instance"
        trail.record("control", {}, "denied", reason, who=Acting(self._actor(peer), SUPERVISOR))

    def _actor(self, peer: Peer) -> Actor:
        own = next((managed.name for managed in self._fleet if managed.slot.report.pid == peer.pid), None)
        return uid_actor(peer.uid, f"pid {peer.pid} {own or program_of(peer.pid)}".rstrip())

    def _busy(self) -> str | None:
        """Return why requests for changes are refused at present; None if they are accepted."""
        return "the instance is stopping" if self._stopping else self._reloader.busy()

    def _restart(self, name: str, answer: Answer) -> None:
        if name not in self._fleet.names:
            answer.error(unknown("process", name, self._fleet.names))
        elif reason := self._busy():
            answer.error(reason)
        else:
            log.info("a client asked to restart %s", name)
            managed = self._fleet.named(name)
            managed.waiting.append(answer)
            self._fleet.apply(managed, Event.RESTART)
            managed.answer()  # a stuck process is reported at once

    def _reload(self, answer: Answer, *, dry_run: bool) -> None:
        reason = self._busy() or (None if self._started else "the instance is starting; try again when it is running")
        if not dry_run:
            log.info("a client asked to reload %s", self._reloader.plan.config_file)
        if reason:
            answer.error(reason)
        elif dry_run:
            self._reloader.preview(answer)
        else:
            self._reloader.reload(answer)

    def _replaced(self) -> list[str]:
        """Return a line about each adopted process that was immediately replaced or stopped."""
        lines = []
        for name, pid in self._adopted.items():
            managed = self._fleet.named(name) if name in self._fleet.names else None
            if managed is None:
                lines.append(f"{name}, pid {pid}, was stopped at once: it is no longer in the configuration")
            elif managed.child is None or managed.child.pid != pid:
                lines.append(f"{name}, pid {pid}, was replaced at once: its configuration has changed")
        return lines

    def _pause_s(self) -> float:
        starting = any(m.life.state is State.STARTING for m in self._fleet)
        return START_TICK_S if starting else TICK_S

    def _tick(self) -> bool:
        """Check everything once; return True when all processes have stopped."""
        now_ns = time.monotonic_ns()
        self._fleet.check(now_ns)
        self._control.expire()
        if not self._stopping and now_ns - self._found_ns >= NAME_S * 1e9:
            self._found_ns = now_ns
            self._follow_name()
        taking_over = self._reloader.in_progress
        self._reloader.step()
        if taking_over:
            if not self._reloader.in_progress and not self._started:
                self._started = True
                self.history += self._replaced()
        elif not self._stopping and not self._started:
            self._follow_start(now_ns)
        if self._stopping:
            self._fleet.stop_due()
            self._follow_stop()
        self._health.publish(now_ns, started=self._started, stopping=self._stopping)
        return self._stopping and policy.all_gone(self._fleet.ranked)

    def _follow_stop(self) -> None:
        """If stuck processes prevent the stop, answer the clients that wait for it."""
        there = [managed for managed in self._fleet if managed.life.state is not State.STOPPED]
        if there and all(managed.life.stuck for managed in there):
            stuck = "; ".join(f"{managed.name}: {managed.life.note}" for managed in there)
            for answer in self._stop_answers:
                answer.error(
                    f"all other processes are stopped, but {stuck}; the stop continues as soon as that process "
                    "has ended"
                )
            self._stop_answers.clear()

    def _follow_name(self) -> None:
        """Stop if the segment no longer has its name: nobody could find or stop the instance."""
        if not self._segment.shared.current():
            name = self._segment.shared.name
            self._failure = (
                f"the shared memory {name} was removed while the instance ran; the supervisor is stopping all processes"
            )
            log.error("%s", self._failure)
            self._stop()

    def _follow_start(self, now_ns: int) -> None:
        for managed in self._fleet:
            reason = policy.start_failure(managed.life, self._limits)
            if reason is not None:
                self._failure = f"{managed.name}: {reason}{managed.advice}"
                log.error("the start failed: %s", self._failure)
                self._stop()
                return
        self._fleet.start_due()
        since_ns = max((m.life.ready_ns or 0 for m in self._fleet), default=0)
        self._started = policy.start_over(self._fleet.ranked, self._health.qualities(), since_ns, now_ns, self._limits)


def _own_actor() -> Acting:
    """Return who has started this supervisor."""
    pid = os.getppid()
    return Acting(uid_actor(os.getuid(), f"pid {pid} {program_of(pid)}".rstrip()), SUPERVISOR)


@contextmanager
def _wake_on_signals(selector: selectors.BaseSelector, on_signal: Callable[[int], None]) -> Iterator[None]:
    """Call ``on_signal`` from the selector's loop for SIGINT, SIGTERM and SIGHUP.

    SIGHUP is left out if it is ignored, as under nohup.
    """
    receiver, sender = socket.socketpair()
    with receiver, sender:
        receiver.setblocking(False)
        sender.setblocking(False)

        def receive() -> None:
            for number in receiver.recv(64):
                on_signal(number)

        selector.register(receiver, selectors.EVENT_READ, receive)
        old_fd = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
        handled = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
        if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
            handled.remove(signal.SIGHUP)
        old = {sign: signal.signal(sign, _wake) for sign in handled}
        try:
            yield
        finally:
            for sign, handler in old.items():
                signal.signal(sign, handler)
            signal.set_wakeup_fd(old_fd)
            selector.unregister(receiver)


def _wake(_number: int, _frame: FrameType | None) -> None:
    """Do nothing. Python writes to the wake-up descriptor only for signals that have a handler."""
