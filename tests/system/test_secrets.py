"""No secret of a configuration reaches a log, a process list, an environment, a recording, or the page."""

from __future__ import annotations

import http.client
import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shmio.testing.cell import CONFIG, Cell, until
from shmio.testing.mosquitto import missing
from shmio.testing.ports import reserved_port
from tests.unit.endpoints.alerts.test_webhook import serving

websockets = pytest.importorskip("websockets.sync.client")
pytest.importorskip("uvicorn")
pytest.importorskip("asyncua")

SECRETS = {
    "token": "grpc-secret-0123456789abcdef",
    "mqtt": "mqtt-secret-0123456789abcdef",
    "opcua": "opcua-secret-0123456789abcdef",
    "hook": "hook-secret-0123456789abcdef",
    "path": "path-secret-0123456789abcdef",
}
WRONG = "wrong-secret-0123456789abcdef"
"""A user's typing error differs from the secret by little, so it is a secret, too."""
FILES = {
    "token": SECRETS["token"],
    "accounts": f"anna:{SECRETS['mqtt']}",
    "panel": SECRETS["opcua"],
    "headers": f"Authorization: Bearer {SECRETS['hook']}",
    "wrong": WRONG,
}
MORE = """
[[grpc.token]]
name = "operator"
roles = ["read", "write", "control"]
token_file = "token"

[mqtt]
broker = "mosquitto"
listen = "{broker}"
password_file = "accounts"

[web]
listen = "{web}"

[opcua]
listen = "{opcua}"

[[opcua.account]]
name = "panel"
roles = ["read"]
token_file = "panel"

[recorder]
directory = "dumps"

[[alert]]
name = "paused"
when = "cell/Outputs/13.%X0"
webhook = "http://127.0.0.1:{hook}/{path}"
webhook_header_file = "headers"
"""


@pytest.fixture
def secretive(make_cell: Callable[..., Cell]) -> Iterator[tuple[Cell, str, str]]:
    """Start a cell with a secret of each kind, and let an alert send one. Yield the addresses of page and broker."""
    config = CONFIG.replace("timeout = 1000", 'timeout = 1000\nwritable = ["Outputs"]')
    with reserved_port() as broker, reserved_port() as web, reserved_port() as opcua, serving(500) as server:
        more = MORE.format(broker=broker, web=web, opcua=opcua, hook=server.port, path=SECRETS["path"])
        cell = make_cell(config=config + more)
        for name, text in FILES.items():
            file = cell.folder / name
            file.touch(0o600)
            file.write_text(text + "\n")
        cell.up()
        cell.output("shmio", "set", "cell/Outputs/13", "1")
        until(lambda: bool(server.requests), "the alert calls the webhook")
        yield cell, str(web), str(broker)


def _exposed(cell: Cell) -> Iterator[tuple[str, bytes]]:
    """Yield what other users, logs and recordings show, with a name for each."""
    for pid in _processes(cell):
        for name in ("cmdline", "environ"):
            yield f"/proc/{pid}/{name}", Path(f"/proc/{pid}/{name}").read_bytes()
    for file in cell.folder.rglob("*"):
        if file.is_file() and file.name not in FILES and file.name != "supervisor.toml":
            yield str(file), file.read_bytes()
    yield "status", cell.output("shmio-supervisor", "status", "--json").encode()
    yield "check", cell.output("shmio-supervisor", "check").encode()


def _processes(cell: Cell) -> list[int]:
    """Return the pids of the supervisor, of its processes, and of all processes below them."""
    found = [process["pid"] for process in cell.processes().values()]
    found.append(int(Path(f"/proc/{found[0]}/stat").read_text().rpartition(")")[2].split()[1]))
    for pid in found:
        for task in Path(f"/proc/{pid}/task").iterdir():
            found += map(int, (task / "children").read_text().split())
    return found


def _page(web: str, token: str) -> bytes:
    """Sign in to the page, and return everything that it gets."""
    connection = http.client.HTTPConnection(web, timeout=60)
    try:
        connection.request("POST", "/session", json.dumps({"token": token}))
        answer = connection.getresponse()
        received = str(answer.headers).encode() + answer.read()
    finally:
        connection.close()
    cookie = answer.headers.get("Set-Cookie", "").partition(";")[0]
    if not cookie:
        return received
    with websockets.connect(f"ws://{web}/socket", additional_headers={"Cookie": cookie}) as socket:
        calls = ("configuration.check", "overview.follow", "recordings.files", "registers.rows", "log.lines")
        for number, call in enumerate(calls):
            given = {"log.lines": {"level": "debug", "process": "", "text": ""}}.get(call, {})
            socket.send(json.dumps({"id": number, "call": call, "with": given}))
        waiting = set(range(len(calls)))
        while waiting:
            message = socket.recv(60)
            received += message if isinstance(message, bytes) else message.encode()
            waiting.discard(json.loads(message).get("id") if isinstance(message, str) else None)
    return received


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_secrets_appear_nowhere(secretive: tuple[Cell, str, str]) -> None:
    cell, web, broker = secretive
    for name in ("token", "wrong"):
        done = cell.run("shmio", "get", "--host", str(cell.grpc), "--token-file", name, "cell/Inputs")
        assert (done.returncode == 0) == (name == "token"), done.stderr
        assert WRONG not in done.stdout + done.stderr
    for password in (SECRETS["mqtt"], WRONG):
        host, _, port = broker.rpartition(":")
        command = f"mosquitto_sub -h {host} -p {port} -u anna -P {password} -t # -C 1 -W 20".split()
        assert (subprocess.run(command, capture_output=True, check=False).returncode == 0) == (password != WRONG)
    shown = {"the page": _page(web, SECRETS["token"]), "the page, refused": _page(web, WRONG)}
    assert b"webhook" in shown["the page"], "the page shows the configuration"
    cell.output("shmio-supervisor", "reload")
    shown |= dict(_exposed(cell))
    assert sum(name.endswith("environ") for name in shown) >= 9
    assert any(name.endswith(".mem") for name in shown)
    hidden = [WRONG, *SECRETS.values()]
    found = {(name, secret) for name, data in shown.items() for secret in hidden if secret.encode() in data}
    assert not found
