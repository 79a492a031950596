"""The main run: rounds of faults, each followed by a wait for recovery, recorded for the report."""

from __future__ import annotations

import threading
import time
import traceback
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from shmio.segment import instances
from tests.faults.checks import UNTOUCHED_NS, Counts, Processes, check_bystanders, check_restarts
from tests.faults.inflict import Inflictor, broker
from tests.faults.midwrite import MidWrite
from tests.faults.panel import Panel
from tests.faults.pulse import Pulse
from tests.faults.resources import Resources
from tests.faults.retained import retained, wrong
from tests.faults.rig import Instance, Rig, marked
from tests.faults.schedule import BROKER, RENEWING, RESTARTING, Fault, Round, rounds

RECOVERY_S: Final = 30.0
"""Maximum time to recover from a fault."""
LOOK_S: Final = 0.02
SEEN_S: Final = 90.0
"""Maximum time after the last fault for the checkers to see enough."""
MOST_CHANGES: Final = 30
"""Number of blocks changed by reloads after which the instance is restarted. Its memory has room for 40."""
HISTORY: Final = 20
"""Number of faults, and of the supervisor's warnings, that a violation lists."""
MOST_VIOLATIONS: Final = 10
"""Maximum number of violations that are kept; further ones are only counted."""
END_S: Final = 5.0
RETAINED_S: Final = 5.0
"""Maximum time after recovery in which retained messages may still be out of date."""

Say = Callable[[str], None]


@dataclass
class Record:
    """Results of a run, for its report."""

    seed: int
    begun_utc: str = field(default_factory=lambda: time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime()))
    duration_s: float = 0.0
    rounds: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    recoveries: defaultdict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    replaced: int = 0
    adopted: int = 0
    counts: dict[str, Counts] = field(default_factory=dict)
    mid_kills: int = 0
    mid_torn: int = 0
    mid_frames: int = 0
    peaks: dict[str, tuple[float, int]] = field(default_factory=dict)
    """Maximum memory in MB and maximum number of descriptors of each process."""
    steps: Counter[str] = field(default_factory=Counter)
    """Number of steps of the stepped instance, by result."""
    violations: list[str] = field(default_factory=list)
    violated: int = 0


class Run:
    """A run on one instance. ``say`` prints a line for each round, and violations with evidence."""

    def __init__(self, folder: Path, instance: str, record: Record, say: Say) -> None:
        self.record = record
        self._folder = folder
        self._instance = instance
        self._say = say
        self._lock = threading.Lock()
        self._history: deque[str] = deque(maxlen=HISTORY)
        self._stopping = threading.Event()

    def complain(self, problem: str) -> None:
        """Record a violation with the evidence to find its cause, and end the run."""
        with self._lock:
            self.record.violated += 1
            if len(self.record.violations) < MOST_VIOLATIONS:
                now = f"{time.monotonic_ns()} ({time.strftime('%H:%M:%S', time.gmtime())} UTC)"
                past = "".join(f"\n    {line}" for line in self._history)
                warned = "".join(f"\n    {line}" for line in self._warnings())
                evidence = (
                    f"{problem}\n  seed {self.record.seed}, now {now}; the last faults, oldest first:{past}"
                    f"\n  the supervisor's last warnings:{warned}"
                )
                self.record.violations.append(evidence)
                self._say(f"VIOLATION: {evidence}")
        self._stopping.set()

    def _warnings(self) -> list[str]:
        """Return the last warnings in the supervisor's log, which say why it started processes again."""
        with suppress(FileNotFoundError):
            lines = (self._folder / "logs/supervisor.log").read_text().splitlines()
            return [line for line in lines if " WARNING " in line or " ERROR " in line][-HISTORY:]
        return []

    def stop(self) -> None:
        """End the run after the present round."""
        self._stopping.set()

    def check_processes(self, rig: Instance) -> None:
        """Check that the instance has no process that its status does not list."""
        deadline_s = time.monotonic() + END_S
        ours = ("shmio.connectors", "shmio.emulators", "shmio.endpoints", "shmio.recorder", "shmio.cli.supervisor up")
        while True:
            status = rig.status()
            known = {p.pid for p in status.processes} | {status.supervisor.pid if status.supervisor else None}
            strays = {
                pid: line
                for pid, line in marked(rig.instance).items()
                if pid not in known and any(module in line for module in ours)
            }
            if not strays:
                return
            if time.monotonic() > deadline_s:
                self.complain(f"processes that are not in the status: {strays}")
                return
            time.sleep(LOOK_S)

    def check_leftovers(self) -> None:
        """Check that no segment, process, socket or unknown file is left."""
        if left := [name for name in instances() if name.startswith(self._instance)]:
            self.complain(f"segments left behind: {left}")
        if processes := marked(self._instance):
            self.complain(f"processes left behind: {processes}")
        known = {".toml", ".db", ".truth", ".mem", ".so", ".log", ".jsonl", ".1", ".2", ".3", ".py"}
        found = [file for file in self._folder.rglob("*") if not file.is_dir() and file.parent.name != "__pycache__"]
        files = [file for file in found if file.suffix not in known]
        names = {str(file.relative_to(self._folder)) for file in files} - {"clock", "reader", "logs/.instance"}
        if names:
            self.complain(f"files left behind: {sorted(names)}")


