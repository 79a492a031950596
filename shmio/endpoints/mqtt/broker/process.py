"""The process of our own broker: mosquitto if it is installed, else aMQTT."""

from __future__ import annotations

import asyncio
import logging

import msgspec

from shmio.config import Mqtt
from shmio.endpoints.mqtt.broker import mosquitto
from shmio.endpoints.mqtt.broker.directory import folder, prepare, remove
from shmio.endpoints.mqtt.broker.program import choose_broker
from shmio.worker import BEAT_S, Worker

log = logging.getLogger("shmio.mqtt")


def run(worker: Worker) -> None:
    """Run the broker until the worker is stopped."""
    settings = msgspec.convert(worker.config, Mqtt)
    program = choose_broker(settings)
    place = folder(worker.segment)
    prepare(place)
    try:
        if program is not None:
            _run(worker, mosquitto.Mosquitto(program, settings, worker.segment.instance, place), settings)
        else:
            log.warning(
                "mosquitto is not installed: aMQTT on %s, for development only: every program on this host may publish "
                "everything, even values",
                settings.listen,
            )
            from shmio.endpoints.mqtt.broker import amqtt  # noqa: PLC0415  of the extra, and large

            asyncio.run(amqtt.serve(worker, settings, place))
    finally:
        remove(place)


def _run(worker: Worker, broker: mosquitto.Mosquitto, settings: Mqtt) -> None:
    try:
        broker.await_start(worker.report)
        log.info("mosquitto on %s", settings.listen)
        worker.running()
        while not worker.stopping.wait(BEAT_S):
            broker.check()
            worker.report()
    finally:
        broker.stop()
