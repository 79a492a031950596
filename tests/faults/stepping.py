"""The second run: faults of an instance with stepped time, and of the program that steps the instance."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final, Self

import shmio
from shmio.errors import RecordingError, ShmioError, TimeError
from shmio.recording.format.encoding import FRAME, Gap, StepMark
from shmio.recording.reading.reader import Reader
from shmio.recording.reading.survey import survey
from shmio.segment import Frame
from shmio.testing.ports import reserved_port
from tests.faults.checks import check_restarts
from tests.faults.inflict import ProcessInflictor
from tests.faults.rig import Instance
from tests.faults.schedule import RESTARTING, SUPERVISOR, Fault
from tests.faults.step_checks import DISPATCHERS, MODELS, PARTICIPANTS, RecordedSteps
from tests.faults.stepper import WAYS
from tests.faults.suite import LOOK_S, RECOVERY_S, Run

WORKERS: Final = (*PARTICIPANTS, *DISPATCHERS)
STEPPER: Final = "stepper"
KINDS: Final = {"kill": 6, "pause": 3, "hang": 2, "restart": 2, "supervisor_kill": 2, "stepper_kill": 4}
"""Relative frequency of each kind of fault."""
END_S: Final = 20.0
CONFIG: Final = """
[instance]
name = "{instance}"
clock = "stepped"
[[source]]
name = "lead"
connector = "simulation"
model = "models:Lead"
[[source]]
name = "follow"
connector = "simulation"
model = "models:Follow"
[source.connections]
lead = "lead/count"
[[source]]
name = "panel"
connector = "memory"
layout = "panel.toml"
[grpc]
listen = ["{grpc}"]
[recorder]
"""


def faults(seed: int) -> Iterator[Fault]:
    """Yield the faults of a seed, endlessly, to be carried out one at a time."""
    chance = random.Random(seed)
    kinds, weights = list(KINDS), list(KINDS.values())
    while True:
        kind = chance.choices(kinds, weights)[0]
        target = {"supervisor_kill": SUPERVISOR, "stepper_kill": STEPPER}.get(kind) or chance.choice(WORKERS)
        yield Fault(kind, target, 0.0, chance.uniform(0.05, 3.0), chance.getrandbits(32))


class Moving:
    """The program that moves time, and what it has reported. A context manager."""

    def __init__(self, run: Stepping, rig: Instance, grpc: str) -> None:
        self._run, self._rig, self._grpc = run, rig, grpc
        self._seed = run.record.seed
        self.begun_ns = 0
        """CLOCK_MONOTONIC of the beginning of the newest step that was done."""
        self.done: defaultdict[str, set[int]] = defaultdict(set)
        """Numbers of the steps that were done, by the instance's epoch."""
        self.failed: defaultdict[str, set[int]] = defaultdict(set)
        """Numbers of the steps that failed, by epoch; 0 for a failed call that left no step incomplete."""
        self._start()

    def _start(self) -> None:
        self._seed += 1
        self.way = WAYS[self._seed % len(WAYS)]
        command = [sys.executable, "-P", "-m", "tests.faults.stepper", self._rig.instance, self._grpc, self.way]
        pipe = subprocess.PIPE
        self._popen = subprocess.Popen(
            [*command, str(self._seed)], stdin=pipe, stdout=pipe, env=self._rig.environment, text=True
        )
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    @property
    def pid(self) -> int:
        """Pid of the present process."""
        return self._popen.pid

    def replace(self) -> None:
        """Kill the program, and start a successor that steps the other way: attached, or through the endpoint."""
        self._popen.kill()
        self._end()
        self._start()

    def _listen(self) -> None:
        assert self._popen.stdout is not None
        steps = self._run.record.steps
        for line in self._popen.stdout:
            try:
                message = json.loads(line)
            except ValueError:  # the program was killed while it printed the line
                return
            if "violation" in message:
                self._run.complain(f"{self.way}: {message['violation']}")
            elif "step" in message:
                steps["done"] += 1
                self.done[message["epoch"]].add(message["step"])
                self.begun_ns = message["begun_ns"]
            elif "failed" in message:
                steps["failed"] += 1
                self.failed[message["epoch"]].add(message["undone"])
            else:
                steps["refused while the owner of time was unclear"] += 1

    def _end(self) -> None:
        assert self._popen.stdin is not None
        assert self._popen.stdout is not None
        self._popen.stdin.close()
        try:
            status = self._popen.wait(END_S)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            status = self._popen.wait()
        self._thread.join()
        self._popen.stdout.close()
        if status > 0:
            self._run.complain(f"the program that steps ended with status {status}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()


class Stepping(Run):
    """A run on an instance with stepped time."""

    def run(self, for_s: float, given: list[Fault] | None = None) -> None:
        """Run for this time or through the given faults. Things left behind are violations, too."""
        begun_s = time.monotonic()
        self._folder.mkdir()
        with ExitStack() as stack:
            grpc = stack.enter_context(reserved_port())
            rig = self._rig(str(grpc))
            stack.callback(rig.clear)
            rig.up()
            moving = stack.enter_context(Moving(self, rig, str(grpc)))
            inflictor = ProcessInflictor(rig)
            inflictor.kinds["stepper_kill"] = lambda _: moving.replace()
            self._await_recovery(rig, moving, time.monotonic_ns())
            well_s = time.monotonic()
            for fault in given if given is not None else faults(self.record.seed):
                if self._stopping.is_set() or (given is None and time.monotonic() - well_s > for_s):
                    break
                self._turn_of(rig, moving, inflictor, fault)
        self._check_recordings(moving)
        self.check_leftovers()
        self.record.duration_s += time.monotonic() - begun_s

    def _rig(self, grpc: str) -> Instance:
        (self._folder / "models.py").write_text(MODELS)
        (self._folder / "panel.toml").write_text('[registers]\nlimit = "LREAL"\n')
        file = self._folder / "supervisor.toml"
        file.write_text(CONFIG.format(instance=self._instance, grpc=grpc))
        return Instance(self._folder, self._instance, file)

    def _turn_of(self, rig: Instance, moving: Moving, inflictor: ProcessInflictor, fault: Fault) -> None:
        before, epoch = rig.processes(), self._epoch()
        self._history.append(f"{time.monotonic_ns()}: {fault}")
        try:
            inflictor.inflict(fault)
        except Exception as error:  # noqa: BLE001 - an error of a command or of the suite: always a violation
            self.complain(f"{fault} failed: {error!r}")
            return
        ended_ns = time.monotonic_ns()
        if not self._await_recovery(rig, moving, ended_ns):
            return
        took_s = (time.monotonic_ns() - ended_ns) / 1e9
        kind = f"stepped: {fault.kind}"
        self.record.rounds += 1
        self.record.faults[kind] += 1
        self.record.recoveries[kind].append(took_s)
        self._say(f"{self.record.rounds:5d}  stepped: {fault}: recovered after {took_s:.2f} s")
        hit = {fault.target} if fault.kind in RESTARTING else set()
        check_restarts(before, rig.processes(), hit, set(), replaced=self._epoch() != epoch, complain=self.complain)
        self.check_processes(rig)
        self._contend(moving)

    def _await_recovery(self, rig: Instance, moving: Moving, ended_ns: int) -> bool:
        """Return True when all processes run and a step that began after ``ended_ns`` is done."""
        while (took_ns := time.monotonic_ns() - ended_ns) < RECOVERY_S * 1e9:
            if moving.begun_ns > ended_ns and rig.status().state == "running":
                return True
            time.sleep(LOOK_S)
        status = rig.status()
        ill = [f"{p.name}: {p.state} {p.note}" for p in status.processes if p.state != "running"]
        self.complain(f"no step was done within {took_ns / 1e9:.0f} s: {status.state} {status.clock}, {ill}")
        return False

    def _contend(self, moving: Moving) -> None:
        """Check that a second program is refused, and that the message names the owner of time.

        It checks only while the first program is attached: the endpoint releases time when its clients pause.
        """
        if moving.way != "local":
            return
        try:
            with shmio.attach(self._instance, writable=True) as other:
                other.step()
        except TimeError as error:
            self.record.steps["refused to another program"] += 1
            if f"pid {moving.pid}" not in str(error):
                self.complain(f"the refusal of another program does not name the owner of time: {error}")
        except ShmioError as error:
            self.complain(f"another program that wants to step gets another error than TimeError: {error}")
        else:
            self.complain(f"two programs have moved time, pid {moving.pid} and this one")

    def _epoch(self) -> int:
        return (Path("/dev/shm") / f"shmio-{self._instance}").stat().st_ino

    def _check_recordings(self, moving: Moving) -> None:
        marks: defaultdict[str, set[int]] = defaultdict(set)
        cycles: defaultdict[str, defaultdict[str, set[int]]] = defaultdict(lambda: defaultdict(set))
        missed: defaultdict[str, defaultdict[str, int]] = defaultdict(lambda: defaultdict(int))
        for file in (self._folder / "dumps").glob("*.mem"):
            if not file.stat().st_size:
                continue  # the recorder was killed before it wrote anything; the steps must be in the next file
            try:
                with Reader(file) as reader:
                    survey(reader)
                    for message in reader.messages():
                        item, epoch = message.item, reader.about["epoch"]
                        if isinstance(item, StepMark):
                            marks[epoch].add(item.step)
                        elif isinstance(item, Gap) and item.what == "frames":
                            missed[epoch][item.source] += item.count
                        elif isinstance(item, Frame) and message.channel.encoding == FRAME:
                            cycles[epoch][message.channel.source].add(item.cycle)
            except (RecordingError, OSError) as error:
                self.complain(f"{file}: {error}")
        check = RecordedSteps(self.complain)
        for epoch, done in moving.done.items():
            check.check(done, moving.failed[epoch], marks[epoch], cycles[epoch], missed[epoch])
        self.record.steps["recorded marks"] += sum(map(len, marks.values()))
