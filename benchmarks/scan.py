"""Finding the registers that changed between two frames, and decoding them: shmio's scan and codecs, and other ways.

There are two layouts of the same 2,180 bytes. DB201 as it is has 22 registers, because each of its two areas is one
register. The finer layout has 2,120: each byte of the areas is a register of its own, as in a project with named
signals. The registers that change are spread over the block. Before anything is timed, all ways must find the same
registers and values.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from common import begin, db201, interleave, per_call_ns, report

from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout, Register
from shmio.layout.values.codec import Value, codec
from shmio.layout.values.frame_codec import FrameCodec
from shmio.segment.changed_registers import ChangeScan

OURS = "shmio"
PERCENTAGES = (0, 1, 5, 100)


def finer() -> Layout:
    """Return the layout of DB201 with a register for each byte of its areas."""
    members = [f"I{at:04} : Byte;" for at in range(1000)] + [f"O{at:04} : Byte;" for at in range(1100)]
    members += [f"Axis{at:02} : Real;" for at in range(20)]
    text = "DATA_BLOCK \"DB201\"\n{ S7_Optimized_Access := 'FALSE' }\nSTRUCT\n"
    text += "\n".join(members) + "\nEND_STRUCT;\nBEGIN\nEND_DATA_BLOCK\n"
    return compile_sources([Source("finer.db", text.encode())]).layouts[0]


# -- contenders --------------------------------------------------------------------------------------------------------


class Ways:
    """All contenders for one layout, which compare the images ``old`` and ``new``."""

    def __init__(self, layout: Layout) -> None:
        self.registers = layout.registers
        self.scan = ChangeScan(self.registers)
        self.frames = FrameCodec(layout)
        self.codecs = [codec(register) for register in self.registers]
        self.struct = struct.Struct(">" + "".join(_format(register) for register in self.registers))
        self.big = np.dtype([(f"r{at}", *_big(register)) for at, register in enumerate(self.registers)])
        assert self.struct.size == self.big.itemsize == layout.size
        self.raw = np.dtype([(f"r{at}", f"V{register.size}") for at, register in enumerate(self.registers)])
        self.owner = np.repeat(np.arange(len(self.registers)), [register.size for register in self.registers])
        self.spans = [(register.offset, register.offset + register.size) for register in self.registers]

    # what changed

    def numpy_bytes(self, old: bytes, new: bytes) -> list[int]:
        """Compare all bytes at once, then look up the registers of those that differ."""
        differ = np.frombuffer(old, np.uint8) != np.frombuffer(new, np.uint8)
        changed = np.zeros(len(self.registers), bool)
        changed[self.owner[differ]] = True
        found: list[int] = np.flatnonzero(changed).tolist()
        return found

    def numpy_record(self, old: bytes, new: bytes) -> list[int]:
        """Compare the fields of a structured array as raw bytes, because a NaN differs from itself."""
        before, after = np.frombuffer(old, self.raw)[0], np.frombuffer(new, self.raw)[0]
        return [at for at in range(len(self.registers)) if before[at].tobytes() != after[at].tobytes()]

    def unpacked(self, old: bytes, new: bytes) -> list[int]:
        """Unpack both images and compare the values, which is wrong for NaN and -0.0."""
        both = zip(self.struct.unpack(old), self.struct.unpack(new), strict=True)
        return [at for at, (before, after) in enumerate(both) if before != after]

    def loop(self, old: bytes, new: bytes) -> list[int]:
        """Compare the slice of each register."""
        return [at for at, (start, stop) in enumerate(self.spans) if old[start:stop] != new[start:stop]]

    # what it is

    def decode_changed(self, old: bytes, new: bytes) -> list[Value]:
        """Find the registers that changed by shmio's scan, and decode each with its codec."""
        codecs = self.codecs
        return [codecs[at].decode(new) for at in self.scan.changed(old, new)]

    def decode_by_codec(self, new: bytes) -> list[Value]:
        """Decode every register with its codec."""
        return [each.decode(new) for each in self.codecs]

    def decode_by_loop(self, new: bytes) -> list[object]:
        """Decode every register in the way of a short script."""
        return [
            struct.unpack_from(">f", new, register.offset)[0]
            if register.type == "REAL"
            else new[register.offset]
            if not register.dims
            else list(new[register.offset : register.offset + register.size])
            for register in self.registers
        ]

    def decode_by_dtype(self, new: bytes) -> Any:
        """Decode a big-endian record to native numbers with numpy."""
        return np.frombuffer(new, self.big).astype(self.frames.dtype)


def _format(register: Register) -> str:
    if register.dims:
        return f"{register.size}s"
    return "f" if register.type == "REAL" else "B"


