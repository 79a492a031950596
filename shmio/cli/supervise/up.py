"""``shmio-supervisor up``: start an instance, in the foreground or detached."""

from __future__ import annotations

import argparse
import logging
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from shmio import logs
from shmio.cli.supervise import logdir
from shmio.cli.supervise.ports import check_ports
from shmio.cli.supervise.prepare import Prepared, peer, prepare
from shmio.cli.target import ask, config_file, option_for
from shmio.errors import AlreadyRunningError, ConfigError, ControlError, ShmioError
from shmio.logs import printable
from shmio.segment import PREFIX, Segment, State, instances, leftover
from shmio.segment.segment import refuse_second
from shmio.segment.status import InstanceStatus, SourceStatus, read_status
from shmio.supervisor import control
from shmio.supervisor.main import Supervisor
from shmio.supervisor.plan import MODES, Job, Plan
from shmio.supervisor.process import child_environment

WHERE_S = 5.0
DETACH_S = 120.0
"""The longest time that the start of a detached instance is waited for."""


def execute(arguments: argparse.Namespace) -> int:
    """Start the instance; return when it has stopped, or with ``--detach`` when it runs."""
    if arguments.mode not in MODES:
        raise ConfigError(f"--mode {arguments.mode}: this version of shmio has the modes {', '.join(MODES)} only")
    file = config_file(arguments)
    if arguments.report is not None:
        return _detached(file, arguments.mode, arguments.report)
    prepared = prepare(file, arguments.mode)
    for warning in prepared.plan.warnings:
        _say(warning, sys.stderr)
    return _detach(prepared, option_for(file)) if arguments.detach else _foreground(prepared)


def _foreground(prepared: Prepared) -> int:
    _refuse(prepared.plan)
    left_over = prepared.plan.instance in instances()
    _announce(prepared, None if left_over else prepared.plan.segment_bytes)
    _say("Ctrl-C stops it, and so does closing the terminal")
    console = logging.StreamHandler(sys.stderr)
    console.setFormatter(_Console())
    plan = prepared.plan
    with logdir.held(plan.log_dir, plan.instance):
        logs.setup(plan.log_dir / "supervisor.log", "supervisor")
        logging.getLogger("shmio.supervisor").addHandler(console)
        Supervisor(plan, replan=_replan(plan)).run()
    return 0


def _refuse(plan: Plan) -> None:
    """AlreadyRunningError; EndpointError when a port is taken, which those that a dead supervisor left may well be."""
    try:
        refuse_second(plan.instance)
    except AlreadyRunningError as error:
        raise AlreadyRunningError(f"{error}{_whose(plan)}") from None
    if not leftover.living(plan.instance):
        check_ports(plan)


def _whose(plan: Plan) -> str:
    """From which file the running instance of this name was started, and what to do about it."""
    down = f"shmio-supervisor down --instance {plan.instance} stops it"
    with suppress(ShmioError), Segment.open(plan.instance) as segment:
        file = ask(segment, control.Where(), WHERE_S)["config"]
        if file != str(plan.config_file):
            return f", started from {file}: {down}; or give this one another instance.name"
    return f"; {down}"


def _replan(plan: Plan) -> Callable[[], Plan]:
    """What a reload makes of the same file by then."""
    return lambda: prepare(plan.config_file, plan.mode).plan


def _announce(prepared: Prepared, segment_bytes: int | None) -> None:
    """``segment_bytes``: None before a take-over, of which nobody knows yet what it will find."""
    plan = prepared.plan
    size = "" if segment_bytes is None else f" ({segment_bytes / 1e6:.1f} MB)"
    _say(f"{plan.instance}: mode {plan.mode}, segment {PREFIX}{plan.instance}{size}, logs in {plan.log_dir}")
    width = max((len(job.name) for job in plan.jobs), default=0)
    for job in sorted(plan.jobs, key=lambda job: job.rank):
        _say(f"  {job.name:<{width}}  {job.kind:<8}  {_describe(job, prepared)}")


