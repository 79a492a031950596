"""The figures for Prometheus: of processes, sources and registers, and of each source's timing."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path

import pytest

from shmio.config.credentials import Secret, digest
from shmio.endpoints.alerts.lifecycle import Progress
from shmio.endpoints.alerts.state_file import FILE_NAME, AlertState, State, StateWriter
from shmio.endpoints.web import metrics
from shmio.endpoints.web.measurements import BOUNDS_S, Histogram, SourceTiming
from shmio.endpoints.web.metrics import usage
from shmio.segment import EventKind, ProcessSpec, Quality, Record, Report, Segment
from shmio.segment.processes import Activity
from shmio.version import __version__
from tests.unit.endpoints.harness import image
from tests.unit.endpoints.web.harness import processes, served, spec


def test_figures_of_the_source_and_of_its_process(segment: Segment) -> None:
    slot = segment.processes.find("cell")
    slot.report = Report(os.getpid(), Activity.RUNNING, 1, (100, 3, 2, 1, 500, 50_000))
    with Segment.open(segment.instance, writable=True) as worker, served(segment) as endpoint:
        assert worker.processes.find("cell").take()
        assert endpoint.figure("shmio_source_quality", source="cell") == 0
        assert endpoint.figure("shmio_source_age_seconds", source="cell") is None
        endpoint.publish(image())
        endpoint.publish(image(), Quality.UNCERTAIN, reason="sensor")
        figures = endpoint.figures()
        labels = frozenset({("source", "cell")})
        expected = {
            "shmio_source_quality": 1, "shmio_source_frames_total": 2, "shmio_source_polls_total": 100,
            "shmio_source_overruns_total": 3, "shmio_source_failures_total": 2, "shmio_source_connects_total": 1,
        }  # fmt: skip
        assert {name: figures[name, labels] for name in expected} == expected
        assert 0 <= figures["shmio_source_age_seconds", labels] < 60
        assert figures["shmio_segment_bytes", frozenset()] == segment.shared.size
        info = frozenset({("name", segment.instance), ("mode", "live"), ("version", __version__)})
        assert figures["shmio_instance_info", info] == 1
        states = [value for (name, _), value in figures.items() if name == "shmio_instance_state"]
        assert sum(states) == 1


def test_every_counter_of_every_kind_of_process_is_reported() -> None:
    from shmio.segment.processes import COUNTERS

    shown = {kind: set(named) for kind, named in metrics._COUNTERS.items()}
    shown["source"] |= {"round_trip_us", "rate_mhz"}  # shmio_source_round_trip_seconds, shmio_source_rate_hertz
    assert shown == {kind: set(names) for kind, names in COUNTERS.items()}


def test_the_broker_counts_nothing(segment: Segment) -> None:
    segment.processes.find("mqtt").report = Report(1, Activity.RUNNING, 1, (7,))
    with served(segment) as endpoint:
        assert endpoint.figure("shmio_mqtt_messages_total") == 7


def test_clients_need_a_token_if_there_are_tokens(segment: Segment) -> None:
    secrets = (
        Secret("scraper", frozenset({"read"}), digest(b"right")),
        Secret("robot", frozenset({"write"}), digest(b"weak")),
    )
    with served(segment, secrets=secrets) as endpoint:
        for token, status in (
            (None, 401),
            ("Bearer wrong", 401),
            ("Bearer weak", 401),
            ("right", 401),
            ("Bearer right", 200),
        ):
            found, headers, text = endpoint.get(headers={} if token is None else {"Authorization": token})
            assert (found, "shmio_instance_info" in text) == (status, status == 200), token
            assert ("www-authenticate" in headers) == (status == 401), token


def test_values_of_registers_while_they_are_not_bad(segment: Segment) -> None:
    with served(segment, ["cell/axis", "cell/running", "cell/inputs", "cell/name"]) as endpoint:
        assert endpoint.figure("shmio_register", path="cell/axis/position", unit="") is None
        endpoint.publish(image(1.5, math.inf, True, b"\7\x08"))
        found = {
            dict(labels)["path"]: value
            for (name, labels), value in endpoint.figures().items()
            if name == "shmio_register"
        }
        assert found == {
            "cell/axis/position": 1.5, "cell/axis/speed": math.inf, "cell/running": 1,
            "cell/inputs/0": 7, "cell/inputs/1": 8,
        }  # fmt: skip
        endpoint.publish(image(), Quality.BAD, reason="cable out")
        assert endpoint.figure("shmio_register", path="cell/axis/position", unit="") is None


def test_the_number_of_values_is_bounded(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics, "MAX_REGISTERS", 3)
    with served(segment, ["**"]) as endpoint:
        endpoint.publish(image())
        assert sum(name == "shmio_register" for name, _ in endpoint.figures()) == 3


def test_free_space(segment: Segment, tmp_path: Path) -> None:
    with served(segment, folders={"logs": str(tmp_path), "recordings": str(tmp_path / "gone")}) as endpoint:
        free = endpoint.figure("shmio_disk_free_bytes", folder="logs")
        size = endpoint.figure("shmio_disk_size_bytes", folder="logs")
        assert free is not None
        assert size is not None
        assert 0 < free <= size
        assert endpoint.figure("shmio_disk_free_bytes", folder="recordings") is None


def test_alerts(instance: str, tmp_path: Path) -> None:
    alerts = {
        name: AlertState("", severity, "", "", Progress(active=active))
        for name, severity, active in (("hot", "critical", True), ("cold", "info", False))
    }
    with Segment.create(instance, [spec()], [*processes(), ProcessSpec("alerts", "alerts")]) as segment:
        writer = StateWriter(tmp_path / FILE_NAME)
        writer.write(State(segment.header.epoch, alerts))
        writer.close(30)
        with served(segment, folders={"logs": str(tmp_path)}) as endpoint:
            assert endpoint.figure("shmio_alert_active", alert="hot", severity="critical") == 1
            assert endpoint.figure("shmio_alert_active", alert="cold", severity="info") == 0
        segment.unlink()


def test_use_of_a_process() -> None:
    before = usage(os.getpid())
    assert before is not None
    assert before.memory_bytes > 1 << 20
    with open("/dev/null") as extra:  # noqa: PTH123
        during = usage(os.getpid())
        assert during is not None
        assert before.descriptors is not None
        assert during.descriptors == before.descriptors + 1
        assert not extra.closed
    assert usage(2**22 + 1) is None


def test_a_histogram_counts_each_duration_in_its_bucket() -> None:
    histogram = Histogram()
    for duration_ns in (-5, 100_000, 100_001, 20_000_000, 60_000_000_000):
        histogram.add(duration_ns)
    buckets = dict(histogram.buckets)
    assert list(buckets) == [*(f"{bound:g}" for bound in BOUNDS_S), "+Inf"]
    assert (buckets["0.0001"], buckets["0.0002"], buckets["0.02"], buckets["10"], buckets["+Inf"]) == (2, 3, 4, 4, 5)
    assert histogram.sum_s == pytest.approx(60.020200001)


def counts(histogram: Histogram) -> int:
    return int(histogram.buckets[-1][1])


def test_timing_is_that_of_cycles(segment: Segment) -> None:
    """A gap between cycles is not a period. An image that is published again is not a cycle."""
    writer, block = segment.writer("cell"), segment.blocks["cell"]
    timing = SourceTiming(block, segment.header.started_ns)
    for cycle in (1, 2, 2, 3, 7, 8):
        writer.publish(image(), cycle=cycle, asked_ns=time.monotonic_ns() - 150_000_000)
    timing.follow()
    assert (counts(timing.period), counts(timing.lateness), counts(timing.round_trip)) == (3, 5, 5)
    assert dict(timing.round_trip.buckets)["0.1"] == 0
    assert timing.round_trip.sum_s >= 5 * 0.15
    due_ns = segment.header.started_ns + 8 * block.period_ns
    frame = block.latest()
    assert frame is not None
    lateness_s = max(0, frame.publish_ns - due_ns) / 1e9
    assert lateness_s <= timing.lateness.sum_s


def test_time_of_commands(segment: Segment) -> None:
    """The time is from acceptance to the first outcome. A command accepted earlier does not count."""
    writer, block = segment.writer("cell"), segment.blocks["cell"]
    timing = SourceTiming(block, segment.header.started_ns)
    for kind, command in (
        (EventKind.WRITTEN, 1), (EventKind.ACCEPTED, 2), (EventKind.ACCEPTED, 3), (EventKind.REFUSED, 2),
        (EventKind.WRITTEN, 2), (EventKind.WRITTEN, 3),
    ):  # fmt: skip
        writer.event(Record(kind, writer=4, command=command))
    timing.follow()
    assert counts(timing.command) == 2


def test_commands_that_never_end_are_forgotten(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.web.measurements.MAX_COMMANDS", 2)
    writer = segment.writer("cell")
    timing = SourceTiming(segment.blocks["cell"], segment.header.started_ns)
    for command in (1, 2, 3):
        writer.event(Record(EventKind.ACCEPTED, writer=4, command=command))
    for command in (1, 2, 3):
        writer.event(Record(EventKind.WRITTEN, writer=4, command=command))
    timing.follow()
    assert counts(timing.command) == 2


def test_steps_are_never_late(instance: str) -> None:
    with Segment.create(instance, [spec(stepped=True)], processes()) as segment:
        timing = SourceTiming(segment.blocks["cell"], segment.header.started_ns)
        writer = segment.writer("cell")
        for cycle in (1, 2):
            writer.publish(image(), cycle=cycle)
        timing.follow()
        assert counts(timing.lateness) == counts(timing.period) == 0
        segment.unlink()


def test_measurements_follow_all_sources(segment: Segment, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shmio.endpoints.web.measurements.INTERVAL_S", 0.001)
    with served(segment) as endpoint:
        endpoint.measurements.start()
        name = "shmio_source_lateness_seconds_count"
        while not endpoint.figure(name, source="cell"):
            endpoint.publish(image())
        endpoint.measurements.stop()
        assert endpoint.figure("shmio_source_period_seconds_bucket", source="cell", le="+Inf") is not None
