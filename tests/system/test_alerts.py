"""A cell whose alerts run a command, publish at a real broker, and post to a real HTTP server."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from shmio.testing.cell import CONFIG, Cell, kill, until
from shmio.testing.mosquitto import missing
from shmio.testing.ports import reserved_port
from tests.unit.endpoints.alerts.test_webhook import serving
from tests.unit.endpoints.mqtt.harness import listening

WRITABLE = CONFIG.replace('connector = "s7"\n', 'connector = "s7"\nwritable = ["Outputs"]\n')
COMMAND = "import sys; print(sys.stdin.read(), file=open(sys.argv[1], 'a'))"
BROKER = '[mqtt]\nlisten = "{broker}"\nbroker = "mosquitto"\n'
ALERTS = """
[[alert]]
name = "pause"
when = "cell/Outputs/13.%X0"
every_s = 0.1
resolved = true
severity = "critical"
text = "The cell pauses"
command = ["{python}", "-c", "{program}", "{folder}/told"]
mqtt_topic = "shmio/alerts/pause"
mqtt_retain = true
webhook = "http://127.0.0.1:{hook}/pause"

[[alert]]
name = "died"
process = "plc"
mqtt_topic = "plant/died"

[[alert]]
name = "lost"
source = "cell"
resolved = true
mqtt_topic = "plant/lost"
"""


def lines(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def states(notices: list[dict[str, Any]]) -> list[str]:
    return [notice["state"] for notice in notices]


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_alerts_reach_a_command_a_broker_and_a_server(make_cell: Callable[..., Cell], tmp_path: Path) -> None:
    with reserved_port() as broker, serving() as server:
        sections = (BROKER + ALERTS).format(
            python=sys.executable, program=COMMAND, folder=tmp_path, hook=server.port, broker=broker
        )
        cell = make_cell(config=WRITABLE + sections.replace("{", "{{").replace("}", "}}"))
        assert "alert pause: cell/Outputs/13.%X0: command" in cell.output("shmio-supervisor", "check")
        cell.up()
        cell.output("shmio", "set", "Outputs/13", "1")
        with (
            listening(broker, "plant/#", protocol=4) as plant,
            listening(broker, "shmio/alerts/#", protocol=4) as first,
        ):
            told = json.loads(first.message().payload)
            assert (told["alert"], told["state"], told["text"]) == ("pause", "active", "The cell pauses")
            assert told["values"] == {"cell/Outputs/13.%X0": True}
            until(lambda: len(lines(tmp_path / "told")) == len(server.requests) == 1, "the command and the webhook")
            assert lines(tmp_path / "told")[0] == json.loads(server.requests[0][2]) == told
            until(lambda: cell.processes()["alerts"]["note"] == "active: pause", "the note of the process")
            assert cell.status()["state"] == "running"

            kill(cell.processes()["alerts"]["pid"])
            until(lambda: cell.processes()["alerts"]["restarts"] == 1, "the restart of the alerts")
            until(lambda: cell.processes()["alerts"]["note"] == "active: pause", "its state after the restart")
            cell.output("shmio", "set", "Outputs/13", "0")
            assert json.loads(first.message().payload)["state"] == "resolved"
            until(lambda: len(lines(tmp_path / "told")) == len(server.requests) == 2, "the command and the webhook")
            assert states(lines(tmp_path / "told")) == ["active", "resolved"], "no notice came twice"

            kill(cell.processes()["plc"]["pid"])
            died = json.loads(plant.message().payload), json.loads(plant.message().payload)
            assert {(one["alert"], one["state"]) for one in died} == {("died", "active"), ("lost", "active")}
            back = json.loads(plant.message().payload)
            assert (back["alert"], back["state"]) == ("lost", "resolved")
            cell.down()
            plant.taken()
            assert len(plant.heard) == 3, "the stop of the instance is no alert"


def test_a_failing_action_is_visible_and_harms_no_other(make_cell: Callable[..., Cell], tmp_path: Path) -> None:
    alert = (
        '[[alert]]\nname = "{name}"\nwhen = "cell/Outputs/13.%X0"\nevery_s = 0.1\n'
        'command_timeout_s = 60\ncommand = ["{python}", "-c", "{program}", "{folder}/{name}"]\n'
    )
    fill = {"python": sys.executable, "folder": tmp_path}
    hanging = alert.format(name="hangs", program="import time; time.sleep(1000)", **fill).replace("= 60", "= 0.2")
    failing = alert.format(name="fails", program="import sys; print('no printer'); sys.exit(3)", **fill)
    works = alert.format(name="works", program=COMMAND, **fill)
    with serving(500) as server:
        works += f'webhook = "http://127.0.0.1:{server.port}/s3cret"\n'
        cell = make_cell(config=WRITABLE + hanging + failing + works)
        cell.up()
        cell.output("shmio", "set", "Outputs/13", "1")
        until(lambda: states(lines(tmp_path / "works")) == ["active"], "the command that works")
        until(lambda: "exit status 3" in cell.processes()["alerts"]["note"], "the failure in the status")
        note = cell.processes()["alerts"]["note"]
        until(lambda: cell.processes()["alerts"]["counters"]["failed"] == 2, "both commands' failures")
        until(lambda: len(server.requests) >= 2, "another attempt of the webhook")
        assert cell.processes()["alerts"]["counters"]["waiting"] == 1
        assert "s3cret" not in note
        until(lambda: cell.status()["state"] == "degraded", "the instance's state")
        log = (tmp_path / "logs" / "alerts.log").read_text()
        for text in (
            "hangs: command",
            "took longer than 0.2 s",
            "its command printed: no printer",
            "answers 500",
            "shmio tries again",
        ):
            assert text in log
        assert cell.processes()["cell"]["quality"] == "good"
    with serving() as server:  # at another address: the notice still waits, and is for the alert, not for the address
        text = (tmp_path / "supervisor.toml").read_text()
        (tmp_path / "supervisor.toml").write_text(
            text.replace(text.rpartition("127.0.0.1:")[2], f'{server.port}/new"\n')
        )
        cell.output("shmio-supervisor", "reload")
        until(lambda: len(server.requests) == 1, "the waiting notice after the reload")
        until(lambda: cell.processes()["alerts"]["counters"]["waiting"] == 0, "nothing waits")
    assert states(lines(tmp_path / "works")) == ["active"], "no command ran twice"


def test_alerts_follow_virtual_time(make_cell: Callable[..., Cell], tmp_path: Path) -> None:
    config = f"""
[instance]
name = "{{instance}}"
clock = "stepped"
[[source]]
name = "sim"
connector = "memory"
layout = "sim.toml"
writable = ["**"]
period_ms = 100
[grpc]
listen = ["{{grpc}}"]
[[alert]]
name = "high"
when = "sim/level > 5"
for_s = 1
every_s = 10
command = ["{sys.executable}", "-c", "{COMMAND}", "{tmp_path}/told"]
"""
    cell = make_cell(config=config)
    (tmp_path / "sim.toml").write_text('[registers]\nlevel = "REAL"\n')
    cell.up()

    def level(value: int, steps: int) -> None:
        cell.output("shmio", "set", "sim/level", str(value))
        cell.output("shmio", "step", "--dt-ms", "100", "--count", str(steps))

    for value, steps in ((9, 8), (1, 5), (9, 30), (1, 5), (9, 30)):
        level(value, steps)
    level(9, 60)
    until(lambda: len(lines(tmp_path / "told")) == 2, "two notices")
    first, second = lines(tmp_path / "told")
    assert second["clock_s"] - first["clock_s"] == pytest.approx(10), "by the instance's clock"
    assert second["suppressed"] == 0
    assert cell.processes()["alerts"]["counters"]["missed"] == 0
