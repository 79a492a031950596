"""MQTT subscribers of all sources at the instance's broker. They connect again when they lose the broker."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from paho.mqtt.client import Client, MQTTMessage, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion, MQTTErrorCode

from shmio.config import Address
from tests.faults.checker import Checker
from tests.faults.checks import Source, ValueCheck
from tests.faults.remote import UNDER_WAY_NS

PAUSE_S = 0.1
TURN_S = 0.2
KEEPALIVE_S = 5
"""Time after which a client disconnects from a frozen broker."""


def late(message: MQTTMessage) -> bool:
    """Return whether the bridge kept a message while the broker was absent. Only such messages carry a time."""
    given: list[tuple[str, str]] = getattr(message.properties, "UserProperty", [])
    return any(name == "source_time" for name, _ in given)


def subscribe(checker: Checker, source: Source) -> None:
    """Check the values of the block's first word."""
    check = ValueCheck(source, checker.complain, checker.counts(f"mqtt {source.name}"))
    address = Address.parse(checker.description.mqtt)

    def ask(client: Client, *_: object) -> None:
        client.subscribe(f"shmio/{checker.description.instance}/{source.name}/stamp/out")

    def take(_client: Client, _data: Any, message: MQTTMessage) -> None:
        if message.payload and not late(message):  # otherwise the value is bad or old
            check.value(int(message.payload), time.monotonic_ns(), slack_ns=checker.slack_ns + UNDER_WAY_NS)

    while not checker.stopping.wait(PAUSE_S):
        client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5, reconnect_on_failure=False)
        client.on_connect, client.on_message = ask, take
        try:
            client.connect(address.host, address.port, KEEPALIVE_S)
            while not checker.stopping.is_set() and client.loop(TURN_S) == MQTTErrorCode.MQTT_ERR_SUCCESS:
                pass
            client.disconnect()
        except OSError:
            continue  # the broker is not running


def main() -> None:
    checker = Checker()
    for source in checker.sources:
        checker.work(partial(subscribe, checker, source))
    checker.run()


if __name__ == "__main__":
    main()
