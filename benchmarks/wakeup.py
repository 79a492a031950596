"""The time from a publish to the return of waiting readers: shmio's doorbell compared with other ways to wake.

There is one writer. 1, 5 or 50 readers wait when the writer begins: first processes, then threads of the writer's
process. The benchmark times the writer's call, and the return of the last reader. With *frame*, every reader has
received a copy of the 2,180 bytes by then; without it, readers are only woken.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import shutil
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, MutableSequence, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import reduction
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from common import HERE, ROOT, begin, db201, report_spread

from shmio.segment import Block, BlockSpec, ProcessSpec, Segment

OURS = "shmio Cursor.next, frame"
FRAME = bytes(range(256)) * 9
FRAME = FRAME[: db201().size]
POLL_S = 0.001
PAGE = 4096
WARM_UP = 3
"""Number of rounds that do not count, at the start of each way."""
PATIENCE_NS = 10 * 10**9

Wait = Callable[[], bytes | None]
"""Waits until the writer has called. Returns the frame if this way transfers it, otherwise None."""


@dataclass(frozen=True)
class Way:
    """One way to wake readers:

    ``ring`` wakes the first n readers; each entry of ``waiters`` makes one reader's wait.
    """

    name: str
    ring: Callable[[int], object]
    waiters: Sequence[Callable[[], Wait]]


# -- readers -----------------------------------------------------------------------------------------------------------


def follow(waiters: dict[str, Callable[[], Wait]], orders: Connection, arrivals: MutableSequence[int], at: int) -> None:
    """Run a reader: wait as often and in the way that each order says, and record when each wait returned."""
    orders.send("here")
    while (order := orders.recv()) is not None:
        name, times = order
        wait = waiters[name]()
        orders.send("ready")
        for _ in range(times):
            frame = wait()
            arrivals[at] = time.monotonic_ns()
            if frame is not None and frame != FRAME:
                raise SystemExit(f"{name}: the frame that a reader received differs from the frame that was published")
        del wait
        orders.send("done")


def _process(*arguments: Any) -> None:
    """Run a reader in a child process, which ends when its parent ends for any reason."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    follow(*arguments)


class Readers:
    """All readers. They wait only when an order tells them to."""

    def __init__(self, orders: Sequence[Connection], arrivals: MutableSequence[int]) -> None:
        self._orders = orders
        self._arrivals = arrivals
        for reader in orders:  # nobody may still be starting while others are timed
            assert reader.recv() == "here"

    def measure(self, way: Way, count: int, rounds: int, rest_s: float) -> tuple[list[float], list[float]]:
        """Return two times in µs for each round: of the writer's call, and until ``count`` readers have returned."""
        active = self._orders[:count]
        self._tell(active, (way.name, WARM_UP + rounds), "ready")
        calls, lasts = [], []
        for _ in range(WARM_UP + rounds):
            self._arrivals[:count] = [0] * count
            time.sleep(rest_s * random.uniform(1, 2))  # all are back in their waits; and no step with who polls
            begun_ns = time.monotonic_ns()
            way.ring(count)
            called_ns = time.monotonic_ns()
            time.sleep(rest_s)
            while not all(arrivals := self._arrivals[:count]):
                time.sleep(rest_s)
                if time.monotonic_ns() > begun_ns + PATIENCE_NS:
                    raise SystemExit(f"{way.name}: a reader did not return from its wait")
            calls.append((called_ns - begun_ns) / 1000)
            lasts.append((max(arrivals) - begun_ns) / 1000)
        for order in active:
            order.recv()
        return calls[WARM_UP:], lasts[WARM_UP:]

    @staticmethod
    def _tell(active: Sequence[Connection], order: object, answer: str) -> None:
        for reader in active:
            reader.send(order)
        for reader in active:
            assert reader.recv() == answer


@contextmanager
def processes(ways: Sequence[Way], count: int) -> Iterator[Readers]:
    """Start readers in processes of their own, like the programs of a cell."""
    context = multiprocessing.get_context("spawn")
    arrivals = context.RawArray("q", count)
    ends, started = [], []
    for at in range(count):
        ours, theirs = context.Pipe()
        arguments = ({way.name: way.waiters[at] for way in ways}, theirs, arrivals, at)
        reader = context.Process(target=_process, args=arguments, daemon=True)
        reader.start()
        theirs.close()
        ends.append(ours)
        started.append(reader)
    yield Readers(ends, arrivals)
    for end, reader in zip(ends, started, strict=True):
        end.send(None)
        reader.join()
        end.close()


@contextmanager
def threads(ways: Sequence[Way], count: int) -> Iterator[Readers]:
    """Start readers in threads of this process."""
    arrivals = [0] * count
    ends, started = [], []
    for at in range(count):
        ours, theirs = multiprocessing.Pipe()
        arguments = ({way.name: way.waiters[at] for way in ways}, theirs, arrivals, at)
        reader = threading.Thread(target=follow, args=arguments, daemon=True)
        reader.start()
        ends.append(ours)
        started.append(reader)
    yield Readers(ends, arrivals)
    for end, reader in zip(ends, started, strict=True):
        end.send(None)
        reader.join()
        end.close()


