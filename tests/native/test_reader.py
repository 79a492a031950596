"""The C reader of examples/, with and without sanitizers, on live and on corrupted segments."""

from __future__ import annotations

import json
import os
import random
import re
import select
import shutil
import signal
import struct
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Self

import pytest

from shmio.layout.compiler import Source, compile_sources
from shmio.layout.values.codec import codec
from shmio.model.clock import Clock, ClockMode
from shmio.segment import Attributes, BlockSpec, BlockWriter, ProcessSpec, Quality, Segment

SOURCE = Path(__file__).parents[2] / "examples/reader.c"
COMPILER = shutil.which("cc") or shutil.which("gcc") or "cc"
SHM = Path("/dev/shm")
PATIENCE_S = 20
NEVER_NS = 10**15
LINE = re.compile(r"(\d+) cycle (\d+) missed (\d+) (\w+) (\S+) (.*)")

LAYOUT = compile_sources(
    [
        Source(
            "types.db",
            b"""DATA_BLOCK "types"
{ S7_Optimized_Access := 'FALSE' }
   STRUCT
      off : Bool; on : Bool;
      sint : SInt; usint : USInt; int : Int; uint : UInt; dint : DInt; udint : UDInt; lint : LInt; ulint : ULInt;
      word : Word; real : Real; odd : Byte; lreal : LReal; last : Byte;
      long : Array[0..9] of LWord; text : String[20];
   END_STRUCT;
BEGIN
END_DATA_BLOCK
""",
        )
    ]
).layouts[0]
VALUES = {
    "off": False,
    "on": True,
    "sint": -100,
    "usint": 200,
    "int": -30_000,
    "uint": 60_000,
    "dint": -2_000_000_000,
    "udint": 4_000_000_000,
    "lint": -(10**18),
    "ulint": 2**64 - 7,
    "word": 0xBEEF,
    "real": -0.15625,
    "odd": 5,
    "lreal": 1e-300,
    "last": 255,
}


