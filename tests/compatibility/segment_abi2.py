"""A reader of segments of ABI 2, written from docs/reference/segment-format.md alone; it imports nothing of shmio.

It stands for the programs that other people wrote from that page. Do not adapt it to a change of the code: a segment
that it cannot read needs a new ABI number, and a reader of its own.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import struct
from pathlib import Path
from typing import Any

ABI = 2
LAYOUT, FRAMES, EVENTS, COMMANDS, SOURCE, INJECTIONS, CLOCK, DECLARED = range(1, 9)
READERS = 11


class RefusedError(Exception):
    """The segment is not of this ABI."""


def text(data: bytes) -> str:
    return data.partition(b"\0")[0].decode()


class Reader:
    """A mapped segment. Its methods return copies, as dictionaries with the names of the page."""

    def __init__(self, file: Path) -> None:
        with file.open("rb") as stream:
            self.memory = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        magic, abi, header_size = self.unpack("<8sII", 0)
        if (magic, abi, header_size) != (b"SHMIOSEG", ABI, 4096):
            raise RefusedError(f"{file.name} has ABI {abi}, this program knows {ABI}")

    def close(self) -> None:
        self.memory.close()

    def unpack(self, layout: str, at: int) -> tuple[Any, ...]:
        return struct.unpack_from(layout, self.memory, at)

    def cell(self, at: int, size: int) -> bytes:
        """Return the bytes of a cell of ``size`` bytes, without its sequence number."""
        for _ in range(1000):
            (before,) = self.unpack("<Q", at)
            copy = self.memory[at + 8 : at + size]
            if before % 2 == 0 and self.unpack("<Q", at) == (before,):
                return copy
        raise TimeoutError("the cell was being written each time")

    def header(self) -> dict[str, Any]:
        epoch, size, started_utc, started, generation, count = self.unpack("<QQqqII", 16)
        sections, capacity, entry_size, processes, process_capacity, slot_size = self.unpack("<QIIQII", 56)
        pid, state = struct.unpack("<II", self.cell(512, 16))
        return {
            "epoch": epoch,
            "size": size,
            "started_utc": started_utc,
            "started": started,
            "generation": generation,
            "section_count": count,
            "sections_offset": sections,
            "section_capacity": capacity,
            "section_entry_size": entry_size,
            "processes_offset": processes,
            "process_capacity": process_capacity,
            "process_slot_size": slot_size,
            "mode": text(self.memory[96:112]),
            "instance": text(self.memory[112:176]),
            "version": text(self.memory[176:208]),
            "control": text(self.memory[208:464]),
            "supervised_since": self.unpack("<Q", 496)[0],
            "supervisor_heartbeat": self.unpack("<q", 504)[0],
            "pid": pid,
            "state": state,
            "note": text(self.cell(528, 496)),
            "config": text(self.memory[1024:4096]),
        }

    def section(self, kind: int, source: str) -> tuple[int, int, bytes]:
        """Return place, size and digest of a section that is not retired."""
        header = self.header()
        entries = []
        for index in range(header["section_count"]):
            at = header["sections_offset"] + 128 * index
            found, flags, offset, size, layout = self.unpack("<IIQQI", at)
            name, digest = text(self.memory[at + 32 : at + 96]), self.memory[at + 96 : at + 128]
            entries.append((found, flags, offset, size, layout, name, digest))
        for found, flags, offset, size, layout, name, digest in entries:
            if found == kind and not flags & 1 and name == source:
                assert kind in (LAYOUT, CLOCK) or (entries[layout][0], entries[layout][5]) == (LAYOUT, source)
                return offset, size, digest
        raise KeyError(f"{source} has no section of kind {kind}")

    def layout(self, source: str) -> dict[str, Any]:
        at, size, digest = self.section(LAYOUT, source)
        data = self.memory[at : at + size]
        assert hashlib.sha256(data).digest() == digest
        found: dict[str, Any] = json.loads(data)
        return found

    def source(self, source: str) -> dict[str, Any]:
        at, size, _ = self.section(SOURCE, source)
        found: dict[str, Any] = json.loads(self.memory[at : at + size].rstrip(b"\0"))
        return found

    def listed(self, kind: int, source: str) -> list[dict[str, Any]]:
        """Return a list of injections or of declarations."""
        at, size, _ = self.section(kind, source)
        assert size >= 32768
        found: list[dict[str, Any]] = json.loads(self.cell(at, 32768).rstrip(b"\0") or b"[]")
        return found

    def ring(self, kind: int, source: str) -> dict[str, int]:
        at, size, _ = self.section(kind, source)
        slot_count, stride, frame_size = self.unpack("<III", at)
        raw, effective = self.unpack("<II", at + 16)
        (
            period,
            stale,
        ) = self.unpack("<qq", at + 32)
        head, doorbell, incarnation = self.unpack("<QII", at + 64)
        assert slot_count & (slot_count - 1) == 0
        assert raw == 320
        assert 128 + slot_count * stride <= size
        return {
            "at": at,
            "slot_count": slot_count,
            "slot_stride": stride,
            "frame_size": frame_size,
            "effective_offset": effective,
            "period": period,
            "stale": stale,
            "head": head,
            "doorbell": doorbell,
            "incarnation": incarnation,
        }

    def slot(self, ring: dict[str, int], number: int) -> dict[str, Any]:
        """Return a complete frame or event."""
        at = ring["at"] + 128 + ring["slot_stride"] * (number % ring["slot_count"])
        assert self.unpack("<Q", at) == (2 * number + 2,)
        cycle, publish, clock, source, incarnation = self.unpack("<QqqqI", at + 8)
        quality, provenance, flags, reason_size, delay, event = self.unpack("<BBHHxxIQ", at + 44)
        image = ring["effective_offset"] if flags & 1 else 320
        found = {
            "cycle": cycle,
            "publish": publish,
            "clock": clock,
            "source": source,
            "incarnation": incarnation,
            "quality": quality,
            "provenance": provenance,
            "reason": self.memory[at + 64 : at + 64 + reason_size].decode(),
            "delay": delay,
            "event": event,
            "raw": self.memory[at + 320 : at + 320 + ring["frame_size"]],
            "image": self.memory[at + image : at + image + ring["frame_size"]],
        }
        assert self.unpack("<Q", at) == (2 * number + 2,)
        return found

    def frame(self, source: str) -> dict[str, Any]:
        """Return the newest frame."""
        ring = self.ring(FRAMES, source)
        return self.slot(ring, ring["head"])

    def value(self, source: str, path: str, key: str = "image") -> Any:
        """Return a number of the newest frame."""
        register = next(one for one in self.layout(source)["registers"] if one["path"] == path)
        order = ">" if self.layout(source)["byte_order"] == "big" else "<"
        if register["type"] == "BOOL":
            return bool(self.frame(source)[key][register["offset"]] >> register["bit"] & 1)
        form = {"REAL": "f", "LREAL": "d", "INT": "h", "DINT": "i", "WORD": "H"}[register["type"]]
        return struct.unpack_from(order + form, self.frame(source)[key], register["offset"])[0]

    def events(self, source: str) -> list[dict[str, Any]]:
        ring = self.ring(EVENTS, source)
        assert (ring["slot_count"], ring["frame_size"], ring["period"], ring["stale"]) == (2048, 296, 0, 0)
        found = []
        for number in range(1, ring["head"] + 1):
            slot = self.slot(ring, number)
            raw = slot["raw"]
            kind, size, writer, command, item, offset, mask, items, length, injection = struct.unpack_from(
                "<HHIQIIBxHIQ", raw
            )
            found.append(
                {
                    "kind": kind,
                    "writer": writer,
                    "command": command,
                    "item": item,
                    "offset": offset,
                    "mask": mask,
                    "items": items,
                    "size": length,
                    "injection": injection,
                    "data": raw[40 : 40 + size],
                    "text": slot["reason"],
                    "frame": slot["event"],
                    "utc": slot["source"],
                }
            )
        return found

    def queues(self, source: str) -> list[tuple[int, int]]:
        """Return head and tail of each command queue."""
        at, size, _ = self.section(COMMANDS, source)
        count, stride, capacity = self.unpack("<III", at)
        assert 64 + count * stride <= size
        assert stride >= 128 + capacity
        places = [at + 64 + stride * index for index in range(count)]
        return [(self.unpack("<Q", place)[0], self.unpack("<Q", place + 64)[0]) for place in places]

    def processes(self) -> dict[str, dict[str, Any]]:
        header = self.header()
        found = {}
        for index in range(header["process_capacity"]):
            at = header["processes_offset"] + header["process_slot_size"] * index
            name, kind = text(self.memory[at : at + 64]), text(self.memory[at + 64 : at + 80])
            supervised, report = self.cell(at + 128, 376), self.cell(at + 520, 560)
            phase, restarts, since = struct.unpack_from("<IIq", supervised)
            pid, activity, started, *counters = struct.unpack_from("<IIq16Q", report)
            found[name] = {
                "index": index,
                "kind": kind,
                "writer": self.unpack("<I", at + 80)[0],
                "phase": phase,
                "restarts": restarts,
                "since": since,
                "why": text(supervised[16:]),
                "heartbeat": self.unpack("<q", at + 512)[0],
                "pid": pid,
                "activity": activity,
                "started": started,
                "counters": counters,
                "problem": text(report[144:]),
            }
        found.pop("", None)
        return found

    def readers(self, source: str) -> dict[int, tuple[int, int]]:
        """Return pid and number of the last frame that each process has read, by index of its slot."""
        at, _, _ = self.section(READERS, source)
        found = {}
        for index in range(256):
            pid, _, last, _, reported = struct.unpack("<IIQqq", self.cell(at + 64 * index, 40))
            if pid and reported:
                found[index] = pid, last
        return found

    def clock(self) -> dict[str, Any]:
        at, _, _ = self.section(CLOCK, self.clock_name())
        slot_count, stepped = self.unpack("<II", at + 8)
        mode, flags, step, time, dt, done, step_size, rate, owner = struct.unpack_from(
            "<IIQQQQQdI", self.cell(at + 64, 240)
        )
        return {
            "slot_count": slot_count,
            "stepped": stepped,
            "mode": mode,
            "flags": flags,
            "step": step,
            "time": time,
            "dt": dt,
            "done": done,
            "step_size": step_size,
            "rate": rate,
            "owner": owner,
        }

    def clock_name(self) -> str:
        header = self.header()
        for index in range(header["section_count"]):
            at = header["sections_offset"] + 128 * index
            if self.unpack("<I", at) == (CLOCK,):
                return text(self.memory[at + 32 : at + 96])
        raise KeyError("there is no clock page")
