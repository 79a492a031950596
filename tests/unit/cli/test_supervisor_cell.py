"""The A50 example as a user runs it: real processes, detached and in the foreground."""

from __future__ import annotations

import copy
import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest

from shmio.cli.instance.init import comment_out
from shmio.local.status import InstanceStatus, ProcessStatus, SourceStatus, read_status
from shmio.segment import instances
from shmio.testing.cell import until

ROOT = Path(__file__).parents[3]
DEADLINE_S = 60.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class Cell:
    """The example in a temporary folder, with a unique instance name and free ports."""

    def __init__(self, folder: Path, instance: str, runtime: Path) -> None:
        self.folder = folder
        self.instance = instance
        self.runtime = runtime
        self.environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(runtime)}
        self.run("init", status=0)
        file = folder / "supervisor.toml"
        text = file.read_text().replace('"a50"  ', f'"{instance}"').replace("1102", str(free_port()))
        text = text.replace("127.0.0.1:8089", "127.0.0.1:0").replace("127.0.0.1:8090", "127.0.0.1:0")
        file.write_text(comment_out(text.replace("1883", str(free_port())), "web"))

    def command(self, *arguments: str) -> list[str]:
        return [sys.executable, "-m", "shmio.cli.supervisor", *arguments]

    def run(self, *arguments: str, status: int) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(
            self.command(*arguments),
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
            check=False,
        )
        assert done.returncode == status, done.stderr
        return done

    def status(self) -> dict[str, Any]:
        found = json.loads(self.run("status", "--json", status=0).stdout)
        assert isinstance(found, dict)
        return found

    def look(self) -> InstanceStatus:
        """Return the status without starting a process."""
        return read_status(self.instance, "")

    def of(self, name: str) -> SourceStatus | ProcessStatus:
        return next(process for process in self.look().processes if process.name == name)


@pytest.fixture
def cell(tmp_path: Path, instance: str, runtime: Path) -> Iterator[Cell]:
    cell = Cell(tmp_path, instance, runtime)
    yield cell
    if instance in instances():  # the test has failed
        cell.run("down", status=0)


def test_up_status_restart_logs_and_down(cell: Cell) -> None:
    configured = cell.folder / "supervisor.toml"
    both = 'listen = ["127.0.0.1:0"]\naddress = [{ listen = "127.0.0.1:0" }]'
    configured.write_text(configured.read_text().replace('listen = ["127.0.0.1:0", "127.0.0.1:0"]', both))
    up = cell.run("up", "--detach", status=0).stdout
    assert f"{cell.instance}: mode live, segment shmio-{cell.instance}" in up
    assert "  on 127.0.0.1:0, 127.0.0.1:0\n" in up
    assert "running, supervisor pid" in up
    status = cell.status()
    assert (status["instance"], status["mode"], status["state"]) == (cell.instance, "live", "running")
    assert [(p["name"], p["kind"], p["state"]) for p in status["processes"]] == [
        ("plc", "emulator", "running"),
        ("cell", "source", "running"),
        ("grpc", "grpc", "running"),
        ("broker", "mqtt", "running"),
        ("mqtt", "mqtt", "running"),
        ("recorder", "recorder", "running"),
    ]
    assert status["processes"][1]["quality"] == "good"

    refused = cell.run("up", status=1)
    assert refused.stderr == (
        f"instance {cell.instance!r} is already running, supervisor pid {status['supervisor']['pid']}; "
        f"shmio-supervisor down --instance {cell.instance} stops it\n"
    )
    assert refused.stdout == ""
    (cell.folder / "other.toml").write_text(configured.read_text())
    refused = cell.run("up", "-c", "other.toml", status=1)
    assert f", started from {configured}; shmio-supervisor down --instance {cell.instance} stops it; " in refused.stderr
    assert f"note: up would fail at present: {refused.stderr}" in cell.run("check", "-c", "other.toml", status=0).stdout

    pids = {process["name"]: process["pid"] for process in status["processes"]}
    os.kill(pids["plc"], signal.SIGKILL)
    until(lambda: cell.of("plc").restarts == 1 and cell.look().state == "running", "running again")
    assert cell.of("cell").pid == pids["cell"]
    assert "killed by SIGKILL" in cell.run("logs", "supervisor", status=0).stdout

    assert cell.run("restart", "cell", status=0).stdout == "cell runs again\n"
    assert cell.of("cell").pid != pids["cell"]
    assert "valid: plc, cell, grpc, broker, mqtt, recorder" in cell.run("restart", "nobody", status=1).stderr
    file = cell.folder / "supervisor.toml"
    moved = file.rename(cell.folder / "elsewhere.toml")
    assert cell.run("logs", "--instance", cell.instance, "cell", status=0).stdout
    moved.rename(file)
    file.write_text(file.read_text())
    changed = cell.run("restart", "grpc", status=0).stdout
    assert changed.startswith(f"grpc runs again\n{file} has changed since it was read; restart keeps the old")

    down = cell.run("down", status=0).stdout
    assert down.splitlines()[-1] == f"{cell.instance} is stopped"
    assert cell.instance not in instances()
    assert not list((cell.runtime / "shmio").iterdir())
    assert json.loads(cell.run("status", "--json", status=1).stdout)["state"] == "stopped"


