"""The fabric between two hosts, which are network namespaces: a mirror under cut links.

Usage (as root): python -m tests.faults.two_hosts [--calm SECONDS] [--cuts N] [--cut SECONDS] [--writes N] [--seed N]

The near host runs the A50 cell, the server and the uplink. The far host runs a mirror, a recorder, a gRPC endpoint
with a client, and a model. First the link works: the client must see every frame, and the model the same values as a
model on the near host. Then the link is cut again and again: the mirror must turn bad within its stale age, recover,
and deliver what it missed, in order and once. At last, programs write through the mirror while the link is cut at
random, and each outcome must be true. In the end, the far recording must have all frames and events of the near one;
with --cuts 0 --writes 0, the two must be equal.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import shmio
from shmio.model.values import OutcomeKind
from shmio.segment import EventKind, Quality, Segment
from shmio.testing.cell import BIN, until
from tests.faults.far_consumers import FOLLOWER, FrameWatcher, GrpcClient, check_client, check_model, values

NEAR: Final = """
[instance]
name = "near{mark}"
[[source]]
name = "cell"
connector = "s7"
layout = "db201.db"
host = "127.0.0.1"
port = 1102
period_ms = 20
writable = ["Outputs", "Robot_*/*"]
[[source]]
name = "follower"
connector = "simulation"
model = "follower:Follower"
period_ms = 5
connections = {{ value = "cell/Robot_800/Axs1_Pos" }}
[[emulator]]
name = "plc"
kind = "s7"
layout = "db201.db"
program = "a50"
listen = "127.0.0.1:1102"
[recorder]
sources = ["cell"]
[fabric]
server = "embedded"
listen = "10.77.{net}.1:4222"
insecure = true
cell = "plant1.line3.near"
[[fabric.rule]]
match = "follower"
send = "nothing"
[[fabric.allow]]
sender = "plant1.line3.far"
roles = ["write"]
"""
FAR: Final = """
[instance]
name = "far{mark}"
[[source]]
name = "cell"
connector = "fabric"
cell = "plant1.line3.near"
writable = ["Outputs", "Robot_*/*"]
[[source]]
name = "follower"
connector = "simulation"
model = "follower:Follower"
period_ms = 5
connections = {{ value = "cell/Robot_800/Axs1_Pos" }}
[recorder]
sources = ["cell"]
[grpc]
listen = ["unix:grpc.sock"]
[fabric]
server = "nats://10.77.{net}.1:4222"
insecure = true
cell = "plant1.line3.far"
"""
AXIS: Final = "Robot_800/Axs1_Pos"
REGISTER: Final = f"cell/{AXIS}"
PATIENCE_S: Final = 60.0


class Hosts:
    """Two network namespaces with a link between them that can be cut."""

    def __init__(self, mark: int) -> None:
        self.names = (f"shmio-n{mark}", f"shmio-f{mark}")
        self.net = mark % 250
        self._link = f"shn{mark}", f"shf{mark}"

    def __enter__(self) -> Hosts:
        near, far = self._link
        ip("link", "add", near, "type", "veth", "peer", "name", far)
        for name, link, number in zip(self.names, self._link, (1, 2), strict=True):
            ip("netns", "add", name)
            ip("link", "set", link, "netns", name)
            ip("-n", name, "addr", "add", f"10.77.{self.net}.{number}/24", "dev", link)
            ip("-n", name, "link", "set", link, "up")
            ip("-n", name, "link", "set", "lo", "up")
        return self

    def __exit__(self, *_: object) -> None:
        for name in self.names:
            subprocess.run(["ip", "netns", "del", name], check=False)

    def cut(self) -> None:
        """Cut the link: packets are lost without a message."""
        ip("-n", self.names[0], "link", "set", self._link[0], "down")

    def restore(self) -> None:
        """Restore the link."""
        ip("-n", self.names[0], "link", "set", self._link[0], "up")

    @contextmanager
    def running(self, host: int, folder: Path, instance: str) -> Iterator[Segment]:
        """Run the instance of a folder on a host; yield its segment."""
        at = ["ip", "netns", "exec", self.names[host]]
        up = subprocess.run(
            [*at, BIN / "shmio-supervisor", "up", "--detach"], cwd=folder, capture_output=True, text=True, check=False
        )
        logs = "\n".join(file.read_text() for file in sorted((folder / "logs").glob("*.log")))
        assert up.returncode == 0, f"{up.stdout}{up.stderr}\n{logs}"
        try:
            with Segment.open(instance) as segment:
                yield segment
        finally:
            subprocess.run([BIN / "shmio-supervisor", "down"], cwd=folder, capture_output=True, check=False)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


class Watcher(FrameWatcher):
    """Follows all frames of the source ``cell`` of an instance."""

    def await_frames(self, count: int) -> None:
        """Wait until this many frames have come."""
        until(lambda: len(self.frames) >= count, f"{count} frames come", PATIENCE_S)


def is_good(cell: Segment) -> bool:
    block = cell.blocks["cell"]
    frame = block.latest()
    return frame is not None and block.assess(frame)[0] is not Quality.BAD


def calm(near: Segment, far: Segment, folder: Path, seconds: float) -> dict[str, Any]:
    """Compare all frames of both hosts while the link works, also as a client and a model see them."""
    there, here = Watcher(near), Watcher(far)
    there.await_frames(20)
    client = GrpcClient(f"unix:{folder / 'grpc.sock'}", "cell")
    models = [FrameWatcher(host, "follower") for host in (near, far)]
    time.sleep(seconds)
    received, followed = client.stop(), [(model.block, model.stop()) for model in models]
    source, mirror = there.stop(), here.stop()
    axis = values(there.block, AXIS, source)
    seen = [check_model(values(block, "seen", frames), axis) for block, frames in followed]
    first, last = mirror[0].cycle, min(mirror[-1].cycle, source[-1].cycle)
    sent = {frame.cycle: frame for frame in source}
    got = [frame for frame in mirror if first <= frame.cycle <= last and frame.cycle in sent]
    wanted = [cycle for cycle in sent if first <= cycle <= last]
    assert [frame.cycle for frame in got] == wanted, "a frame is missing, or comes twice"
    for frame in got:
        own = sent[frame.cycle]
        assert (frame.raw, frame.source_ns, frame.quality) == (own.raw, own.source_ns, own.quality)
    compared = check_client(received, source)
    assert compared > 25 * seconds, "the client has received less than half of the frames"
    assert all(number > 1 for number, _ in seen), "a model has seen no change"
    delays = [(frame.publish_ns - sent[frame.cycle].publish_ns) / 1e6 for frame in got]
    return {
        "frames": len(got), "delay_ms": statistics.median(delays), "delay_max_ms": max(delays),
        "frames of the gRPC client": compared,
        "values of the near and far model, passed over": seen,
    }  # fmt: skip


def stepped(near: Segment, far: Segment, count: int) -> dict[str, Any]:
    """Step the far host's time once for each frame of the mirror, and compare what the model has seen."""
    there = Watcher(near)
    there.await_frames(20)
    skipped = 0
    with shmio.attach(far.instance, writable=True) as cell:
        cell.step(dt_s=0.02)
        follower = FrameWatcher(far, "follower")
        for number, view in enumerate(cell.stream("cell", timeout_s=PATIENCE_S), 1):
            cell.step(dt_s=0.02)
            skipped += view.missed
            if number == count:
                break
        last = far.blocks["follower"].ring.head()
        until(lambda: any(one.number >= last for one in follower.frames), "the last step was seen", PATIENCE_S)
        cell.release()
    followed, source = follower.stop(), there.stop()
    seen = check_model(values(follower.block, "seen", followed), values(there.block, AXIS, source))
    assert seen[0] > 1, "the model has seen no change"
    return {"steps": count, "frames missed": skipped, "values, passed over": seen}


