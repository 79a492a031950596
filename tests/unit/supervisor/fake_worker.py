"""A worker process that misbehaves as its description says; the supervisor under test starts it."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

from shmio.segment import Activity, Report, Segment

spec = json.loads(sys.stdin.read())
config = spec["config"]
counted = Path(spec["log_file"]).with_suffix(".starts")
with counted.open("a") as file:
    file.write(f"{os.getpid()}\n")
start = len(counted.read_text().split())
behaviour = config["behaviour"][min(start, len(config["behaviour"])) - 1]

if behaviour == "crash":
    sys.exit(3)
if behaviour == "unfit":
    sys.stderr.write("no such thing here\n")
    sys.exit(2)
if behaviour == "traceback":
    raise RuntimeError("told to fail")

stopping = threading.Event()
signal.signal(signal.SIGTERM, signal.SIG_IGN if behaviour == "stubborn" else lambda *_: stopping.set())
segment = Segment.open(spec["instance"], writable=True)
assert segment.header.epoch == spec["epoch"]
slot = segment.processes.find(spec["name"])
assert slot.take()
slot.report = Report(os.getpid(), Activity.STARTING, time.monotonic_ns())
slot.beat()
if behaviour == "never":
    signal.pause()
if spec["kind"] == "source":
    writer = segment.writer(spec["name"])
    writer.publish(bytes(writer.block.layout.size), cycle=1)
slot.report = Report(os.getpid(), Activity.RUNNING, time.monotonic_ns())
if behaviour == "silent":
    signal.pause()
asked = Path(spec["log_file"]).with_name("compute")
while not stopping.wait(0.02):
    if behaviour == "compute" and asked.exists():
        until_s = time.thread_time() + float(asked.read_text())
        while time.thread_time() < until_s:
            pass
        asked.unlink()
    slot.beat()
    if spec["kind"] == "source":
        writer.publish(bytes(writer.block.layout.size), cycle=2)
if behaviour == "no end":
    signal.pause()
with Path(config["ends"]).open("a") as file:
    file.write(f"{spec['name']}\n")