def kill_supervisor(cell: Cell) -> None:
    os.kill(cell.status()["supervisor"]["pid"], signal.SIGKILL)
    until(lambda: cell.look().supervisor is None, "the supervisor's death")


def test_processes_of_a_killed_supervisor_are_taken_over_or_stopped(cell: Cell) -> None:
    cell.run("up", "--detach", status=0)
    processes = cell.status()["processes"]
    kill_supervisor(cell)
    assert "supervisor of instance" in cell.run("restart", "cell", status=1).stderr
    ours = "shmio-supervisor up takes them over, shmio-supervisor down stops them"
    assert ours in cell.run("status", status=0).stdout
    named = f"shmio-supervisor up -c FILE takes them over, shmio-supervisor down --instance {cell.instance} stops them"
    assert named in cell.run("status", "--instance", cell.instance, status=0).stdout
    lines = cell.run("up", "--detach", status=0).stdout
    for process in processes:
        assert f"took over {process['name']}, pid {process['pid']}, which had lost its supervisor\n" in lines
    kill_supervisor(cell)
    lines = cell.run("down", status=0).stdout
    for process in processes:
        assert f"stopped {process['name']}, pid {process['pid']}, which had lost its supervisor\n" in lines
    assert cell.instance not in instances()
    assert not list((cell.runtime / "shmio").iterdir())


def test_emulated_block_without_a_number_is_read(cell: Cell) -> None:
    block = cell.folder / "db201.db"
    block.write_text(block.read_text().replace("DATA_BLOCK DB201", 'DATA_BLOCK "Cell"'))
    file = cell.folder / "supervisor.toml"
    file.write_text(file.read_text().replace('layout = "db201.db"', 'layout = ["db201.db"]\ndbNumber = 7'))
    cell.run("up", "--detach", status=0)
    until(lambda: bool(cell.status()["processes"][1]["quality"] == "good"), "good quality")
    cell.run("down", status=0)


def moved(text: str) -> str:
    """Replace the ports of emulator and broker in the configuration."""
    return re.sub(r'listen = "127\.0\.0\.1:\d+"', lambda _: f'listen = "127.0.0.1:{free_port()}"', text)


def test_missing_device_is_a_warning_and_does_not_delay_the_start(cell: Cell) -> None:
    file = cell.folder / "supervisor.toml"
    file.write_text(moved(file.read_text()))
    assert "warning: source cell is bad: " in cell.run("up", "--detach", status=0).stderr
    assert cell.status()["state"] == "degraded"
    cell.run("down", status=0)


def test_configuration_from_init_runs_beside_a_running_cell(cell: Cell, instance: str) -> None:
    own, name = cell.folder / "own", f"{instance}-own"
    own.mkdir()
    (own / "my.db").write_text((cell.folder / "db201.db").read_text().replace("DB201", f'"{name}"', 1))
    (own / "plc.ini").write_text(f"host=127.0.0.1\nport={free_port()}\ndbNumber=201\n")
    with ExitStack() as stack:
        for port in (8089, 8090):  # the ports of the demo, unless it is running
            with suppress(OSError):
                demo = stack.enter_context(socket.socket())
                demo.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                demo.bind(("127.0.0.1", port))
                demo.listen()
        beside = copy.copy(cell)
        beside.folder, beside.instance = own, name
        beside.run("init", "plc.ini", "my.db", status=0)
        assert "no faults found" in beside.run("check", status=0).stdout
        file = own / "supervisor.toml"
        assert not {"127.0.0.1:8089", "127.0.0.1:8090"} & set(re.findall(r'"([\d.:]+)"', file.read_text()))
        beside.run("up", "--detach", status=0)
        try:
            assert beside.of("grpc").state == "running"
            file.write_text(
                file.read_text().replace("# [recorder] ", "[recorder] ").replace("# directory", "directory")
            )
            assert "recorder: started" in beside.run("reload", status=0).stdout
            assert list((own / "dumps").glob(f"{name}-*.mem"))
        finally:
            beside.run("down", status=0)


def serve_on(cell: Cell, address: str) -> None:
    file = cell.folder / "supervisor.toml"
    file.write_text(file.read_text().replace('["127.0.0.1:0", "127.0.0.1:0"]', f'["{address}"]\ninsecure = true'))


def test_failed_start_reports_the_reason_and_leaves_nothing(cell: Cell) -> None:
    serve_on(cell, "192.0.2.1:8089")  # an address reserved by RFC 5737
    error = cell.run("up", "--detach", status=1).stderr
    assert error.startswith("grpc: ")
    assert "192.0.2.1:8089" in error
    assert cell.instance not in instances()