def cuts(hosts: Hosts, near: Segment, far: Segment, count: int, seconds: float) -> dict[str, Any]:
    """Cut the link and restore it; check what the mirror publishes."""
    stale_ms = far.blocks["cell"].stale_ns / 1e6
    bad, good, delivered, late = [], [], 0, 0
    for _ in range(count):
        until(lambda: is_good(far), "the mirror is good", PATIENCE_S)
        there, here = Watcher(near), Watcher(far)
        here.await_frames(5)
        hosts.cut()
        cut_s = time.monotonic()
        until(lambda: not is_good(far), "the mirror is bad", PATIENCE_S)
        bad.append((time.monotonic() - cut_s) * 1e3)
        time.sleep(max(0.0, seconds - (time.monotonic() - cut_s)))
        hosts.restore()
        restored_s = time.monotonic()
        until(lambda: is_good(far), "the mirror is good again", PATIENCE_S)
        good.append((time.monotonic() - restored_s) * 1e3)
        time.sleep(1.0)
        source, mirror = there.stop(), here.stop()
        cycles = [frame.cycle for frame in mirror if frame.quality is not Quality.BAD]
        assert cycles == sorted(set(cycles)), "the frames of the mirror are not in order, or come twice"
        own = [frame for frame in source if cycles[0] <= frame.cycle <= cycles[-1]]
        missing = {frame.cycle for frame in own if frame.quality is not Quality.BAD} - set(cycles)
        assert not missing, f"frames are missing: cycles {sorted(missing)} of {cycles[0]} to {cycles[-1]}"
        delivered += len(cycles)
        late += sum(frame.delay_us > 1e6 for frame in mirror)
    return {
        "cuts": count, "bad after, ms": [round(one) for one in bad], "stale_ms": stale_ms,
        "good after, ms": [round(one) for one in good], "frames": delivered, "late": late,
    }  # fmt: skip


