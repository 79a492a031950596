"""The embedded NATS server: a real process, as the uplink and others reach it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import nats
import pytest
import trustme
from nats.errors import NoServersError

from shmio.config import Address
from shmio.config.model import Fabric, MqttTls
from shmio.endpoints import server_process
from shmio.endpoints.fabric.server import NatsServer, ServerSettings
from shmio.errors import EndpointError
from shmio.fabric.connection import Access, connect
from shmio.fabric.registry import Registry
from shmio.testing.cell import until
from shmio.testing.ports import reserved_port
from tests.unit.endpoints.fabric.harness import in_loop


@pytest.fixture
def address() -> Iterator[Address]:
    with reserved_port() as address:
        yield address


@pytest.fixture
def pem(tmp_path: Path) -> dict[str, str]:
    authority = trustme.CA()
    cert = authority.issue_cert("nats.example")
    files = {"ca": tmp_path / "ca.pem", "certificate": tmp_path / "cert.pem", "key": tmp_path / "key.pem"}
    authority.cert_pem.write_to_path(files["ca"])
    cert.cert_chain_pems[0].write_to_path(files["certificate"])
    cert.private_key_pem.write_to_path(files["key"])
    return {name: str(file) for name, file in files.items()}


@contextmanager
def embedded(fabric: Fabric) -> Iterator[NatsServer]:
    """Run the server of a section."""
    server = NatsServer(ServerSettings(str(fabric.listen), fabric.directory, fabric.tls), "test")
    try:
        server.await_start(lambda: None)
        yield server
    finally:
        server.stop()


def section(address: Address, folder: Path, tls: MqttTls | None = None) -> Fabric:
    return Fabric(server="embedded", listen=str(address), directory=str(folder / "fabric"), tls=tls)


@in_loop
async def test_it_serves_jetstream(address: Address, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("DEBUG", "shmio.fabric")
    fabric = section(address, tmp_path)
    with embedded(fabric):
        client = await connect(Access.of(fabric), "test", patient=False)
        await Registry.open(client)
        assert client.max_payload == 1 << 20
        await client.close()
        with pytest.raises(EndpointError, match=r"fabric\.directory: .*another NATS server"):
            NatsServer(ServerSettings("127.0.0.1:0", fabric.directory), "test")
    assert (tmp_path / "fabric").stat().st_mode & 0o077 == 0
    assert (tmp_path / "fabric" / "jetstream").is_dir(), "the streams are kept"
    logged = [one for one in caplog.records if one.getMessage().startswith("nats-server: ")]
    assert logged
    assert [one.getMessage() for one in logged if one.levelname == "ERROR"] == []


@pytest.mark.parametrize("mutual", [False, True])
@in_loop
async def test_the_instance_trusts_its_own_certificate(
    address: Address, tmp_path: Path, pem: dict[str, str], mutual: bool
) -> None:
    tls = MqttTls(**pem) if mutual else MqttTls(certificate=pem["certificate"], key=pem["key"])
    fabric = section(Address("0.0.0.0", address.port), tmp_path, tls)
    with embedded(fabric):
        client = await connect(Access.of(fabric), "test", patient=False)
        await client.flush()
        await client.close()
        with pytest.raises((NoServersError, OSError)):
            await nats.connect(f"nats://127.0.0.1:{address.port}", allow_reconnect=False)


def test_nothing_is_imported_without_the_section() -> None:
    code = (
        "import sys, shmio.plan.prepare, shmio.supervisor.main, shmio.connectors.__main__, shmio.cli.user\n"
        "print([name for name in sys.modules if name.split('.')[0] in ('nats', 'nkeys')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_its_end_is_reported(address: Address, tmp_path: Path) -> None:
    with embedded(section(address, tmp_path)) as server:
        server.check()
        os.kill(server._process._process.pid, signal.SIGKILL)
        until(lambda: server._process._process.poll() is not None, "the server's end")
        with pytest.raises(EndpointError, match="has ended"):
            server.check()


@pytest.mark.parametrize("encrypted", [False, True])
def test_a_server_that_does_not_answer_is_reported(
    address: Address,
    tmp_path: Path,
    pem: dict[str, str],
    encrypted: bool,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server_process, "ASK_S", 0.02)
    monkeypatch.setattr(server_process, "LATE_S", 1.6)
    with embedded(section(address, tmp_path, MqttTls(**pem) if encrypted else None)) as server:
        child = server._process._process
        until_s = time.monotonic() + 2.0
        until(lambda: problem(server) != "" or time.monotonic() > until_s, "some answers")
        assert problem(server) == ""
        os.kill(child.pid, signal.SIGSTOP)
        until(lambda: "the NATS server has not answered" in problem(server), "the problem")
        os.kill(child.pid, signal.SIGCONT)
        until(lambda: problem(server) == "", "an answer")
        os.kill(child.pid, signal.SIGSTOP)
        monkeypatch.setattr(server_process, "HANG_S", 0.8)
        with pytest.raises(EndpointError, match="the NATS server hangs"):
            until(lambda: problem(server) == "never", "the hang")
    assert child.returncode == -signal.SIGKILL
    assert [one.getMessage() for one in caplog.records if one.name == "shmio.fabric"] == [], "questions are not logged"


def problem(server: NatsServer) -> str:
    server.check()
    return server.problem


def test_a_port_in_use_is_reported(address: Address, tmp_path: Path) -> None:
    with embedded(section(address, tmp_path)):
        second = NatsServer(ServerSettings(str(address), str(tmp_path / "other")), "test")
        until(lambda: second._process._process.poll() is not None, "its end")
        with pytest.raises(EndpointError, match="address already in use"):
            second.check()
        second.stop()
