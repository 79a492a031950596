"""The metrics of an instance, in the text format of Prometheus.

Names, units and types follow https://prometheus.io/docs/practices/naming. All values come from the
segment, from ``/proc``, and from :mod:`shmio.endpoints.web.measurements`. They cause no work in
other processes.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector

from shmio.endpoints.alerts.state_file import alert_states
from shmio.endpoints.web.measurements import Histogram, Measurements
from shmio.errors import SegmentError
from shmio.layout.glob import Glob
from shmio.layout.model import NUMBERS, Register
from shmio.layout.values.codec import Value
from shmio.local.reading import reading
from shmio.local.status import ProcessStatus, SourceStatus, complaint, status_of
from shmio.model.values import Quality
from shmio.segment import Block, Segment
from shmio.segment.header import State
from shmio.segment.processes import Phase
from shmio.version import __version__

MAX_REGISTERS: Final = 10_000
"""Maximum number of registers whose values an answer contains."""
FRESH_S: Final = 0.25
"""Time in s for which an answer is reused, so that many scrapers cost no more than one."""


class _Named(NamedTuple):
    """A metric that is made from a worker's counter."""

    name: str
    text: str
    gauge: bool = False


_COUNTERS: Final[Mapping[str, Mapping[str, _Named]]] = {
    "source": {
        "polls": _Named("shmio_source_polls", "Cycles in which the device was asked."),
        "overruns": _Named("shmio_source_overruns", "Cycles that were skipped, because an earlier one took too long."),
        "failures": _Named("shmio_source_failures", "Failures of connecting, reading or writing."),
        "connects": _Named("shmio_source_connects", "Connections that were made to the device."),
    },
    "emulator": {
        "cycles": _Named("shmio_emulator_cycles", "Cycles of the emulated controller."),
        "overruns": _Named("shmio_emulator_overruns", "Cycles of the emulated controller that were skipped."),
    },
    "grpc": {
        "streams": _Named("shmio_grpc_streams", "Streams that are open.", gauge=True),
        "messages": _Named("shmio_grpc_messages", "Messages that were sent on streams."),
        "dropped": _Named("shmio_grpc_dropped", "Changes and events that slow clients missed."),
        "published": _Named("shmio_grpc_published", "Values that clients wrote or injected."),
        "refused": _Named("shmio_grpc_refused", "Calls that were refused."),
        "bytes": _Named("shmio_grpc_sent_bytes", "Bytes of the messages that were sent to clients."),
        "waiting_bytes": _Named("shmio_grpc_waiting_bytes", "Bytes of the messages that wait for clients.", gauge=True),
    },
    "mqtt": {
        "messages": _Named("shmio_mqtt_messages", "Messages that were published."),
        "commands": _Named("shmio_mqtt_commands", "Commands that came from the broker."),
        "refused": _Named("shmio_mqtt_refused", "Commands that were refused."),
        "waiting": _Named("shmio_mqtt_waiting_topics", "Changed topics that wait to be published.", gauge=True),
        "backlog": _Named("shmio_mqtt_backlog_messages", "Messages kept for a broker that is away.", gauge=True),
        "dropped": _Named("shmio_mqtt_dropped", "Changes that the full backlog dropped."),
        "connects": _Named("shmio_mqtt_connects", "Connections that were made to the broker."),
        "missed": _Named("shmio_mqtt_missed_frames", "Frames that the bridge was too slow to read."),
        "bytes": _Named("shmio_mqtt_sent_bytes", "Bytes of the topics and payloads of published messages."),
    },
    "fabric": {
        "messages": _Named("shmio_fabric_messages", "Messages that were published."),
        "late": _Named("shmio_fabric_late_messages", "Messages that were published late."),
        "backlog": _Named("shmio_fabric_backlog_messages", "Messages that wait to be published.", gauge=True),
        "dropped": _Named("shmio_fabric_dropped_messages", "Messages that the full backlog dropped."),
        "missed": _Named("shmio_fabric_missed", "Frames and events that the uplink was too slow to read."),
        "commands": _Named("shmio_fabric_commands", "Commands that came from other cells."),
        "refused": _Named("shmio_fabric_refused", "Commands that were refused."),
        "connects": _Named("shmio_fabric_connects", "Connections that were made to a server."),
        "bytes": _Named("shmio_fabric_sent_bytes", "Bytes of the messages that were published."),
    },
    "opcua": {
        "sessions": _Named("shmio_opcua_sessions", "Sessions that are open.", gauge=True),
        "items": _Named("shmio_opcua_monitored_items", "Monitored items.", gauge=True),
        "writes": _Named("shmio_opcua_writes", "Values that clients wrote."),
        "refused": _Named("shmio_opcua_refused", "Writes and calls that were refused."),
        "bytes": _Named("shmio_opcua_sent_bytes", "Bytes that were written to the connections of clients."),
        "messages": _Named("shmio_opcua_messages", "Messages that were written to the connections of clients."),
    },
    "recorder": {
        "frames": _Named("shmio_recorder_frames", "Frames that were recorded."),
        "events": _Named("shmio_recorder_events", "Events that were recorded."),
        "missed": _Named("shmio_recorder_missed", "Frames and events that the recorder was too slow to read."),
        "bytes": _Named("shmio_recorder_written_bytes", "Bytes that were written to recordings."),
    },
    "web": {
        "requests": _Named("shmio_web_requests", "Requests that were answered."),
        "refused": _Named("shmio_web_refused", "Requests and connections that were refused."),
        "connections": _Named("shmio_web_connections", "Connections that are open.", gauge=True),
        "pages": _Named("shmio_web_pages", "Pages that are open.", gauge=True),
        "messages": _Named("shmio_web_messages", "Messages that were sent to pages."),
        "bytes": _Named("shmio_web_sent_bytes", "Bytes of the messages that were sent to pages."),
        "answer_bytes": _Named("shmio_web_answer_bytes", "Bytes of the answers to requests, without headers."),
    },
    "alerts": {
        "active": _Named("shmio_alerts_active", "Alerts that are active.", gauge=True),
        "notices": _Named("shmio_alerts_notices", "Notices of alerts that were made."),
        "suppressed": _Named("shmio_alerts_suppressed", "Activations of alerts that no notice reported in time."),
        "waiting": _Named("shmio_alerts_waiting_notices", "Notices that are not delivered yet.", gauge=True),
        "failed": _Named("shmio_alerts_failed_notices", "Notices that were lost, because an action failed."),
        "missed": _Named("shmio_alerts_missed_frames", "Frames that were not evaluated, because they came too fast."),
    },
}
_LABELS: Final[Mapping[str, str]] = {"source": "source", "emulator": "emulator", "web": "process"}
"""For each kind of which an instance can have several processes, the label that holds the process's name."""
BROKER: Final = "broker"
"""Process name of the instance's own MQTT broker. Its kind is that of the bridge, but it has no counters."""
_TICKS: Final = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES: Final = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Usage:
    """The resources that a process uses, from ``/proc``."""

    cpu_s: float
    memory_bytes: int
    threads: int
    descriptors: int | None
    """Number of open file descriptors; None if this user may not see it."""