def _describe(job: Job, prepared: Prepared) -> str:
    config = job.config
    if job.kind == "source":
        layout = prepared.layouts[job.name]
        source = next(source for source in prepared.config.source if source.name == job.name)
        device = f"{source.connector} {peer(source)}".rstrip()
        return f"{device}, {layout.name}: {layout.size} bytes every {source.period_ms:g} ms"
    if job.kind == "emulator":
        return f"{config['kind']} on {config['listen']}, program {config['program']}"
    if job.kind == "recorder":
        return f"to {config['directory']}"
    return f"on {', '.join(config['listen'])}"


def _detached(file: Path, mode: str, report: int) -> int:
    """The detached supervisor itself: tell the parent how the start went, by a line or by the error."""
    told = False

    def tell(message: str) -> None:
        nonlocal told
        if not told:
            told = True
            with suppress(OSError):  # the parent gave up
                os.write(report, message.encode())
            os.close(report)

    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        plan = prepare(file, mode).plan

        def on_state(state: State) -> None:
            if state is not State.STOPPING:
                tell("\n".join(["ok", *supervisor.history]))

        with logdir.held(plan.log_dir, plan.instance):
            logs.setup(plan.log_dir / "supervisor.log", "supervisor")
            supervisor = Supervisor(plan, replan=_replan(plan), on_state=on_state)
            supervisor.run()
    except (ShmioError, OSError) as error:
        tell(str(error))
        return 1
    tell("it was told to stop while it started")
    return 0


def _detach(prepared: Prepared, option: str) -> int:
    plan = prepared.plan
    _refuse(plan)
    log_file = plan.log_dir / "supervisor.log"
    with logdir.held(plan.log_dir, plan.instance):
        logs.setup(log_file, "supervisor")
    command = (sys.executable, "-P", "-m", "shmio.cli.supervisor", "up")
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as answers, log_file.open("ab") as log:
        child = subprocess.Popen(
            [*command, "-c", str(plan.config_file), "--mode", plan.mode, "--report", str(writer)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            pass_fds=(writer,),
            env=child_environment(),
            start_new_session=True,
        )
        os.close(writer)
        try:
            answer = _await(answers.fileno(), DETACH_S)
        except BaseException:
            child.terminate()
            child.wait()
            raise
    answer, *history = answer.split("\n")
    if answer != "ok":
        child.wait()
        raise ControlError(answer or f"the supervisor died while it started; see {log_file}")
    child.returncode = 0  # it lives on, which Popen would complain about
    for line in history:
        _say(line)
    status = read_status(plan.instance)
    _announce(prepared, status.segment_bytes)
    _tell_how(status, option)
    return 0


def _await(fd: int, timeout_s: float) -> str:
    """Read to the end of the pipe: the child's answer, or none if it died."""
    deadline = time.monotonic() + timeout_s
    answer = b""
    while True:
        ready, _, _ = select.select([fd], [], [], max(0.0, deadline - time.monotonic()))
        if not ready:
            raise ControlError(f"the instance is not running after {timeout_s:g} s and is stopped again")
        data = os.read(fd, 65536)
        if not data:
            return answer.decode(errors="replace")
        answer += data


def _tell_how(status: InstanceStatus, option: str) -> None:
    for process in status.processes:
        if isinstance(process, SourceStatus) and process.quality == "bad":
            _say(f"warning: source {process.name} is bad: {process.reason}", sys.stderr)
    pid = status.supervisor.pid if status.supervisor else None
    down = f"shmio-supervisor down {option}".rstrip()
    _say(f"{status.state}, supervisor pid {pid}; {down} stops it")


class _Console(logging.Formatter):
    """A record's message alone."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(record.getMessage())


def _say(line: str, stream: TextIO | None = None) -> None:
    """Print; a terminal that has gone away must not stop the instance."""
    with suppress(OSError):
        print(printable(line), file=stream or sys.stdout, flush=True)
