"""The backlog of changes of devices: its size in bytes is limited, and the oldest changes are dropped first."""

from __future__ import annotations

import sys

from shmio.endpoints.mqtt.sparkplug.node import Metric, Sample
from shmio.endpoints.mqtt.sparkplug.session import DeviceBacklog
from shmio.layout.model import Register

NUMBER = Metric(Register("number", "REAL", (), 0, None, 4, 1), 1)
ROW = Metric(Register("row", "REAL", ((0, 999),), 0, None, 4000, 1000), 2)
MOST_BYTES = 100_000


def test_the_size_of_arrays_counts_toward_the_bound() -> None:
    backlog = DeviceBacklog(MOST_BYTES)
    kept = []
    for at_ms in range(100):
        sample = Sample(ROW, [at_ms + element / 7 for element in range(1000)], at_ms)
        kept.append(sys.getsizeof(sample.value) + sum(map(sys.getsizeof, sample.value)))
        backlog.keep("cell", [sample])
    assert 0 < sum(kept[: backlog.count]) <= MOST_BYTES
    assert backlog.count + backlog.dropped == 100


def test_the_oldest_change_of_all_devices_is_dropped() -> None:
    backlog = DeviceBacklog(MOST_BYTES)
    for at_ms in range(1000):
        backlog.keep("first", [Sample(NUMBER, 0.5, at_ms)])
    full = backlog.count
    for at_ms in range(1000, 1000 + full // 2):
        backlog.keep("second", [Sample(NUMBER, 0.5, at_ms)])
    assert backlog.count == full
    assert backlog.take("second")[0].at_ms == 1000
    assert backlog.take("first")[0].at_ms == 1000 - full + full // 2