def usage(pid: int) -> Usage | None:
    """Return the resources that a process uses, from proc(5); None if the process has ended."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return None
    fields = stat.rpartition(")")[2].split()  # the name before it may contain anything
    try:
        descriptors = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    except OSError:
        descriptors = None
    cpu_s = (int(fields[11]) + int(fields[12])) / _TICKS
    return Usage(cpu_s, int(fields[21]) * _PAGE_BYTES, int(fields[17]), descriptors)


class InstanceCollector(Collector):
    """Collects the metrics of an instance."""

    def __init__(
        self,
        segment: Segment,
        measurements: Measurements,
        folders: Mapping[str, str],
        registers: Sequence[str] = (),
    ) -> None:
        """Create the collector.

        Args:
            segment: The instance's segment.
            measurements: Histograms of the sources' timing.
            folders: Directories whose free space is reported, by purpose.
            registers: Patterns of the registers whose values are reported.

        """
        self._segment = segment
        self._measurements = measurements
        self._folders = folders
        self._globs = [Glob(pattern) for pattern in registers]
        self._chosen: dict[int, list[Register]] = {}
        """The reported registers of each block, by its section."""

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics."""
        self._segment.refresh()
        status = status_of(self._segment, "", "web")
        yield _info(self._segment.instance, status.mode or "", __version__)
        states = GaugeMetricFamily("shmio_instance_state", "1 for the state of the instance.", labels=["state"])
        for state in State:
            states.add_metric([str(state)], float(str(state) == status.state))
        yield states
        yield GaugeMetricFamily("shmio_segment_bytes", "Size of the shared memory.", value=status.segment_bytes)
        clock = self._segment.clock.read()
        yield GaugeMetricFamily("shmio_clock_virtual", "1 in virtual time.", value=clock.virtual)
        yield GaugeMetricFamily(
            "shmio_clock_time_seconds", "Time of the instance's clock since its start.", value=clock.present_ns / 1e9
        )
        yield CounterMetricFamily("shmio_clock_steps", "Steps of virtual time that are done.", value=clock.done)
        yield from self._processes(status.processes)
        sources = [one for one in status.processes if isinstance(one, SourceStatus)]
        yield from _sources(sources)
        yield from _readers(sources)
        yield from self._frames()
        yield from self._timing()
        yield from self._disks()
        yield self._alerts()
        if self._globs:
            yield self._registers()

    def _processes(self, processes: Iterable[ProcessStatus]) -> Iterator[Metric]:
        labels = ["process", "kind"]
        running = GaugeMetricFamily("shmio_process_running", "1 if the process runs.", labels=labels)
        problem = GaugeMetricFamily("shmio_process_problem", "1 if the process reports a problem.", labels=labels)
        restarts = CounterMetricFamily("shmio_process_restarts", "Restarts after a failure.", labels=labels)
        uptime = GaugeMetricFamily("shmio_process_uptime_seconds", "Time since the start.", labels=labels)
        cpu = CounterMetricFamily("shmio_process_cpu_seconds", "CPU time, user and system.", labels=labels)
        memory = GaugeMetricFamily("shmio_process_resident_memory_bytes", "Memory in use.", labels=labels)
        threads = GaugeMetricFamily("shmio_process_threads", "Threads.", labels=labels)
        descriptors = GaugeMetricFamily("shmio_process_open_fds", "Open file descriptors.", labels=labels)
        counted: dict[str, CounterMetricFamily | GaugeMetricFamily] = {}
        for slot in self._segment.processes:
            if slot.name == BROKER:
                continue
            label = _LABELS.get(slot.kind)
            for counter, named in _COUNTERS.get(slot.kind, {}).items():
                found = counted.get(named.name)
                if found is None:
                    kind = GaugeMetricFamily if named.gauge else CounterMetricFamily
                    found = counted[named.name] = kind(named.name, named.text, labels=[label] if label else [])
                found.add_metric([slot.name] if label else [], slot.counters.get(counter, 0))
        for one in processes:
            values = [one.name, one.kind]
            running.add_metric(values, float(one.state == str(Phase.RUNNING)))
            problem.add_metric(values, float(bool(complaint(one.kind, one.note))))
            restarts.add_metric(values, one.restarts)
            uptime.add_metric(values, one.uptime_s)
            used = usage(one.pid) if one.pid is not None else None
            if used is not None:
                cpu.add_metric(values, used.cpu_s)
                memory.add_metric(values, used.memory_bytes)
                threads.add_metric(values, used.threads)
                if used.descriptors is not None:
                    descriptors.add_metric(values, used.descriptors)
        yield from (running, problem, restarts, uptime, cpu, memory, threads, descriptors)
        yield from counted.values()

    def _frames(self) -> Iterator[Metric]:
        frames = CounterMetricFamily("shmio_source_frames", "Frames that were published.", labels=["source"])
        events = CounterMetricFamily("shmio_source_events", "Events that were published.", labels=["source"])
        age = GaugeMetricFamily(
            "shmio_source_age_seconds", "Age of the newest frame by the source's clock.", labels=["source"]
        )
        for name, block in self._segment.blocks.items():
            frames.add_metric([name], block.ring.head())
            events.add_metric([name], block.events.head())
            try:
                frame = block.latest()
            except SegmentError:
                continue
            if frame is not None:
                age.add_metric([name], max(0, frame.age_ns(block.now_ns())) / 1e9)
        yield from (frames, events, age)

    def _timing(self) -> Iterator[Metric]:
        families = {
            "period": _histogram("shmio_source_period_seconds", "Time from one cycle's frame to the next cycle's."),
            "lateness": _histogram(
                "shmio_source_lateness_seconds", "Time from when a cycle was due to the publication of its frame."
            ),
            "round_trip": _histogram("shmio_source_round_trip_seconds", "Time that the device took to answer."),
            "wake_up": _histogram(
                "shmio_source_wakeup_seconds",
                "Time from the publication of a frame until a process that waited for it ran; a sample.",
            ),
            "command": _histogram(
                "shmio_source_command_seconds", "Time from the acceptance of a command until its outcome was known."
            ),
        }
        for timing in self._measurements:
            for name, family in families.items():
                histogram: Histogram = getattr(timing, name)
                family.add_metric([timing.block.source], histogram.buckets, histogram.sum_s)
        yield from families.values()

    def _disks(self) -> Iterator[Metric]:
        free = GaugeMetricFamily("shmio_disk_free_bytes", "Free space of the folder's disk.", labels=["folder"])
        size = GaugeMetricFamily("shmio_disk_size_bytes", "Size of the folder's disk.", labels=["folder"])
        for purpose, folder in self._folders.items():
            try:
                found = os.statvfs(folder)
            except OSError:
                continue
            free.add_metric([purpose], found.f_bavail * found.f_frsize)
            size.add_metric([purpose], found.f_blocks * found.f_frsize)
        yield from (free, size)

    def _alerts(self) -> Metric:
        family = GaugeMetricFamily("shmio_alert_active", "1 if the alert is active.", labels=["alert", "severity"])
        for name, alert in alert_states(self._folders, self._segment).items():
            family.add_metric([name, alert.severity], alert.progress.active)
        return family

    def _registers(self) -> Metric:
        family = GaugeMetricFamily(
            "shmio_register", "Value of a register, while it is not bad.", labels=["path", "unit"]
        )
        for path, unit, value in self._values():
            family.add_metric([path, unit], value)
        return family

    def _values(self) -> Iterator[tuple[str, str, float]]:
        blocks = {block.section: block for block in self._segment.blocks.values()}
        self._chosen = {section: self._chosen.get(section) or self._choose(block) for section, block in blocks.items()}
        count = 0
        for section, block in blocks.items():
            try:
                frame = block.latest()
            except SegmentError:
                continue
            for register in self._chosen[section]:
                found = reading(block, register, frame)
                if found.quality is Quality.BAD:
                    continue
                for path, value in _numbers(f"{block.source}/{register.path}", register.dims, found.value):
                    count += 1
                    if count > MAX_REGISTERS:
                        return
                    yield path, register.unit, value

    def _choose(self, block: Block) -> list[Register]:
        """Return the block's numeric and BOOL registers that match the patterns."""
        return [
            register
            for register in block.layout.registers
            if (register.type == "BOOL" or register.type in NUMBERS)
            and any(glob.matches(f"{block.source}/{register.path}") for glob in self._globs)
        ]