# -- ways: shmio -------------------------------------------------------------------------------------------------------


def _opened(instance: str) -> Block:
    segment = Segment.open(instance)
    segment.memory[::PAGE].tobytes()  # as after 8 s: no page is touched for the first time while we time
    return segment.blocks["cell"]


def _next_frame(instance: str) -> Wait:
    cursor = _opened(instance).cursor()

    def wait() -> bytes:
        frame = cursor.next()
        assert frame is not None
        return frame.raw

    return wait


def _bell(instance: str) -> Wait:
    ring = _opened(instance).ring
    seen = ring.doorbell()

    def wait() -> None:
        nonlocal seen
        while ring.doorbell() == seen:
            ring.wait(seen, -1)
        seen = ring.doorbell()

    return wait


def _polled_frame(instance: str) -> Wait:
    cursor = _opened(instance).cursor()

    def wait() -> bytes:
        while (frame := cursor.poll()) is None:
            time.sleep(POLL_S)
        return frame.raw

    return wait


@contextmanager
def shmio_ways(count: int) -> Iterator[list[Way]]:
    """Yield the frame ring, its doorbell alone, and polling the ring each millisecond."""
    name = f"bench-{os.getpid()}"
    segment = Segment.create(name, [BlockSpec("cell", db201(), 20_000_000, 10**9, 1 << 26)], [ProcessSpec("cell", "")])
    try:
        writer = segment.writer("cell")
        for _ in range(writer.block.ring.slot_count):
            writer.publish(FRAME, cycle=1)

        def publish(_: int) -> None:
            writer.publish(FRAME, cycle=1)

        yield [
            Way(OURS, publish, [partial(_next_frame, name)] * count),
            Way("shmio bell alone", lambda _: writer.block.ring.wake(), [partial(_bell, name)] * count),
            Way("shmio ring polled each 1 ms, frame", publish, [partial(_polled_frame, name)] * count),
        ]
    finally:
        segment.unlink()


# -- ways: others ------------------------------------------------------------------------------------------------------


class Fd:
    """A file descriptor that a child process inherits at its start."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __reduce__(self) -> tuple[Any, ...]:
        return _received, (reduction.DupFd(self.number),)


def _received(fd: Any) -> Fd:
    return Fd(fd.detach())


def _eventfd(fd: Fd) -> Wait:
    def wait() -> None:
        os.eventfd_read(fd.number)

    return wait


def _pipe(fd: Fd) -> Wait:
    def wait() -> None:
        os.read(fd.number, 1)

    return wait


def _socket(fd: Fd) -> Wait:
    return lambda: os.read(fd.number, len(FRAME))


@contextmanager
def descriptors(count: int) -> Iterator[list[Way]]:
    """Yield the kernel's means that wake one waiter each. The writer calls them one by one."""
    with ExitStack() as stack:
        events = [os.eventfd(0) for _ in range(count)]
        pipes = [os.pipe() for _ in range(count)]
        sockets = [socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(count)]
        for fd in [*events, *(fd for pair in pipes for fd in pair)]:
            stack.callback(os.close, fd)
        for pair in sockets:
            for end in pair:
                stack.enter_context(end)

        def write_events(active: int) -> None:
            for fd in events[:active]:
                os.eventfd_write(fd, 1)

        def write_pipes(active: int) -> None:
            for _, fd in pipes[:active]:
                os.write(fd, b"!")

        def send(active: int) -> None:
            for ours, _ in sockets[:active]:
                ours.send(FRAME)

        yield [
            Way("eventfd for each reader", write_events, [partial(_eventfd, Fd(fd)) for fd in events]),
            Way("pipe for each reader", write_pipes, [partial(_pipe, Fd(fd)) for fd, _ in pipes]),
            Way("UNIX socket for each reader, frame", send, [partial(_socket, Fd(b.fileno())) for _, b in sockets]),
        ]


def _condition(condition: Any, generation: Any, memory: Any) -> Wait:
    seen = generation.value

    def wait() -> bytes:
        nonlocal seen
        with condition:
            while generation.value == seen:
                condition.wait()
            seen = generation.value
            return bytes(memory)

    return wait


def condition_way(name: str, condition: Any, count: int) -> Way:
    """Make the way of a condition variable that guards a copy of the frame."""
    context = multiprocessing.get_context("spawn")
    generation, memory = context.RawValue("q", 0), context.RawArray("B", len(FRAME))
    view = memoryview(memory).cast("B")

    def notify(_: int) -> None:
        with condition:
            view[:] = FRAME
            generation.value += 1
            condition.notify_all()

    return Way(name, notify, [partial(_condition, condition, generation, memory)] * count)


