"""A cell that requires tokens: on loopback, on a UNIX socket, through reloads and kills."""

from __future__ import annotations

import grp
import os
import socket
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import grpc
import pytest

from shmio.testing.cell import CONFIG, PATIENCE_S, Cell, kill, until
from shmio.wire.simlog_v1_pb2 import ROSMessage, TopicDescriptor

ROOT = Path(__file__).parents[2]
TOPIC = "cell/Robot_800/Axs1_Pos"
DASH, OTHER = "dash-0123456789abcdefghij", "other-0123456789abcdefghi"
GUARDED = (
    CONFIG.replace('listen = ["{grpc}"]', 'listen = ["{grpc}", "unix:run/a50.sock"]').replace(
        "[[source]]", f'group = "{grp.getgrgid(os.getegid()).gr_name}"\n[[source]]', 1
    )
    + '[[grpc.token]]\nname = "dash"\nroles = ["read"]\ntoken_file = "dash"\n'
)
MORE = '[[grpc.token]]\nname = "other"\nroles = ["read"]\ntoken_file = "other"\n'


@pytest.fixture
def guarded(make_cell: Callable[..., Cell]) -> Cell:
    cell = make_cell(config=GUARDED)
    (cell.folder / "run").mkdir()
    for name, token in (("dash", DASH), ("other", OTHER)):
        file = cell.folder / name
        file.write_text(token + "\n")
        file.chmod(0o600)
    return cell


def subscribe(cell: Cell, address: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run examples/subscribe.py as its user does."""
    command = [sys.executable, str(ROOT / "examples/subscribe.py"), "--count", "2", *options, address, TOPIC]
    return subprocess.run(command, cwd=cell.folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


@pytest.mark.timeout(600)  # runs a dozen commands in sequence
def test_a_reload_adds_and_removes_tokens(guarded: Cell) -> None:
    address = str(guarded.grpc)
    guarded.up()
    nobody = subscribe(guarded, address)
    assert nobody.returncode == 1
    assert "UNAUTHENTICATED: Subscribe needs the role read" in nobody.stderr
    get = ("get", "--host", address, "cell/Inputs")
    assert guarded.run("shmio", *get).stderr.endswith("; give --token-file FILE, a file with only the token\n")
    assert guarded.run("shmio", *get, "--token-file", "dash").returncode == 0
    assert "--token-file" not in guarded.run("shmio", *get, "--token-file", "other").stderr
    assert subscribe(guarded, address, "--token-file", "dash").returncode == 0
    assert "not in [[grpc.token]]" in subscribe(guarded, address, "--token-file", "other").stderr
    pid = guarded.processes()["grpc"]["pid"]
    with grpc.insecure_channel(address) as channel:
        stream = channel.unary_stream(
            "/simulation.server.SimlogAPI/Subscribe", TopicDescriptor.SerializeToString, ROSMessage.FromString
        )(TopicDescriptor(path=TOPIC), metadata=(("authorization", f"Bearer {DASH}"),), timeout=PATIENCE_S)
        assert next(stream).value
        file = guarded.folder / "supervisor.toml"
        before = file.read_text()
        file.write_text(before + MORE)
        reload = guarded.supervisor("reload")
        assert (reload.returncode, "grpc: the supervisor asked it to reload its tokens and roles" in reload.stdout) == (
            0,
            True,
        )
        until(lambda: subscribe(guarded, address, "--token-file", "other").returncode == 0, "the new token taken")
        assert next(stream).value, "the stream of a token that is still valid continues"
        (guarded.folder / "other").chmod(0o644)
        refused = guarded.supervisor("reload")
        assert (refused.returncode, "because its mode is 0644" in refused.stderr) == (1, True)
        file.write_text(before.replace('token_file = "dash"', 'token_file = "other"'))
        (guarded.folder / "other").chmod(0o600)
        assert guarded.supervisor("reload").returncode == 0
        with pytest.raises(grpc.RpcError) as caught:
            for _ in stream:
                pass
        assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED
    assert guarded.processes()["grpc"]["pid"] == pid
    told = guarded.logs() + guarded.supervisor("status", "--json").stdout
    assert "the endpoint has reloaded tokens and roles" in told
    assert DASH not in told
    assert OTHER not in told


def test_failed_handshakes_log_nothing(make_cell: Callable[..., Cell], tmp_path: Path) -> None:
    """By default, gRPC prints a line for each failed handshake."""
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    words = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "rsa:2048",
        "-nodes",
        "-days",
        "2",
        "-subj",
        "/CN=localhost",
        "-keyout",
    ]
    subprocess.run([*words, key, "-out", certificate], check=True, capture_output=True)
    key.chmod(0o600)
    cell = make_cell(config=CONFIG + '[grpc.tls]\ncertificate = "certificate.pem"\nkey = "key.pem"\n')
    cell.up()
    log = cell.folder / "logs/grpc.log"
    before = log.read_text()
    for _ in range(20):
        with socket.create_connection((cell.grpc.host, cell.grpc.port)) as rude:
            rude.sendall(b"GET / HTTP/1.1\r\n\r\n")
            rude.recv(1)
    assert log.read_text() == before


def test_a_unix_socket_is_replaced_after_a_death_and_removed_at_the_end(guarded: Cell) -> None:
    socket = guarded.folder / "run/a50.sock"
    guarded.up()
    assert stat.S_IMODE(socket.stat().st_mode) == 0o660
    assert subscribe(guarded, "unix:run/a50.sock", "--token-file", "dash").returncode == 0
    kill(guarded.processes()["grpc"]["pid"])
    until(
        lambda: subscribe(guarded, "unix:run/a50.sock", "--token-file", "dash").returncode == 0, "the endpoint is back"
    )
    guarded.down()
    assert not socket.exists()
    socket.write_text("precious")
    refused = guarded.supervisor("up", "--detach")
    assert (refused.returncode, "not a socket; move it away" in refused.stderr) == (1, True)
    assert socket.read_text() == "precious"