def _big(register: Register) -> tuple[str, tuple[int, ...]]:
    return ">f4" if register.type == "REAL" else "u1", register.shape


# -- the run -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Frames:
    """A frame, and a later one in which so many registers differ."""

    old: bytes
    new: bytes
    changed: list[int]


def frames(registers: Sequence[Register], size: int, percent: int) -> Frames:
    """Make two frames. REALs are finite, and a changed register differs in its last byte."""
    draw = random.Random(percent)
    old = bytearray(draw.randbytes(size))
    for register in registers:
        if register.type == "REAL":
            struct.pack_into(">f", old, register.offset, draw.uniform(-180, 180))
    count = -(-len(registers) * percent // 100)
    changed = sorted(draw.sample(range(len(registers)), count))
    new = bytearray(old)
    for at in changed:
        new[registers[at].offset + registers[at].size - 1] ^= 1
    return Frames(bytes(old), bytes(new), changed)


def compare(title: str, contenders: dict[str, Callable[[], object]], rounds: int, calls: int) -> None:
    """Time all contenders in turn, the slow ones with fewer calls."""
    samplers = {}
    for name, call in contenders.items():
        cost_ns = min(per_call_ns(call, 3)() for _ in range(3))
        samplers[name] = per_call_ns(call, max(3, min(calls, int(calls * 1000 / cost_ns))))
    report(title, "ns", interleave(samplers, rounds), OURS, "less")


def measure(layout: Layout, rounds: int, calls: int) -> None:
    """Print the tables of one layout."""
    ways, count = Ways(layout), len(layout.registers)
    for percent in PERCENTAGES:
        pair = frames(layout.registers, layout.size, percent)
        scans: dict[str, Callable[[bytes, bytes], list[int]]] = {
            OURS: ways.scan.changed,
            "numpy, all bytes": ways.numpy_bytes,
            "struct, all values": ways.unpacked,
            "Python loop over slices": ways.loop,
            "numpy, record by field": ways.numpy_record,
        }
        for name, scan in scans.items():
            if scan(pair.old, pair.new) != pair.changed:
                raise SystemExit(f"{name}: did not find exactly the registers that were changed")
        calls_of: dict[str, Callable[[], object]] = {
            name: partial(scan, pair.old, pair.new) for name, scan in scans.items()
        }
        old, new = pair.old, pair.new
        calls_of["bytes ==, which says only whether (the limit)"] = partial(bytes.__eq__, old, bytes(bytearray(new)))
        compare(f"{count} registers, {percent} % changed: scan", calls_of, rounds, calls)
        compare(
            f"{count} registers, {percent} % changed: values",
            {
                OURS: partial(ways.decode_changed, old, new),
                "all by FrameCodec, to numpy": partial(ways.frames.decode, new),
                "all by codec": partial(ways.decode_by_codec, new),
                "all by Python loop": partial(ways.decode_by_loop, new),
            },
            rounds,
            calls,
        )
    _measure_whole(ways, pair.new, f"{count} registers: the whole frame decoded", rounds, calls)


def _measure_whole(ways: Ways, new: bytes, title: str, rounds: int, calls: int) -> None:
    decoded, by_dtype = ways.frames.decode(new), ways.decode_by_dtype(new)
    if decoded.tobytes() != by_dtype.tobytes():
        raise SystemExit("numpy and FrameCodec decode differently")
    if ways.decode_by_codec(new) != ways.decode_by_loop(new):
        raise SystemExit("codec and loop decode differently")
    compare(
        title,
        {
            OURS: partial(ways.frames.decode, new),
            "numpy record, astype": partial(ways.decode_by_dtype, new),
            "numpy record, big-endian as it is (the limit)": partial(np.frombuffer, new, ways.big),
            "struct": partial(ways.struct.unpack, new),
            "shmio codec, register by register": partial(ways.decode_by_codec, new),
            "Python loop": partial(ways.decode_by_loop, new),
        },
        rounds,
        calls,
    )
    many = new * 100
    compare(
        f"{title}, 100 at once",
        {
            OURS: partial(ways.frames.decode, many),
            "numpy record, astype": lambda: np.frombuffer(many, ways.big).astype(ways.frames.dtype),
            "struct": lambda: list(ways.struct.iter_unpack(many)),
        },
        rounds,
        calls // 10,
    )


def main() -> None:
    quick = begin("Change scan and decoding of a frame of 2,180 bytes")
    rounds, calls = (2, 50) if quick else (11, 20_000)
    for layout in (db201(), finer()):
        measure(layout, rounds, calls)


if __name__ == "__main__":
    main()