@pytest.mark.parametrize("arguments", [["up"], ["up", "--detach"]])
def test_port_in_use_is_found_before_the_start(cell: Cell, arguments: list[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        serve_on(cell, f"0.0.0.0:{port}")
        error = cell.run(*arguments, status=1).stderr
        checked = cell.run("check", status=0).stdout
    comm = Path("/proc/self/comm").read_text().strip()
    told = (
        f"grpc: cannot listen on 0.0.0.0:{port}: {comm}, pid {os.getpid()}, listens there; choose another port, or end "
        "that program\n"
    )
    assert error == told
    assert f"note: up would fail at present: {told}" in checked
    assert checked.endswith("no faults in the configuration; up would fail at present\n")
    assert not (cell.folder / "logs").exists()


def test_leftover_segment_does_not_hide_a_port_in_use(cell: Cell) -> None:
    Path("/dev/shm", f"shmio-{cell.instance}").touch()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        serve_on(cell, f"127.0.0.1:{port}")
        error = cell.run("up", "--detach", status=1).stderr
    assert f"grpc: cannot listen on 127.0.0.1:{port}: " in error
    assert f", pid {os.getpid()}, listens there; " in error


def test_port_of_another_instances_broker_is_attributed_to_it(cell: Cell) -> None:
    """The listener may be a child of that broker's process."""
    serve_on(cell, f"127.0.0.1:{free_port()}")
    cell.run("up", "--detach", status=0)
    text = (cell.folder / "supervisor.toml").read_text()
    broker = re.compile(r'(?<=\[mqtt\]).*?listen = "([^"]+)"', re.DOTALL)
    port = broker.search(text)
    assert port is not None
    text = broker.sub(lambda _: port[0], moved(text)).replace("listen = [", 'listen = ["127.0.0.1:0"] #')
    text = text.replace(f'"{cell.instance}"', f'"{cell.instance}-2"\nlog_dir = "logs-2"')
    (cell.folder / "second.toml").write_text(text)
    *_, last = cell.run("up", "-c", "second.toml", status=1).stderr.splitlines()
    owner = f"process broker of instance {cell.instance}, pid {cell.of('broker').pid}"
    assert last.startswith(f"broker: cannot listen on {port[1]}: {owner}, ")
    cell.run("down", status=0)


def test_ports_and_logs_of_another_instance_are_attributed_to_it(cell: Cell) -> None:
    serve_on(cell, f"127.0.0.1:{free_port()}")
    cell.run("up", "--detach", status=0)
    text = (cell.folder / "supervisor.toml").read_text().replace(f'"{cell.instance}"', f'"{cell.instance}-2"')
    (cell.folder / "second.toml").write_text(moved(text).replace("listen = [", 'listen = ["127.0.0.1:0"] #'))
    refused = cell.run("up", "-c", "second.toml", status=1).stderr
    assert refused.splitlines()[-1].startswith(f"instance.log_dir: instance {cell.instance!r} writes its logs to ")
    text = text.replace(f'"{cell.instance}-2"', f'"{cell.instance}-2"\nlog_dir = "logs-2"')
    for name, listen in (("plc", r'listen = "127.0.0.1:(\d+)"'), ("grpc", r'listen = \["127.0.0.1:(\d+)"\]')):
        port = re.search(listen, text)
        assert port is not None
        (cell.folder / "second.toml").write_text(text)
        assert cell.run("up", "-c", "second.toml", status=1).stderr.endswith(
            f"{name}: cannot listen on 127.0.0.1:{port[1]}: process {name} of instance {cell.instance}, pid "
            f"{cell.of(name).pid}, listens there; choose another port, or stop that instance: shmio-supervisor down "
            f"--instance {cell.instance}\n"
        )
        text = moved(text)
    cell.run("down", status=0)


@pytest.mark.parametrize("sign", [signal.SIGTERM, signal.SIGHUP])  # tests/system/test_cell.py sends SIGINT
def test_signal_stops_a_foreground_instance_cleanly(cell: Cell, sign: signal.Signals) -> None:
    with subprocess.Popen(
        cell.command("up"),
        cwd=cell.folder,
        env=cell.environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        bufsize=0,
    ) as up:
        assert up.stderr is not None
        assert up.stdout is not None
        said = b""
        while b"the instance is running" not in said:
            assert select.select([up.stderr], [], [], DEADLINE_S)[0], said
            line = up.stderr.readline()
            assert line, said
            said += line
        up.send_signal(sign)
        assert up.wait(DEADLINE_S) == 0
        announced = up.stdout.read().decode()
        assert "Traceback" not in up.stderr.read().decode()
    assert "program a50" in announced
    assert "127.0.0.1:0, 127.0.0.1:0" in announced
    assert cell.instance not in instances()
