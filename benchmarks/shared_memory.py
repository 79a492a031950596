"""Publishing and copying one 2,180-byte frame in shared memory: shmio's ring and other ways to share it.

The contenders give different guarantees. A bare copy is the limit, and is not safe between processes. A lock or a
semaphore gives one whole frame, as long as no process dies while it holds the lock; it wakes no reader. The ring
gives whole frames with their history, time and quality, wakes waiting readers, and needs nothing from its readers.
"""

from __future__ import annotations

import ctypes
import mmap
import multiprocessing
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import posix_ipc
from common import HERE, ROOT, begin, db201, interleave, per_call_ns, report

from shmio.segment import BlockSpec, ProcessSpec, Segment

OURS = "shmio Ring"
USUAL_SLOTS = 512  # 8 s at 50 Hz


@dataclass(frozen=True)
class Contender:
    """One way to share a frame: ``publish`` makes it visible to all readers, ``snapshot`` returns a copy."""

    name: str
    publish: Callable[[], object]
    snapshot: Callable[[], Any]
    image: Callable[[Any], bytes] = bytes
    """Returns the frame's bytes in a snapshot, to check it. It is not timed."""


# -- contenders --------------------------------------------------------------------------------------------------------


@contextmanager
def shmio_rings(frame: bytes) -> Iterator[list[Contender]]:
    """Yield shmio's ring with 8 slots, which stays in the cache as a single frame does, and with the usual length."""
    layout = db201()
    sizes = {"few": 1 << 15, "usual": 1 << 26}
    specs = [BlockSpec(name, layout, 20_000_000, 10**9, size) for name, size in sizes.items()]
    segment = Segment.create(f"bench-{os.getpid()}", specs, [ProcessSpec("few", "source")])
    try:
        block, writer = segment.blocks["few"], segment.writer("few")
        few, usual = block.ring, segment.blocks["usual"].ring
        usual.begin()
        assert (few.slot_count, usual.slot_count) == (8, USUAL_SLOTS)
        arguments = (frame, None, 1, 2, 3, 4, 2, 0, 0, 0, b"")
        yield [
            Contender(OURS, partial(few.publish, *arguments), few.latest, lambda fields: bytes(fields[11])),
            Contender(
                f"{OURS}, {USUAL_SLOTS} slots",
                partial(usual.publish, *arguments),
                usual.latest,
                lambda fields: bytes(fields[11]),
            ),
            Contender(
                "shmio BlockWriter, Block",
                lambda: writer.publish(frame, cycle=1),
                block.latest,
                lambda fields: bytes(fields.raw),
            ),
        ]
    finally:
        segment.unlink()


@contextmanager
def copies(frame: bytes) -> Iterator[list[Contender]]:
    """Yield a bare copy, and copies under the means that keep two processes apart."""
    size = len(frame)
    memory = mmap.mmap(-1, size)
    context = multiprocessing.get_context("spawn")
    lock, condition = context.Lock(), context.Condition()
    semaphore = posix_ipc.Semaphore(None, posix_ipc.O_CREX, initial_value=1)
    semaphore.unlink()

    def publish() -> None:
        memory[:size] = frame

    def snapshot() -> bytes:
        return memory[:size]

    def publish_locked() -> None:
        with lock:
            memory[:size] = frame

    def snapshot_locked() -> bytes:
        with lock:
            return memory[:size]

    def publish_signalled() -> None:
        with semaphore:
            memory[:size] = frame

    def snapshot_signalled() -> bytes:
        with semaphore:
            return memory[:size]

    def publish_notified() -> None:
        with condition:
            memory[:size] = frame
            condition.notify_all()

    def snapshot_notified() -> bytes:
        with condition:
            return memory[:size]

    yield [
        Contender("copy alone (the limit)", publish, snapshot),
        Contender("posix_ipc.Semaphore, copy", publish_signalled, snapshot_signalled),
        Contender("multiprocessing.Lock, copy", publish_locked, snapshot_locked),
        Contender("multiprocessing.Condition, copy, notify_all", publish_notified, snapshot_notified),
    ]
    semaphore.close()


@contextmanager
def iceoryx(frame: bytes) -> Iterator[list[Contender]]:
    """Yield the two messaging patterns of iceoryx2 that fit.

    They have a folder of their own, because they leave files behind.
    """
    prefix = f"bench-{os.getpid()}-"
    with tempfile.TemporaryDirectory() as folder:
        try:
            yield _iceoryx_contenders(frame, prefix, folder)
        except ImportError as error:
            print(f"iceoryx2 is left out: {error}; it is among the optional dependencies `bench`")
            yield []
    for left in Path("/dev/shm").glob(f"{prefix}*"):
        left.unlink()