class Exposition:
    """Answers requests for the metrics. Several threads may use it at the same time."""

    def __init__(self, collector: Collector) -> None:
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(collector)
        self._lock = threading.Lock()
        self._answer = b""
        self._fresh_until_s = 0.0

    def answer(self) -> bytes:
        """Return all metrics in the text format. They are at most ``FRESH_S`` old."""
        with self._lock:
            if time.monotonic() >= self._fresh_until_s:
                self._answer = generate_latest(self._registry)
                self._fresh_until_s = time.monotonic() + FRESH_S
            return self._answer


def _info(instance: str, mode: str, version: str) -> Metric:
    family = GaugeMetricFamily(
        "shmio_instance_info", "1; the labels name the instance.", labels=["name", "mode", "version"]
    )
    family.add_metric([instance, mode, version], 1)
    return family


def _histogram(name: str, text: str) -> HistogramMetricFamily:
    return HistogramMetricFamily(name, text, labels=["source"])


def _sources(sources: Sequence[SourceStatus]) -> Iterator[Metric]:
    quality = GaugeMetricFamily(
        "shmio_source_quality", "Quality of the source: 0 bad, 1 uncertain, 2 good.", labels=["source"]
    )
    rate = GaugeMetricFamily("shmio_source_rate_hertz", "Frames per second.", labels=["source"])
    for one in sources:
        quality.add_metric([one.name], Quality[one.quality.upper()])
        rate.add_metric([one.name], one.rate_hz)
    yield from (quality, rate)


def _readers(sources: Sequence[SourceStatus]) -> Iterator[Metric]:
    labels = ["source", "process"]
    behind = "by the slowest reader of this process."
    frames = GaugeMetricFamily("shmio_reader_lag_frames", f"Frames of the source not yet read {behind}", labels=labels)
    lag = GaugeMetricFamily("shmio_reader_lag_seconds", f"Age of the oldest frame not yet read {behind}", labels=labels)
    for one in sources:
        for reader in one.readers:
            frames.add_metric([one.name, reader.process], reader.frames)
            lag.add_metric([one.name, reader.process], reader.lag_s)
    yield from (frames, lag)


def _numbers(path: str, dims: Sequence[tuple[int, int]], value: Value) -> Iterator[tuple[str, float]]:
    """Yield path and value of a register, or of each element of an array."""
    if dims and isinstance(value, list):
        for index, element in enumerate(value, dims[0][0]):
            yield from _numbers(f"{path}/{index}", dims[1:], element)
    elif isinstance(value, (bool, int, float)):
        yield path, float(value)