class Suite(Run):
    """A run on an instance in real time, with PLCs and all kinds of readers."""

    def run(
        self, for_s: float, faults: Iterable[Round] | None = None, seen: Callable[[Mapping[str, Counts]], bool] = bool
    ) -> Record:
        """Run for this time, or through the given rounds; return the record.

        Things left behind are violations, too. ``seen``: True if the checkers have seen enough to
        end the run; by default, if they have seen anything. On a loaded machine that takes time.
        """
        begun_s = well_s = time.monotonic()
        self._pulse = Pulse()
        with ExitStack() as stack:
            rig = stack.enter_context(Rig(self._folder, self._instance))
            mid_write = MidWrite(f"{self._instance}-torn", rig.environment, self.complain)
            stack.enter_context(mid_write)
            panel = Panel(rig.description(self.record.seed), rig.environment, self.complain)
            stack.enter_context(panel)
            self._inflictor = Inflictor(rig, mid_write)
            resources = Resources(self.complain)
            self._await_recovery(rig, panel, time.monotonic_ns(), {})
            well_s = time.monotonic()
            for turn in faults if faults is not None else rounds(self.record.seed):
                if self._stopping.is_set() or (faults is None and time.monotonic() - well_s > for_s):
                    break
                self._round(rig, panel, turn)
                resources.look(pids(rig))
            until_s = time.monotonic() + SEEN_S
            while not (seen(panel.counts) or self._stopping.is_set() or time.monotonic() > until_s):
                time.sleep(LOOK_S)
            self.record.mid_kills, self.record.mid_torn = mid_write.kills, mid_write.torn
            self.record.mid_frames = mid_write.frames
            self.record.peaks = resources.peaks
            rig.down()
        self.record.counts = panel.counts
        self.check_leftovers()
        self.record.duration_s += time.monotonic() - begun_s
        return self.record

    def _round(self, rig: Rig, panel: Panel, turn: Round) -> None:
        if rig.configuration.changes >= MOST_CHANGES:
            self._renew(rig, panel)
        before, epoch = rig.processes(), self._epoch(rig)
        begun_s = time.monotonic()
        ended: list[tuple[int, str]] = []
        threads = [threading.Thread(target=self._inflict, args=(fault, begun_s, ended)) for fault in turn.faults]
        for thread in threads:
            thread.start()
        bystanders = all(fault.target == BROKER for fault in turn.faults)
        while any(thread.is_alive() for thread in threads):
            self._pulse.beat()
            bystanders = bystanders and self._go_on(panel)
        hit = {fault.target for fault in turn.faults if fault.kind in RESTARTING}
        renewed = {fault.target for fault in turn.faults if fault.kind in RENEWING}
        ended_ns, last = max(ended)
        took_s = self._await_recovery(rig, panel, ended_ns, {name: before[name] for name in hit}, bystanders=bystanders)
        self.record.rounds += 1
        self.record.faults.update(fault.kind for fault in turn.faults)
        if took_s is not None:
            self.record.recoveries[last].append(took_s)
        well = f"recovered after {took_s:.2f} s" if took_s is not None else "NOT recovered"
        self._say(f"{self.record.rounds:5d}  {'; '.join(map(str, turn.faults))}: {well}")
        if took_s is None:
            return
        replaced = self._epoch(rig) != epoch
        if any(fault.kind == "supervisor_kill" for fault in turn.faults):
            self.record.replaced += replaced
            self.record.adopted += not replaced
        elif replaced:
            self.complain("the instance has another segment, but its supervisor was not hit")
        check_restarts(before, rig.processes(), hit, renewed, replaced=replaced, complain=self.complain)
        self.check_processes(rig)
        if any(fault.target in (BROKER, "mqtt") for fault in turn.faults):
            self._check_retained(rig)
        panel.check()
        self._stopping.wait(turn.rest_s)

    def _renew(self, rig: Rig, panel: Panel) -> None:
        """Restart the instance, as users must when its memory has no room for more blocks."""
        rig.down()
        rig.up()
        rig.configuration.changes = 0
        self._await_recovery(rig, panel, time.monotonic_ns(), {})

    def _inflict(self, fault: Fault, begun_s: float, ended: list[tuple[int, str]]) -> None:
        time.sleep(max(0.0, begun_s + fault.after_s - time.monotonic()))
        self._history.append(f"{time.monotonic_ns()}: {fault}")
        try:
            self._inflictor.inflict(fault)
        except Exception:  # noqa: BLE001 - an error of a command or of the suite: always a violation
            self.complain(f"{fault} failed: {traceback.format_exc()}")
        ended.append((time.monotonic_ns(), fault.kind))

    def _go_on(self, panel: Panel) -> bool:
        """Return whether readers that do not need the broker still get values; complain if not."""
        allowed_ns = UNTOUCHED_NS * self._pulse.slowness + 3 * self._pulse.held_up_ns
        return check_bystanders(panel.counts, time.monotonic_ns(), allowed_ns, self.complain)

    def _check_retained(self, rig: Rig) -> None:
        """Check that a new subscriber gets the present state from the broker, and nothing else."""
        until_s = time.monotonic() + RETAINED_S * self._pulse.slowness
        sources, names = rig.sources(), rig.configuration.names
        while problems := wrong(retained(rig.mqtt, f"shmio/{rig.instance}"), sources, names, self._pulse.slowness):
            self._pulse.beat()
            if time.monotonic() > until_s:
                self.complain(f"retained by the broker: {'; '.join(problems)}")
                return

    def _await_recovery(
        self, rig: Rig, panel: Panel, ended_ns: int, hit: Processes, *, bystanders: bool = False
    ) -> float | None:
        """Wait until all readers have values newer than ``ended_ns``; return the time taken in s.

        Args:
            rig: The instance.
            panel: The checkers.
            ended_ns: CLOCK_MONOTONIC of the end of the faults.
            hit: Processes that must have been replaced.
            bystanders: Whether only the broker was broken, so that other readers must get values.

        Returns:
            None if the recovery takes too long, which is a violation.
        """
        while (took_ns := time.monotonic_ns() - ended_ns) < RECOVERY_S * 1e9 * self._pulse.slowness:
            bystanders = bystanders and self._go_on(panel)
            behind = panel.behind(ended_ns)
            if not behind and rig.status().state == "running":
                now = rig.processes()
                if not any(name in now and now[name].pid == process.pid for name, process in hit.items()):
                    return took_ns / 1e9
            self._pulse.beat()
        status = rig.status()
        ill = [f"{p.name}: {p.state} {p.note}" for p in status.processes if p.state != "running"]
        self.complain(
            f"not recovered {took_ns / 1e9:.0f} s after a fault: {status.state} {status.note}, {ill}, behind: {behind}"
        )
        return None

    def _epoch(self, rig: Rig) -> str:
        """Return an identifier of the instance's present segment."""
        return str((Path("/dev/shm") / f"shmio-{rig.instance}").stat().st_ino)


def pids(rig: Rig) -> dict[str, int | None]:
    """Return the pids of processes that must not grow, including the broker's child mosquitto."""
    found = {name: process.pid for name, process in rig.processes().items()}
    if (pid := found[BROKER]) is not None:
        with suppress(OSError):  # it has just ended
            found["mosquitto"] = broker(pid)
    return found