def _iceoryx_contenders(frame: bytes, prefix: str, folder: str) -> list[Contender]:
    """Make the blackboard, which has a newest value as the ring does, and publish-subscribe, a queue.

    A queue delivers each sample once. The snapshot of publish-subscribe therefore includes a publish.
    """
    import iceoryx2 as iox  # noqa: PLC0415 - optional

    size = len(frame)

    class Image(ctypes.Structure):
        _fields_ = (("data", ctypes.c_uint8 * size),)

    iox.set_log_level(iox.LogLevel.Error)
    config = iox.config.default()
    config.global_cfg.prefix = iox.FileName.new(prefix)
    config.global_cfg.root_path = iox.Path.new(folder)
    node = iox.NodeBuilder.new().config(config).create(iox.ServiceType.Ipc)

    key = ctypes.c_uint64(0)
    builder = node.service_builder(iox.ServiceName.new("board"))
    board = builder.blackboard_creator(ctypes.c_uint64).add(key, Image()).create()
    entry_mut = board.writer_builder().create().entry(key, Image)
    entry = board.reader_builder().create().entry(key, Image)

    builder = node.service_builder(iox.ServiceName.new("queue"))
    queue = builder.publish_subscribe(iox.Slice[ctypes.c_uint8]).subscriber_max_buffer_size(1).create()
    publisher = queue.publisher_builder().initial_max_slice_len(size).create()
    subscriber = queue.subscriber_builder().buffer_size(1).create()

    def publish() -> None:
        sample = publisher.loan_slice_uninit(size)
        ctypes.memmove(sample.payload_ptr, frame, size)
        sample.assume_init().send()

    def publish_and_receive() -> bytes:
        publish()
        return ctypes.string_at(subscriber.receive().payload_ptr, size)

    update = partial(entry_mut.update_with_copy, Image.from_buffer_copy(frame))
    return [
        Contender("iceoryx2 blackboard", update, entry.get, lambda value: bytes(value.data)),
        Contender("iceoryx2 publish-subscribe (snapshot: both)", publish, publish_and_receive),
    ]


def measure(contenders: list[Contender], frame: bytes, rounds: int, calls: int) -> None:
    """Check each contender once, then time them all in turn."""
    for contender in contenders:
        contender.publish()
        if contender.image(contender.snapshot()) != frame:
            raise SystemExit(f"{contender.name}: the frame that was read differs from the frame that was published")
    publish = {contender.name: per_call_ns(contender.publish, calls) for contender in contenders}
    snapshot = {contender.name: per_call_ns(contender.snapshot, calls) for contender in contenders}
    report("Python, publish", "ns", interleave(publish, rounds), OURS, "less")
    report("Python, snapshot", "ns", interleave(snapshot, rounds), OURS, "less")


# -- the C core --------------------------------------------------------------------------------------------------------


def measure_native(rounds: int, calls: int) -> None:
    """Compile and run native/ring.c, once for each length of the ring."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        print("\nthe figures of the C core are left out: there is no C compiler")
        return
    samples: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        program = Path(folder) / "ring"
        flags = ["-std=c11", "-D_DEFAULT_SOURCE", "-O2", f"-I{ROOT / 'shmio/segment'}"]  # -O2: as setup.py has it
        subprocess.run([compiler, *flags, str(HERE / "native/ring.c"), "-o", str(program)], check=True)
        for slots in (8, USUAL_SLOTS):
            command = [str(program), str(slots), str(rounds), str(calls)]
            lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
            for name, value in map(str.split, lines):
                samples.setdefault(f"{name} {slots}", []).append(float(value))
    publish = {
        "ring_publish": samples["publish 8"],
        f"ring_publish, {USUAL_SLOTS} slots": samples[f"publish {USUAL_SLOTS}"],
        "doorbell_ring alone, a part of it": samples["bell 8"],
        "memcpy (the limit)": samples["copy_in 8"],
    }
    snapshot = {
        "ring_latest": samples["latest 8"],
        f"ring_latest, {USUAL_SLOTS} slots": samples[f"latest {USUAL_SLOTS}"],
        "memcpy (the limit)": samples["copy_out 8"],
    }
    report("C, publish", "ns", publish, "ring_publish", "less")
    report("C, snapshot", "ns", snapshot, "ring_latest", "less")


def main() -> None:
    quick = begin("Shared memory: one frame of 2,180 bytes")
    rounds, calls = (3, 2_000) if quick else (15, 20_000)
    frame = bytes(range(256)) * 9
    frame = frame[: db201().size]
    with ExitStack() as stack:
        ways = [stack.enter_context(way(frame)) for way in (shmio_rings, copies, iceoryx)]
        measure([contender for way in ways for contender in way], frame, rounds, calls)
        ways.clear()  # iceoryx2 cleans up when nobody holds anything of it
    measure_native(rounds, calls)


if __name__ == "__main__":
    main()
