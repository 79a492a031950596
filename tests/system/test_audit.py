"""The audit log of a whole cell: each way to change something has its entry, with the right actor and outcome."""

from __future__ import annotations

import asyncio
import hashlib
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest

import shmio
from shmio.config import Address
from shmio.errors import ShmioError
from shmio.testing.cell import CONFIG, PATIENCE_S, Cell, kill, until
from shmio.testing.ports import reserved_port

asyncua = pytest.importorskip("asyncua")
pytest.importorskip("uvicorn")
websockets = pytest.importorskip("websockets.sync.client")
InvalidStatus = pytest.importorskip("websockets.exceptions").InvalidStatus
mqtt = pytest.importorskip("paho.mqtt.publish")

ROOT = Path(__file__).parents[2]
TOKEN = "tester-0123456789abcdefghij"
PASSWORD = "a-long-and-random-password"
UID = str(os.getuid())


def secret(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


MORE = f"""
[[grpc.token]]
name = "tester"
roles = ["read", "write", "inject", "control"]
sha256 = "{secret(TOKEN)}"

[mqtt]
listen = "{{broker}}"
prefix = "shmio/test"
[[mqtt.account]]
roles = ["read", "write"]

[opcua]
listen = "{{opcua}}"
[[opcua.account]]
name = "operator"
roles = ["read", "write"]
sha256 = "{secret(PASSWORD)}"

[web]
listen = "{{web}}"

[recorder]
directory = "dumps"
"""


@pytest.fixture
def addresses() -> Iterator[dict[str, Address]]:
    with ExitStack() as stack:
        yield {name: stack.enter_context(reserved_port()) for name in ("broker", "opcua", "web")}


@pytest.fixture
def cell(make_cell: Callable[..., Cell], addresses: dict[str, Address]) -> Cell:
    config, more = CONFIG.replace("timeout = 1000", 'timeout = 1000\nwritable = ["Outputs"]'), MORE
    for name, address in addresses.items():
        more = more.replace(f"{{{name}}}", str(address))
    cell = make_cell(config=config + more)
    (cell.folder / "token").write_text(TOKEN + "\n")
    (cell.folder / "token").chmod(0o600)
    cell.up()
    return cell


def wait_for(cell: Cell, **wanted: object) -> dict[str, Any]:
    """Wait for an entry with these fields, and return the last one."""
    found: list[dict[str, Any]] = []

    def there() -> bool:
        lines = (cell.folder / "logs/audit.jsonl").read_bytes().splitlines()
        found[:] = [entry for line in lines if (entry := json.loads(line)).items() >= wanted.items()]
        return bool(found)

    until(there, f"an entry with {wanted}", PATIENCE_S)
    return found[-1]


def printed(cell: Cell, *arguments: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in cell.output("shmio-supervisor", "audit", "--json", *arguments).splitlines()]


async def opcua_write(address: Address, password: str, node: str) -> None:
    client = asyncua.Client(f"opc.tcp://{address}", timeout=PATIENCE_S)
    client.set_user("operator")
    client.set_password(password)
    async with client:
        await client.get_node(asyncua.ua.NodeId(node, 2)).write_value(3, asyncua.ua.VariantType.Byte)


def sign_in(address: Address, token: str) -> tuple[int, str]:
    """Sign in to the web page, and return the status and the cookie."""
    connection = HTTPConnection(address.host, address.port, timeout=PATIENCE_S)
    connection.request("POST", "/session", json.dumps({"token": token}), {"Origin": f"http://{address}"})
    answer = connection.getresponse()
    cookie = (answer.getheader("Set-Cookie") or "").partition(";")[0]
    connection.close()
    return answer.status, cookie


def call_page(address: Address, cookie: str, name: str, given: object) -> dict[str, Any]:
    """Make one call of a page, and return its answer."""
    url, headers = f"ws://{address}/socket", {"Cookie": cookie}
    with websockets.connect(url, origin=f"http://{address}", additional_headers=headers) as page:
        page.send(json.dumps({"id": 1, "call": name, "with": given}))
        return dict(json.loads(page.recv(PATIENCE_S)))


@pytest.mark.timeout(600)
def test_each_way_to_change_something_has_its_entry(cell: Cell, addresses: dict[str, Address]) -> None:
    address = str(cell.grpc)
    assert wait_for(cell, action="up")["what"]["mode"] == "live"

    cell.output("shmio", "set", "cell/Outputs/500", "1")
    local = wait_for(cell, endpoint="local", action="write")
    assert (local["kind"], local["who"], local["what"], local["outcome"]) == (
        "uid",
        UID,
        {"cell/Outputs/500": 1},
        "written",
    )
    assert re.fullmatch(r"pid [0-9]+ shmio", local["from"])

    with shmio.attach(cell.instance, writable=True) as here, here.inject("cell/Robot_800/Axs2_Pos") as shadow:
        shadow.set({"cell/Robot_800/Axs2_Pos": 1.5})
    laid = wait_for(cell, endpoint="local", action="inject", who=UID)
    assert laid["what"]["paths"] == ["cell/Robot_800/Axs2_Pos"]
    assert wait_for(cell, endpoint="local", action="lift")["what"]["injection"] == laid["command"]

    with shmio.connect(address, token=TOKEN) as remote:
        remote.set({"cell/Outputs/501": 2})
        written = wait_for(cell, endpoint="grpc", action="write")
        assert (written["kind"], written["who"]) == ("token", "tester")
        assert (written["what"], written["outcome"]) == ({"cell/Outputs/501": 2}, "written")
        assert written["command"] > 0 < written["event"]
        with pytest.raises(ShmioError):
            remote.set({"cell/Robot_800/Axs1_Pos": 1})
        assert "writable" in wait_for(cell, who="tester", action="write", outcome="refused")["reason"]
        with remote.inject("cell/Robot_800/Axs1_Pos") as shadow:
            shadow.set({"cell/Robot_800/Axs1_Pos": 4.5})
            laid = wait_for(cell, who="tester", action="inject", outcome="injected")
            assert laid["what"]["paths"] == ["cell/Robot_800/Axs1_Pos"]
            assert wait_for(cell, who="tester", action="feed")["what"] == {"cell/Robot_800/Axs1_Pos": 4.5}
        assert wait_for(cell, endpoint="grpc", action="lift")["what"]["injection"] == laid["command"]
        remote.step(0.02)
        assert wait_for(cell, who="tester", action="step", outcome="done")["what"]["dt_s"] == 0.02
        remote.release()
        wait_for(cell, who="tester", action="release", outcome="done")
    for token in ("wrong-0123456789abcdefghij", None):
        with pytest.raises(ShmioError), shmio.connect(address, token=token) as remote:
            remote.set({"cell/Outputs/501": 1})
        denied = wait_for(cell, kind="anonymous", endpoint="grpc", outcome="denied")
        assert (denied["action"], denied["what"]) == ("write", {"call": "/shmio.v1.Shmio/Write"})
        assert denied["from"].startswith("ipv4:127.0.0.1:")

    publish = [sys.executable, str(ROOT / "examples/publish.py"), "--token-file", str(cell.folder / "token"), address]
    for words in (("cell/Outputs/504", "7"), ("cell/Outputs/504", "900")):
        subprocess.run([*publish, *words], check=True, capture_output=True, timeout=PATIENCE_S)
    old = wait_for(cell, what={"cell/Outputs/504": 7})
    assert (old["who"], old["action"], old["outcome"]) == ("tester", "write", "written")
    assert wait_for(cell, what={"topic": "cell/Outputs/504"})["outcome"] == "refused"

    for topic in ("cell/Outputs/502", "cell/Outputs/9999"):
        where = {"hostname": addresses["broker"].host, "port": addresses["broker"].port}
        mqtt.single(f"shmio/test/{topic}/in", "2", **where)
    by_mqtt = wait_for(cell, endpoint="mqtt", outcome="written")
    assert (by_mqtt["kind"], by_mqtt["from"]) == ("anonymous", "broker of this instance")
    assert by_mqtt["what"] == {"cell/Outputs/502": "2"}
    assert wait_for(cell, endpoint="mqtt", outcome="refused")["what"] == {"cell/Outputs/9999": "2"}

    asyncio.run(opcua_write(addresses["opcua"], PASSWORD, "cell/Outputs/503"))
    by_opcua = wait_for(cell, endpoint="opcua", action="write")
    assert (by_opcua["kind"], by_opcua["who"], by_opcua["outcome"]) == ("account", "operator", "written")
    with pytest.raises(asyncua.ua.UaStatusCodeError):
        asyncio.run(opcua_write(addresses["opcua"], "wrong", "cell/Outputs/503"))
    assert wait_for(cell, endpoint="opcua", action="sign in", outcome="denied")["who"] == "operator"

    web = addresses["web"]
    assert sign_in(web, "wrong-0123456789abcdefghij")[0] == 403
    wait_for(cell, endpoint="web", action="sign in", outcome="denied")
    _, cookie = sign_in(web, TOKEN)
    wait_for(cell, endpoint="web", action="sign in", who="tester", outcome="done")
    given = {"path": "cell/Outputs/505", "value": "6"}
    assert call_page(web, cookie, "registers.set", given)["result"]["outcome"] == "written"
    by_page = wait_for(cell, endpoint="web", action="write", outcome="written")
    assert (by_page["who"], by_page["from"], by_page["what"]) == ("tester", "127.0.0.1", {"cell/Outputs/505": "6"})
    with pytest.raises(InvalidStatus, match="403"):
        call_page(web, "", "registers.set", given)
    wait_for(cell, endpoint="web", action="read", kind="anonymous", outcome="denied")
    call_page(web, cookie, "overview.restart", {"name": "mqtt"})
    wait_for(cell, endpoint="web", action="restart", who="tester", outcome="done")
    assert " web" in wait_for(cell, endpoint="supervisor", action="restart", outcome="done")["from"]

    assert cell.supervisor("restart", "nobody").returncode == 1
    assert wait_for(cell, action="restart", outcome="failed")["who"] == UID
    cell.output("shmio-supervisor", "reload")
    wait_for(cell, action="reload", who=UID, outcome="done")

    whole = (cell.folder / "logs/audit.jsonl").read_text()
    assert not [secret for secret in (TOKEN, PASSWORD, "wrong-0123456789abcdefghij", cookie) if secret in whole]
    assert [one["what"] for one in printed(cell, "--action", "write") if one["endpoint"] == "local"] == [local["what"]]
    refused = [
        one["what"] for one in printed(cell, "--who", "tester", "--action", "write") if one["outcome"] == "refused"
    ]
    assert refused == [{"cell/Robot_800/Axs1_Pos": 1}, {"topic": "cell/Outputs/504"}], "each has one entry"
    assert {one["who"] for one in printed(cell, "--who", "tester", "--since", "1h")} == {"tester"}
    assert [one["endpoint"] for one in printed(cell, "cell/Outputs/50[23]", "--action", "write")] == ["mqtt", "opcua"]
    assert "token tester" in cell.output("shmio-supervisor", "audit")
    cell.down()
    assert [one["action"] for one in printed(cell, "-n", "2")] == ["down", "stopped"]
    check_recorded_senders(cell)


def check_recorded_senders(cell: Cell) -> None:
    """Each command in the recording has the sender that its entry of the audit log names."""
    lines = cell.output(
        "shmio-dump", "cat", "--json", *map(str, sorted((cell.folder / "dumps").iterdir()))
    ).splitlines()
    events = [event for line in lines if "event" in (event := json.loads(line)) and event["command"]]
    senders = {
        entry["command"]: f"{entry['endpoint']}: {entry['kind']} {entry['who']}".rstrip() + f" ({entry['from']})"
        for entry in printed(cell, "-n", "1000")
        if entry["command"]
    }
    assert {event["by"] for event in events if event["command"] in senders} == set(senders.values())
    assert {sender.partition(":")[0] for sender in senders.values()} == {"grpc", "local", "mqtt", "opcua"}
    assert "web: token tester (127.0.0.1)" in {event["by"] for event in events}
    assert [event for event in events if senders.get(event["command"], event["by"]) != event["by"]] == []


@pytest.mark.timeout(600)
def test_entries_survive_kills_and_the_next_supervisor_goes_on(make_cell: Callable[..., Cell]) -> None:
    config = CONFIG.replace("timeout = 1000", 'timeout = 1000\nwritable = ["Outputs"]')
    cell = make_cell(config=config.replace("[[source]]", 'log_format = "json"\n[[source]]', 1))
    cell.up()
    with shmio.connect(str(cell.grpc)) as remote:
        remote.set({"cell/Outputs/501": 1})
    kill(cell.processes()["grpc"]["pid"])
    wait_for(cell, endpoint="grpc", action="write", outcome="written")
    kill(cell.status()["supervisor"]["pid"])
    until(lambda: cell.status()["supervisor"] is None, "the supervisor's death")
    cell.output("shmio", "set", "cell/Outputs/500", "1")
    cell.up()
    wait_for(cell, endpoint="local", what={"cell/Outputs/500": 1}, outcome="written")
    assert wait_for(cell, action="up", outcome="took over")["who"] == UID
    assert json.loads(cell.output("shmio-supervisor", "logs", "supervisor", "--json").splitlines()[0])["level"]
    assert not cell.output("shmio-supervisor", "logs", "supervisor").startswith("{")
