"""The two processes of the MQTT endpoint: the bridge, and our own broker."""

from __future__ import annotations

import logging
import time

import msgspec

from shmio import worker
from shmio.config import Mqtt
from shmio.endpoints.mqtt.bridge import Bridge
from shmio.endpoints.mqtt.broker import process
from shmio.log_rate_limit import LogRateLimit
from shmio.worker import BEAT_S, Worker

BROKER = "broker"
"""The name of our own broker's process."""


def run(worker: Worker) -> None:
    """Run the process that the worker's name selects until the worker is stopped."""
    log, ration = logging.getLogger("shmio.mqtt"), LogRateLimit()
    log.addFilter(ration)
    try:
        if worker.name == BROKER:
            process.run(worker)
        else:
            _bridge(worker)
    finally:
        log.removeFilter(ration)


def _bridge(worker: Worker) -> None:
    bridge = Bridge(worker.segment, worker.slot, msgspec.convert(worker.config, Mqtt))
    worker.on_stop(bridge.wake)
    worker.running()
    told_s = 0.0
    while not worker.stopping.is_set():
        bridge.turn()
        if time.monotonic() - told_s >= BEAT_S:
            told_s = time.monotonic()
            worker.report(bridge.counters, note=bridge.problem)
    bridge.close()
    worker.report(bridge.counters, note="")
    logging.getLogger("shmio.mqtt").info("%d messages", bridge.outbox.sent)


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