def queue_way(count: int) -> Way:
    """Make the way of a queue for each thread, which hands the frame over without a copy."""
    queues: list[SimpleQueue[bytes]] = [SimpleQueue() for _ in range(count)]

    def put(active: int) -> None:
        for queue in queues[:active]:
            queue.put(FRAME)

    return Way("queue.SimpleQueue for each reader, frame", put, [partial(lambda queue: queue.get, q) for q in queues])


def _iceoryx_service(prefix: str, folder: str) -> Any:
    import iceoryx2 as iox  # noqa: PLC0415 - optional

    iox.set_log_level(iox.LogLevel.Error)
    config = iox.config.default()
    config.global_cfg.prefix = iox.FileName.new(prefix)
    config.global_cfg.root_path = iox.Path.new(folder)
    node = iox.NodeBuilder.new().config(config).create(iox.ServiceType.Ipc)
    builder = node.service_builder(iox.ServiceName.new("bell")).event()
    return builder.max_listeners(64).max_nodes(64).open_or_create()


def _listener(prefix: str, folder: str) -> Wait:
    listener = _iceoryx_service(prefix, folder).listener_builder().create()

    def wait() -> None:
        listener.blocking_wait()

    return wait


@contextmanager
def iceoryx(count: int) -> Iterator[list[Way]]:
    """Yield the event of iceoryx2, in a folder of its own, because it leaves files behind."""
    prefix = f"bench-{os.getpid()}-"
    with tempfile.TemporaryDirectory() as folder:
        try:
            notifier = _iceoryx_service(prefix, folder).notifier_builder().create()
        except ImportError as error:
            print(f"iceoryx2 is left out: {error}; it is among the optional dependencies `bench`")
            yield []
        else:
            yield [Way("iceoryx2 event", lambda _: notifier.notify(), [partial(_listener, prefix, folder)] * count)]
    for left in Path("/dev/shm").glob(f"{prefix}*"):
        left.unlink()


# -- the run -----------------------------------------------------------------------------------------------------------


def compare(what: str, readers: Readers, ways: Sequence[Way], count: int, rounds: int) -> None:
    """Print the times of writer and readers for all ways, sampled in turn."""
    rest_s, rounds = (0.002, rounds) if count < 10 else (0.01, rounds // 2)
    calls: dict[str, list[float]] = {way.name: [] for way in ways}
    lasts: dict[str, list[float]] = {way.name: [] for way in ways}
    for turn in range(5):
        for way in (*ways[turn % len(ways) :], *ways[: turn % len(ways)]):
            called, last = readers.measure(way, count, rounds // 5, rest_s)
            calls[way.name] += called
            lasts[way.name] += last
    report_spread(f"{what}, until the last is back", "µs", lasts, OURS)
    report_spread(f"{what}, the writer's call", "µs", calls, OURS)


def measure_native(counts: Sequence[int], rounds: int) -> None:
    """Compile and run native/wakeup.c, which measures the same without Python."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        print("\nthe figures of the C core are left out: there is no C compiler")
        return
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "wakeup"
        flags = ["-std=c11", "-D_DEFAULT_SOURCE", "-O2", f"-I{ROOT / 'shmio/segment'}"]
        subprocess.run([compiler, *flags, str(HERE / "native/wakeup.c"), "-o", str(program)], check=True)
        for count in counts:
            command = [str(program), str(count), str(rounds)]
            lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
            calls: dict[str, list[float]] = {}
            lasts: dict[str, list[float]] = {}
            for name, called_ns, last_ns in map(str.split, lines):
                calls.setdefault(name, []).append(float(called_ns) / 1000)
                lasts.setdefault(name, []).append(float(last_ns) / 1000)
            report_spread(f"C, processes, {count}, until the last is back", "µs", lasts, "ring,frame")
            report_spread(f"C, processes, {count}, the writer's call", "µs", calls, "ring,frame")


def main() -> None:
    quick = begin("Wake-up: from a publish to the readers that wait")
    counts, rounds = ((1, 3), 10) if quick else ((1, 5, 50), 300)
    most = max(counts)
    context = multiprocessing.get_context("spawn")
    with ExitStack() as stack:
        kinds = (shmio_ways, descriptors, iceoryx)
        ways = [way for kind in kinds for way in stack.enter_context(kind(most))]
        shared = condition_way("multiprocessing.Condition, frame", context.Condition(), most)
        with processes([*ways, shared], most) as readers:
            for count in counts:
                compare(f"processes, {count}", readers, [*ways, shared], count, rounds)
        local = [ways[0], condition_way("threading.Condition, frame", threading.Condition(), most), queue_way(most)]
        with threads(local, most) as readers:
            for count in counts:
                compare(f"threads, {count}", readers, local, count, rounds)
        ways.clear()
    measure_native(counts, rounds)


if __name__ == "__main__":
    main()