@pytest.fixture(params=["", "address,undefined"], ids=["plain", "sanitized"], scope="module")
def reader(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    program: Path = tmp_path_factory.mktemp("reader") / "reader"
    command = [COMPILER, "-std=c11", "-Wall", "-Wextra", "-Werror", str(SOURCE), "-o", str(program)]
    if request.param:
        command += ["-g", "-O1", f"-fsanitize={request.param}", "-fno-sanitize-recover=all"]
    subprocess.run(command, check=True, capture_output=True, text=True)
    return program


@contextmanager
def segment(
    instance: str, *, ring_bytes: int = 1 << 16, stale_ns: int = NEVER_NS, stepped: bool = False
) -> Iterator[Segment]:
    attributes = Attributes(stepped=stepped)
    blocks = [BlockSpec(name, LAYOUT, 10_000_000, stale_ns, ring_bytes, attributes) for name in ("other", "device")]
    with Segment.create(instance, blocks, [ProcessSpec("device", "source")]) as made:
        try:
            yield made
        finally:
            made.unlink()


def image(values: Mapping[str, object] = VALUES) -> bytes:
    raw = bytearray(LAYOUT.size)
    for register in LAYOUT.registers:
        if register.path in values:
            codec(register, LAYOUT.byte_order).encode_into(values[register.path], raw)
    return bytes(raw)


class Running:
    """A running reader, which has attached to an instance."""

    def __init__(self, program: Path, writer: BlockWriter, instance: str, path: str, *arguments: str) -> None:
        command = [str(program), instance, path, *arguments]
        pipe = subprocess.PIPE
        self.popen = subprocess.Popen(command, stdout=pipe, stderr=pipe, encoding="utf-8", errors="replace")
        assert self.popen.stdout is not None
        self._out = self.popen.stdout
        poll = select.poll()
        poll.register(self._out, select.POLLIN)
        self.first = 0
        for _ in range(
            100 * PATIENCE_S
        ):  # publish until it prints something, as nothing else shows that it is attached
            self.first = writer.publish(image(), cycle=0)
            if poll.poll(10):
                break
        number, *_ = self.line()
        while int(number) < self.first:
            number, *_ = self.line()

    def line(self) -> tuple[str, ...]:
        """Return frame, cycle, missed, quality, value and reason of the next line."""
        text = self._out.readline()
        match = LINE.fullmatch(text.rstrip("\n"))
        assert match, (text, self.popen.poll())
        return match.groups()

    def end(self) -> tuple[int, str]:
        """Wait until it exits; return its exit status and the rest of its output."""
        _, errors = self.popen.communicate(timeout=PATIENCE_S)
        return self.popen.returncode, errors

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.popen.kill()
        self.popen.communicate()


@pytest.mark.parametrize("path", VALUES)
def test_values_of_all_types(reader: Path, instance: str, path: str) -> None:
    with segment(instance) as made:
        writer = made.writer("device")
        with Running(reader, writer, instance, f"device/{path}") as running:
            number = writer.publish(image(), cycle=7)
            line = running.line()
            assert line[:4] == (str(number), "7", "0", "good")
            shown: object = json.loads(line[4])
            assert shown == VALUES[path]
            writer.publish(image({}), cycle=8, effective=image())  # readers see this image, not the device's
            assert json.loads(running.line()[4]) == VALUES[path]


def test_every_frame_once_and_losses_counted(reader: Path, instance: str) -> None:
    """A reader that is stopped while its ring wraps several times counts the lost frames."""
    with segment(instance, ring_bytes=16 << 10) as made:
        writer = made.writer("device")
        slots = made.blocks["device"].ring.slot_count
        with Running(reader, writer, instance, "device/ulint") as running:
            first = running.first
            for _ in range(3):
                number = writer.publish(image(), cycle=1)
                assert running.line()[0] == str(number)
            running.popen.send_signal(signal.SIGSTOP)
            os.waitpid(running.popen.pid, os.WUNTRACED)
            for value in range(3 * slots):
                number = writer.publish(image({"ulint": value}), cycle=2)
            running.popen.send_signal(signal.SIGCONT)
            lines = [running.line()]
            while int(lines[-1][0]) < number:
                lines.append(running.line())
            numbers = [int(line[0]) for line in lines]
            assert numbers == list(range(numbers[0], number + 1))
            assert numbers[0] > first + 4, "nothing was lost"
            assert {int(line[2]) for line in lines} == {numbers[0] - (first + 4)}
            assert [int(line[4]) for line in lines] == list(range(3 * slots))[-len(lines) :]


def test_it_exits_after_the_given_number_of_frames(reader: Path, instance: str) -> None:
    with segment(instance) as made:
        writer = made.writer("device")
        with Running(reader, writer, instance, "device/int", "100") as running:
            while running.popen.poll() is None and writer.publish(image(), cycle=1) < 1000:
                pass
            assert running.end() == (0, "")


def test_bad_and_stale_frames_are_printed_with_the_reason(reader: Path, instance: str) -> None:
    with segment(instance) as made:
        writer = made.writer("device")
        with Running(reader, writer, instance, "device/on") as running:
            number = writer.publish(image(), cycle=4, quality=Quality.BAD, reason="no answer within 200 ms")
            assert running.line() == (str(number), "4", "0", "bad", "true", "no answer within 200 ms")
    with segment(instance, stale_ns=300_000_000) as made:
        writer = made.writer("device")
        with Running(reader, writer, instance, "device/on") as running:
            number = writer.publish(image(), cycle=5)
            shown = running.line()
            while shown[3] == "good":
                shown = running.line()  # no new frame comes: it prints the line by itself, once
            assert shown == (str(number), "5", "0", "bad", "true", "stale")


def test_the_instance_clock_decides_how_old_a_stepped_source_is(reader: Path, instance: str) -> None:
    with segment(instance, stale_ns=300_000_000, stepped=True) as made:
        hour_ns = 3600 * 10**9
        made.clock.write(Clock(ClockMode.VIRTUAL, 7, hour_ns, 10**7, 7))
        writer = made.writer("device")
        with Running(reader, writer, instance, "device/on") as running:
            made.clock.write(Clock(ClockMode.VIRTUAL, 8, 2 * hour_ns, hour_ns, 7, stepping=True))
            number = writer.publish(image(), cycle=7)
            assert running.line()[:4] == (str(number), "7", "0", "good"), "the step is not done yet"
            made.clock.write(Clock(ClockMode.VIRTUAL, 8, 2 * hour_ns, hour_ns, 8))
            assert running.line() == (str(number), "7", "0", "bad", "true", "stale")
            writer.at_ns = made.clock.monotonic_ns(2 * hour_ns)
            number = writer.publish(image(), cycle=8)
            assert running.line()[:4] == (str(number), "8", "0", "good")
            made.clock.write(Clock(step=8, resumed_ns=2 * hour_ns, offset_ns=-10 * hour_ns))  # back to real time
            writer.at_ns = made.clock.now_ns() + hour_ns  # not stale, however slow the host is
            number = writer.publish(image(), cycle=9)
            assert running.line()[:4] == (str(number), "9", "0", "good")


def test_it_exits_when_the_instance_stops(reader: Path, instance: str) -> None:
    with segment(instance) as made:
        running = Running(reader, made.writer("device"), instance, "device/on")
    with running:
        assert running.end() == (1, f"{instance} has stopped\n")


def run(program: Path, *arguments: str) -> tuple[int, str, str]:
    done = subprocess.run([program, *arguments], capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    return done.returncode, done.stdout, done.stderr


def test_wrong_arguments_give_one_clear_line(reader: Path, instance: str) -> None:
    assert run(reader) == (1, "", "usage: reader INSTANCE SOURCE/REGISTER [FRAMES]\n")
    assert run(reader, instance, "device/on")[2] == f"no instance {instance}, or no permission to read it\n"
    with segment(instance):
        for path, message in {
            "nothing/on": "no source nothing",
            "device/onn": "source device has no register onn",
            "device/long": "long is an array: name a register of one value",
            "device/text": "text: a value of type STRING cannot be shown",
        }.items():
            assert run(reader, instance, path) == (1, "", message + "\n")


def test_an_unfinished_segment_is_an_error(reader: Path, instance: str) -> None:
    file = SHM / f"shmio-{instance}"
    early = f"instance {instance} is starting, or died during its start\n"
    for content, message in (
        (b"", early),
        (bytes(100), early),
        (bytes(1 << 20), early),
        (b"SHMIOSEG" + struct.pack("<II", 9, 4096) + bytes(8192), f"/dev/shm/shmio-{instance} has ABI 9"),
        (b"\x7fELF" * 4096, f"/dev/shm/shmio-{instance} is no segment of shmio\n"),
        (b"SHMIOSEG" + struct.pack("<II", 2, 4096) + bytes(4080), "the section table is not sound\n"),
    ):
        file.write_bytes(content)
        status, output, errors = run(reader, instance, "device/on", "1")
        assert (status, output) == (1, "")
        assert errors.startswith(message)


def places(whole: bytes) -> list[int]:
    """Return the offsets of the words that tell a reader where to read: header, section table, ring headers."""
    (table,) = struct.unpack_from("<Q", whole, 56)
    (count,) = struct.unpack_from("<I", whole, 52)
    found = [0, *range(8, 90, 4)]
    for entry in range(table, table + 128 * count, 128):
        found += range(entry, entry + 32, 4)
        kind, _, at = struct.unpack_from("<IIQ", whole, entry)
        if kind == 2:
            found += [*range(at, at + 48, 4), at + 64, at + 68]
    return found


def test_hostile_bytes_never_crash_it(reader: Path, instance: str) -> None:
    """The test writes random words into the header, section table and ring headers."""
    with segment(instance, ring_bytes=1 << 12) as made:
        writer = made.writer("device")
        for cycle in range(20):
            writer.publish(image(), cycle=cycle)
        whole = bytes(made.memory)
    chance = random.Random(1)
    edges = [
        0,
        1,
        4,
        7,
        8,
        63,
        64,
        320,
        2**31,
        2**32 - 1,
        2**63,
        2**64 - 8,
        len(whole),
        len(whole) - 1,
        len(whole) - 64,
    ]
    words = places(whole)
    with ExitStack() as stack:
        readers = []
        for copy in range(100):
            hostile = bytearray(whole)
            for _ in range(chance.choice((1, 1, 2, 6))):
                at, size = chance.choice(words), chance.choice((4, 8))
                value = chance.choice((*edges, chance.getrandbits(64), chance.getrandbits(20)))
                hostile[at : at + size] = (value % 2 ** (8 * size)).to_bytes(size, "little")
            file = SHM / f"shmio-{instance}-{copy}"
            stack.callback(file.unlink)
            file.write_bytes(hostile)
            command = [str(reader), f"{instance}-{copy}", "device/on", "1"]
            popen = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
            stack.callback(popen.communicate)
            stack.callback(popen.kill)  # a reader that found no error waits for a frame
            readers.append(popen)
        sound = 0
        for popen in readers:
            try:
                errors = popen.communicate(timeout=0.05)[1]
            except subprocess.TimeoutExpired:
                sound += 1
                continue
            assert popen.returncode == 1, errors
            assert errors.count(b"\n") == 1, errors
        assert 0 < sound < 100


def test_hostile_rings_never_crash_it(reader: Path, instance: str) -> None:
    """The test corrupts slots of the ring (sequence, sizes, texts) at random while the reader follows."""
    chance = random.Random(2)
    with segment(instance, ring_bytes=1 << 12) as made:
        writer = made.writer("device")
        slots = made.blocks["device"].ring.slot_count
        whole = bytes(made.memory)
        ring = next(at for at in places(whole)[::-1] if whole[at : at + 4] == struct.pack("<I", slots))
        stride = struct.unpack_from("<I", whole, ring + 4)[0]
        with Running(reader, writer, instance, "device/on") as running:
            for turn in range(300):
                head = writer.publish(image(), cycle=turn)
                slot = ring + 128 + stride * (head % slots)
                made.memory[slot + 8 : slot + 320] = chance.randbytes(312)
                if turn % 3 == 0:
                    struct.pack_into("<Q", made.memory, slot, chance.getrandbits(64))
                if turn % 50 == 0:
                    struct.pack_into(
                        "<Q", made.memory, ring + 64, chance.choice((0, 2**64 - 1, chance.getrandbits(63)))
                    )
                    made.blocks["device"].ring.wake()
            assert running.popen.poll() is None
