"""Carries out faults. Each call returns when the fault is over: removed, or its target killed."""

from __future__ import annotations

import errno
import os
import random
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from shmio.segment import Segment
from shmio.testing.cell import kill, until
from tests.faults.configuration import Configuration
from tests.faults.deface import deface
from tests.faults.midwrite import MidWrite
from tests.faults.rig import Device, Instance, Rig
from tests.faults.schedule import SUPERVISOR, Fault

GONE_S: Final = 20.0
"""Maximum time until a frozen process is detected and replaced."""
DAY_NS: Final = 86_400 * 10**9
SHM: Final = Path("/dev/shm")
OWN_SHM: Final = "SHMIO_FAULTS_OWN_SHM"
"""Environment variable that is set if /dev/shm belongs to the suite, so that it may be filled."""
GARBAGE: Final = (
    b"\0" * 64,
    b"\xff" * 64,
    b"\x03",
    b"HTTP/1.1 400 Bad Request\r\n\r\n",
    bytes.fromhex("0300001602f080320300000001000200000000"),  # a header that announces more bytes than follow
)


Kinds = dict[str, Callable[[Fault], None]]


class ProcessInflictor:
    """Carries out the faults of an instance's processes."""

    def __init__(self, instance: Instance) -> None:
        self._of = instance
        self.kinds: Kinds = {
            "kill": lambda f: kill(self._pid(f.target)),
            "pause": self._pause,
            "hang": self._hang,
            "restart": lambda f: instance.ask("restart", f.target),
            "supervisor_kill": self._supervisor_kill,
            "supervisor_pause": self._pause,
        }

    def inflict(self, fault: Fault) -> None:
        """Carry out a fault at once."""
        self.kinds[fault.kind](fault)

    def _pid(self, name: str) -> int:
        status = self._of.status()
        if name == SUPERVISOR:
            assert status.supervisor is not None
            return status.supervisor.pid
        pid = next(process.pid for process in status.processes if process.name == name)
        assert pid is not None, f"{name} is not there"
        return pid

    def _pause(self, fault: Fault) -> None:
        pause(self._pid(fault.target), fault.for_s)

    def _hang(self, fault: Fault) -> None:
        pid = self._pid(fault.target)
        kill(pid, signal.SIGSTOP)
        until(lambda: self._of.processes()[fault.target].pid != pid, f"{fault.target} replaced", GONE_S)

    def _supervisor_kill(self, fault: Fault) -> None:
        kill(self._pid(SUPERVISOR))
        until(lambda: self._of.status().supervisor is None, "the supervisor is gone")
        time.sleep(fault.for_s)
        self._of.up()


class Inflictor(ProcessInflictor):
    """Carries out all faults on the rig."""

    def __init__(self, rig: Rig, mid_write: MidWrite) -> None:
        super().__init__(rig)
        self._rig = rig
        self._mid_write = mid_write
        self.kinds |= {
            "torn": self._torn,
            "relayout": lambda f: self._rig.reload(lambda configuration: configuration.relayout(f.target)),
            "reload": lambda _: self._rig.reload(Configuration.toggle_extra),
            "clock": lambda f: self._rig.set_clock(f.number % 3 and round((f.number / 2**31 - 1) * 30 * DAY_NS)),
            "midwrite": lambda f: self._mid_write.strike(f.number),
            "shm_full": lambda f: fill(SHM, f.for_s),
            "broker_kill": lambda f: kill(broker(self._pid(f.target))),
            "broker_pause": lambda f: pause(broker(self._pid(f.target)), f.for_s),
        }

    def inflict(self, fault: Fault) -> None:
        """Carry out a fault at once."""
        if fault.kind in self.kinds:
            super().inflict(fault)
        else:
            self._device(fault, self._rig.devices[fault.target.rpartition(" ")[2]])

    def _torn(self, fault: Fault) -> None:
        """Kill a source's process so that it leaves a half-written slot."""
        pid = self._pid(fault.target)
        kill(pid, signal.SIGSTOP)
        until(lambda: _stopped(pid), f"{fault.target} stopped")
        with Segment.open(self._rig.instance, writable=True) as segment:
            deface(segment.memory, fault.target, fault.number)
        kill(pid)

    def _device(self, fault: Fault, device: Device) -> None:
        chance = random.Random(fault.number)
        proxy = device.proxy
        if fault.kind == "plc_kill":
            device.kill()
            time.sleep(fault.for_s)
            device.start()
        elif fault.kind == "plc_pause":
            pause(device.pid, fault.for_s)
        elif fault.kind == "cut":
            proxy.cut(reset=chance.random() < 0.5)
        elif fault.kind == "late":
            proxy.hold(frames=chance.randrange(1, 4))
            proxy.wait_held(2.0)
            time.sleep(fault.for_s)
            proxy.release()
        else:
            frames = chance.randrange(1, 6)
            offset = chance.randrange(1000, 60_000)
            begin: dict[str, Callable[[], None]] = {
                "delay": lambda: proxy.delay(chance.uniform(0, 0.2), chance.uniform(0, 0.2)),
                "cut_after": lambda: proxy.cut_after(chance.randrange(1, 5000)),
                "freeze": proxy.freeze,
                "refuse": proxy.refuse,
                "garble": lambda: proxy.garble(chance.choice(GARBAGE)),
                "reference": lambda: proxy.rewrite_reference(lambda number: number + offset, frames=frames),
                "drop": lambda: proxy.edit(lambda _: None, frames=frames),
            }
            begin[fault.kind]()
            time.sleep(fault.for_s)
            proxy.delay(0.0, 0.0)
        proxy.pass_all()


def pause(pid: int, for_s: float) -> None:
    """Stop a process for this time (SIGSTOP, SIGCONT)."""
    kill(pid, signal.SIGSTOP)
    time.sleep(for_s)
    kill(pid, signal.SIGCONT)


def broker(pid: int) -> int:
    """Return the pid of the broker itself: mosquitto, a child of process ``pid``, else ``pid``."""
    children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return int(children[0]) if children else pid


def fill(folder: Path, for_s: float) -> None:
    """Fill a file system for this time, if it belongs to the suite."""
    if OWN_SHM not in os.environ:
        return
    with tempfile.TemporaryFile(dir=folder) as file:
        for piece in (1 << 20, 1 << 12):
            try:
                while True:
                    file.seek(0, os.SEEK_END)
                    os.posix_fallocate(file.fileno(), file.tell(), piece)
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise
        time.sleep(for_s)


def _stopped(pid: int) -> bool:
    """Return whether a process is stopped: state T in proc_pid_stat(5)."""
    with open(f"/proc/{pid}/stat", encoding="utf-8") as stat:  # noqa: PTH123
        return stat.read().rpartition(")")[2].split()[0] == "T"
