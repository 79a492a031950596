"""The web page of a running cell."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import urllib.request
from collections.abc import Callable
from typing import Any

import pytest

from shmio.testing.cell import BIN, CONFIG, PATIENCE_S, Cell, until
from shmio.testing.ports import reserved_port

pytest.importorskip("uvicorn")
client = pytest.importorskip("websockets.sync.client")


def test_page_shows_a_source_whose_controller_freezes(make_cell: Callable[..., Cell]) -> None:
    with reserved_port() as address:
        cell = make_cell(config=f'{CONFIG}[web]\nlisten = "{address}"\n')
        cell.up()
        with client.connect(f"ws://{address}/socket", origin=f"http://{address}") as browser:
            browser.send(json.dumps({"id": 1, "call": "overview.follow"}))

            def wait(condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
                while True:
                    message = json.loads(browser.recv(PATIENCE_S))
                    if message.get("topic") == "overview":
                        found = {one["name"]: one for one in message["data"]["processes"]}
                        if condition(found):
                            return found

            found = wait(lambda processes: processes["cell"]["quality"] == "good")
            assert {one["state"] for one in found.values()} == {"running"}
            assert found["web"]["memory_bytes"] > 0
            wait(lambda processes: processes["plc"]["cpu_percent"] is not None)
            pid = cell.processes()["plc"]["pid"]
            os.kill(pid, signal.SIGSTOP)
            try:
                found = wait(lambda processes: processes["cell"]["lost"][0] > 0)
                assert found["cell"]["quality"] == "bad"
                assert found["cell"]["reason"]
            finally:
                os.kill(pid, signal.SIGCONT)
            before = wait(lambda processes: processes["cell"]["recovered"][0] > 0)["cell"]
            os.kill(cell.processes()["cell"]["pid"], signal.SIGKILL)
            wait(lambda processes: processes["cell"]["recovered"][0] > before["recovered"][0])
            found = wait(lambda processes: processes["cell"]["quality"] == "good")
            assert found["cell"]["lost"][0] == before["lost"][0] + 1


def test_page_writes_a_register_and_overrides_it_until_it_is_closed(make_cell: Callable[..., Cell]) -> None:
    with reserved_port() as address:
        config = CONFIG.replace("timeout = 1000", 'timeout = 1000\nwritable = ["Outputs"]')
        cell = make_cell(config=f'{config}[web]\nlisten = "{address}"\n')
        cell.up()

        def present() -> tuple[int, str]:
            found = json.loads(cell.output("shmio", "get", "--json", "cell/Outputs/500"))["cell/Outputs/500"]
            return found["value"], found["provenance"]

        with client.connect(f"ws://{address}/socket", origin=f"http://{address}") as browser:

            def said(call: str, value: str) -> dict[str, Any]:
                given = {"path": "cell/Outputs/500", "value": value}
                browser.send(json.dumps({"id": 1, "call": call, "with": given}))
                return dict(json.loads(browser.recv(PATIENCE_S))["result"])

            assert said("registers.set", "16#2A")["outcome"] == "written"
            until(lambda: present() == (42, "live"), "the PLC has the value")
            assert said("registers.override", "7")["outcome"] == "shadowed"
            until(lambda: present() == (7, "injected"), "the override")
        until(lambda: present() == (42, "live"), "the end of the override")


def test_up_says_where_the_page_is_when_the_page_answers(make_cell: Callable[..., Cell]) -> None:
    with reserved_port() as address:
        cell = make_cell(config=f'{CONFIG}[web]\nlisten = "{address}"\n')
        with subprocess.Popen(
            [BIN / "shmio-supervisor", "up"], cwd=cell.folder, stdout=subprocess.PIPE, text=True
        ) as up:
            assert up.stdout is not None
            url = next(line.split()[1] for line in up.stdout if line.startswith("open http"))
            with urllib.request.urlopen(url, timeout=PATIENCE_S) as answer:
                assert answer.status == 200
            up.send_signal(signal.SIGINT)
            up.communicate(timeout=PATIENCE_S)
