"""The two processes of the MQTT endpoint: the bridge, and the instance's own broker."""

from __future__ import annotations

import logging
import time

import msgspec

from shmio import worker
from shmio.config import Mqtt
from shmio.endpoints.mqtt.broker.directory import folder, prepare, remove
from shmio.endpoints.mqtt.broker.mosquitto import Mosquitto
from shmio.endpoints.mqtt.broker.program import choose_broker
from shmio.endpoints.server_process import serve
from shmio.libraries import check_paho
from shmio.logs import rate_limited
from shmio.worker import BEAT_S, Worker

BROKER = "broker"
"""Name of the process that runs the instance's own broker."""

log = logging.getLogger("shmio.mqtt")


def run(worker: Worker) -> None:
    """Run the bridge or the broker, depending on the worker's name, until the worker is stopped."""
    with rate_limited(log.name):
        if worker.name == BROKER:
            run_broker(worker)
        else:
            _run_bridge(worker)


def _run_bridge(worker: Worker) -> None:
    from shmio.endpoints.mqtt.bridge import Bridge  # noqa: PLC0415  the broker's process does not need it
    from shmio.endpoints.mqtt.connection.broker_client import PRIVATE_NAMES  # noqa: PLC0415

    check_paho(PRIVATE_NAMES)
    bridge = Bridge(worker.segment, worker.slot, msgspec.convert(worker.config, Mqtt))
    worker.on_stop(bridge.wake)
    worker.running()
    reported_s = 0.0
    while not worker.stopping.is_set():
        bridge.run_once()
        if time.monotonic() - reported_s >= BEAT_S:
            reported_s = time.monotonic()
            worker.report(bridge.counters, note=bridge.problem)
            worker.report_readers(bridge.readers)
    bridge.close()
    worker.report(bridge.counters, note="")
    log.info("the bridge has stopped; it sent %d messages to the broker", bridge.outbox.sent)


def run_broker(worker: Worker) -> None:
    """Run the instance's own broker until the worker is stopped.

    The broker is mosquitto if it is installed, otherwise aMQTT.
    """
    settings = msgspec.convert(worker.config, Mqtt)
    program = choose_broker(settings)
    place = folder(worker.segment)
    prepare(place)
    try:
        if program is not None:
            broker = Mosquitto(program, settings, worker.segment.instance, place)
            serve(worker, broker, f"mosquitto serves MQTT on {settings.listen}")
        else:
            log.warning(
                "mosquitto is not installed, so aMQTT runs on %s, for development only: every program on this host "
                "may publish everything, even values",
                settings.listen,
            )
            import asyncio  # noqa: PLC0415  mosquitto does not need it

            from shmio.endpoints.mqtt.broker import amqtt  # noqa: PLC0415  this import needs the extra, and is large

            asyncio.run(amqtt.serve(worker, settings, place))
    finally:
        remove(place)


if __name__ == "__main__":
    raise SystemExit(worker.main(run))