def writes(hosts: Hosts, near: Segment, far: Segment, count: int, chance: random.Random) -> dict[str, Any]:
    """Write through the mirror while the link is cut at random; compare the outcomes with what the owner did."""
    ends = threading.Event()

    def disturb() -> None:
        while not ends.wait(chance.uniform(0.5, 4.0)):
            hosts.cut()
            ends.wait(chance.uniform(0.1, 4.0))
            hosts.restore()

    events = near.blocks["cell"].events.cursor()
    accepted: dict[tuple[int, int], int] = {}  # by writer and command: the number of the write
    begun: Counter[int] = Counter()
    written: Counter[int] = Counter()
    reader_ends = threading.Event()

    def read() -> None:
        while not reader_ends.is_set():
            if (event := events.next(0.2)) is None:
                continue
            if event.kind == EventKind.ACCEPTED:
                number = round(struct.unpack(">f", event.data)[0])
                accepted[event.writer, event.command] = number
                begun[number] += 1
            elif event.kind == EventKind.WRITTEN:
                written[accepted[event.writer, event.command]] += 1

    reader, disturber = threading.Thread(target=read), threading.Thread(target=disturb)
    reader.start()
    disturber.start()
    outcomes: dict[int, OutcomeKind] = {}
    cell = shmio.attach(far.instance, writable=True)
    try:
        for number in range(1, count + 1):
            value = float(number)
            try:
                [outcome] = cell.set({REGISTER: value})
            except shmio.errors.ShmioError as error:
                print("write", number, error)
                continue
            outcomes[number] = outcome.kind
            if outcome.kind is not OutcomeKind.WRITTEN:
                time.sleep(0.05)
    finally:
        cell.close()
        ends.set()
        disturber.join()
        hosts.restore()
    until(lambda: is_good(far), "the mirror is good again", PATIENCE_S)
    time.sleep(3.0)
    reader_ends.set()
    reader.join()
    assert events.missed == 0, "the test missed events"
    for number, kind in outcomes.items():
        assert begun[number] <= 1, f"the owner carried out write {number} more than once"
        if kind is OutcomeKind.WRITTEN:
            assert written[number] == 1, f"write {number} counts as written, but the owner has not written it"
        elif kind is not OutcomeKind.UNKNOWN:
            assert not begun[number], f"write {number} counts as {kind}, but the owner carried it out"
    kinds = list(outcomes.values())
    unknown = [number for number, kind in outcomes.items() if kind is OutcomeKind.UNKNOWN]
    return {
        **{str(kind): kinds.count(kind) for kind in OutcomeKind if kind in kinds},
        "unknown, but written by the owner": sum(written[number] for number in unknown),
    }


def compare(folders: Sequence[Path], *, equal: bool) -> str:
    """Compare the recordings of both hosts, and return what ``shmio-dump diff`` says.

    Args:
        folders: The folders of the near and the far instance.
        equal: Whether both must be equal. If not, the mirror may also have frames and events of its own:
            those that say that the link is lost, and those about the writes of its own host.

    """
    files = [sorted((folder / "dumps").glob("*.mem"))[0] for folder in folders]
    command: list[str | Path] = [BIN / "shmio-dump", "diff", *files, "--ignore", "times,ends"]
    text: str = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    found = subprocess.run([*command, "--json"], capture_output=True, text=True, check=False).stdout
    (source,) = json.loads(found)["sources"]
    for side in (source["frames"], source["events"]):
        assert (side["differing"], side["only_first"]) == (0, 0), text
    assert source["frames"]["compared"], text
    assert source["same"] or not equal, text
    return text


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--calm", type=float, default=10.0)
    parser.add_argument("--cuts", type=int, default=10)
    parser.add_argument("--cut", type=float, default=30.0)
    parser.add_argument("--writes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    mark = os.getpid() % 10_000
    root = Path(__file__).parents[2]
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folders = [Path(name) / "near", Path(name) / "far"]
        hosts = stack.enter_context(Hosts(mark))
        for folder, text in zip(folders, (NEAR, FAR), strict=True):
            folder.mkdir()
            shutil.copy(root / "db201.db", folder)
            (folder / "follower.py").write_text(FOLLOWER)
            (folder / "supervisor.toml").write_text(text.format(mark=mark, net=hosts.net))
        with (
            hosts.running(0, folders[0], f"near{mark}") as near,
            hosts.running(1, folders[1], f"far{mark}") as far,
        ):
            until(lambda: is_good(far), "the mirror is good", PATIENCE_S)
            print("calm:", calm(near, far, folders[1], arguments.calm), flush=True)
            print("stepped:", stepped(near, far, round(50 * arguments.calm)), flush=True)
            if arguments.cuts:
                print("cuts:", cuts(hosts, near, far, arguments.cuts, arguments.cut), flush=True)
            if arguments.writes:
                chance = random.Random(arguments.seed)
                print("writes:", writes(hosts, near, far, arguments.writes, chance), flush=True)
        equal = not (arguments.cuts or arguments.writes)
        print("recordings:", compare(folders, equal=equal), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
