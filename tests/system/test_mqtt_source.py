"""A whole instance that reads a device at its own broker and another source. The broker is killed and comes back."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from typing import Any

import pytest

import shmio
from shmio.model.values import Quality, Reading
from shmio.testing.cell import Cell, kill, until
from shmio.testing.mosquitto import missing
from shmio.testing.ports import reserved_port
from tests.unit.connectors.mqtt.peer import Peer

CONFIG = """
[instance]
name = "{instance}"
[[source]]
name = "lamp"
connector = "mqtt"
layout = "lamp.csv"
period_ms = 20
url = "mqtt://BROKER"
timeout = 1000
will = "plant/lamp/there"
max_age_ms.lamp = 0
[[source]]
name = "other"
connector = "memory"
layout = "other.toml"
[mqtt]
listen = "BROKER"
broker = "mosquitto"
[[mqtt.account]]
roles = ["read", "write"]
publish = ["plant/#"]
"""
LAMP = """path;type;address;writable
lamp/On;BOOL;plant/lamp/state $.on -> plant/lamp/set $.on;true
lamp/Power;REAL;plant/lamp/state $.power;false
lamp/Gone;INT;plant/lamp/state $.gone;false
"""


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_a_device_at_the_broker_of_the_instance(make_cell: Callable[..., Cell]) -> None:
    with reserved_port() as broker, Peer() as device:
        cell = make_cell(config=CONFIG.replace("BROKER", str(broker)))
        (cell.folder / "lamp.csv").write_text(LAMP)
        (cell.folder / "other.toml").write_text('[registers]\n"n" = "INT"\n')
        cell.up()

        def quality(name: str) -> Any:
            return cell.processes()[name]["quality"]

        def publish(topic: str, payload: str) -> None:
            command = ["mosquitto_pub", "-h", broker.host, "-p", str(broker.port), "-q", "1", "-r", "-t", topic]
            subprocess.run([*command, "-m", payload], check=True, timeout=20)

        until(lambda: quality("lamp") == "good", "good quality")
        with shmio.attach(cell.instance) as programs:

            def lamp(name: str) -> Reading:
                return programs.read(f"lamp/lamp/{name}")

            assert "BadWaitingForInitialData" in lamp("On").reason
            publish("plant/lamp/state", '{"on": true, "power": 12.5}')
            publish("plant/lamp/there", "online")
            until(lambda: lamp("On").quality is Quality.GOOD, "a good register")
            assert (lamp("On").value, lamp("Power").value) == (True, 12.5)
            assert "BadNotFound" in lamp("Gone").reason
            device.ask("connect", broker.port)
            device.ask("subscribe", "plant/lamp/set")
            cell.output("shmio", "set", "lamp/lamp/On", "false")
            assert device.ask("next", "plant/lamp/set")["payload"] == '{"on":false}'
            assert "not writable" in cell.run("shmio", "set", "lamp/lamp/Power", "1").stderr
            publish("plant/lamp/there", "offline")
            until(lambda: "BadNoCommunication" in lamp("On").reason, "a device that is gone")
            assert "is offline" in cell.run("shmio", "set", "lamp/lamp/On", "true").stderr

            kill(cell.processes()["broker"]["pid"])
            until(lambda: quality("lamp") == "bad", "bad quality")
            until(lambda: quality("lamp") == "good", "good quality with the next broker")
            publish("plant/lamp/there", "online")
            publish("plant/lamp/state", '{"on": false, "power": 0}')
            until(lambda: lamp("On").quality is Quality.GOOD, "a good register")
            assert lamp("On").value is False
        assert {name: cell.processes()[name]["restarts"] for name in ("lamp", "other")} == {"lamp": 0, "other": 0}
        assert quality("other") == "good"
