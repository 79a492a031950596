"""The process of our own broker: mosquitto where it is on the machine, else one in Python."""

from __future__ import annotations

import asyncio
import logging

import msgspec

from shmio.config import Mqtt
from shmio.endpoints.mqtt.broker import mosquitto
from shmio.endpoints.mqtt.broker.directory import folder, prepare, remove
from shmio.errors import ConfigError
from shmio.worker import BEAT_S, Worker

log = logging.getLogger("shmio.mqtt")


def run(worker: Worker) -> None:
    """Serve until told to stop."""
    settings = msgspec.convert(worker.config, Mqtt)
    program = mosquitto.find()
    if program is None and settings.broker == "mosquitto":
        raise ConfigError(mosquitto.NONE)
    place = folder(worker.segment)
    prepare(place)
    try:
        if program is not None:
            _run(worker, mosquitto.Mosquitto(program, settings, worker.segment.instance, place), settings)
        else:
            log.info("no mosquitto on this machine: aMQTT on %s", settings.listen)
            from shmio.endpoints.mqtt.broker import amqtt  # noqa: PLC0415  a large library, for those who need it

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
