"""The embedded NATS server: a real process, as the uplink and others reach it."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

import nats
import pytest
import trustme
from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import NoServersError
from nats.js.api import StreamConfig

from shmio.config import Address
from shmio.config.model import Fabric, FabricAllow, MqttTls
from shmio.endpoints import server_process
from shmio.endpoints.fabric import server as server_module
from shmio.endpoints.fabric.server import NatsServer, ServerSettings
from shmio.errors import EndpointError, RemoteError
from shmio.fabric import own_seed
from shmio.fabric.client import FabricClient
from shmio.fabric.connection import OWN_INBOX, Access, connect
from shmio.fabric.own_seed import find_seed
from shmio.fabric.registry import BUCKETS, CellEntry, Registry
from shmio.testing.cell import until
from shmio.testing.ports import reserved_port
from tests.unit.endpoints.fabric.harness import TIMEOUT_S, in_loop
from tests.unit.endpoints.fabric.harness import until as until_async


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
    cells = [pattern for one in fabric.allow for pattern in one.patterns]
    settings = ServerSettings(str(fabric.listen), fabric.directory, fabric.tls, cell=fabric.cell, cells=cells)
    server = NatsServer(settings, "test")
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


OWN, FAR, STRANGER = "plant1.line3.near", "plant1.line3.far", "plant2.line1.x"


FENCE = f"shmio.{OWN}.cell.missing"
"""A subject to which each client may publish."""


class Other:
    """A client without credentials, as a program of another user of the host has it, and one that sees everything."""

    def __init__(self, client: Client, seen: asyncio.Queue[str]) -> None:
        self.client, self._seen = client, seen

    async def may_publish(self, subject: str) -> bool:
        """Return whether the server lets the client publish to a subject."""
        for one in (subject, FENCE):
            await self.client.publish(one, b"{}")
        async with asyncio.timeout(TIMEOUT_S):
            first = await self._seen.get()
            return first == subject and (subject == FENCE or await self._seen.get() == FENCE)


@asynccontextmanager
async def other(address: Address, own: FabricClient) -> AsyncIterator[Other]:
    seen: asyncio.Queue[str] = asyncio.Queue()

    async def note(message: Msg) -> None:
        if not message.subject.startswith("_INBOX."):
            await seen.put(message.subject)

    async def ignore(_: Exception) -> None:
        pass

    watching = await own.subscribe(">", cb=note)
    await own.flush()
    client = await nats.connect(f"nats://{address}", error_cb=ignore)
    yield Other(client, seen)
    await client.close()
    await watching.unsubscribe()


@in_loop
async def test_others_read_all_and_change_only_what_is_allowed(address: Address, tmp_path: Path) -> None:
    """In a server without accounts, any user of the host can delete the registry and fill the disk."""
    fabric = section(address, tmp_path)
    fabric.cell, fabric.allow = OWN, [FabricAllow("plant1.*.f*", ["write"])]
    with embedded(fabric):
        own = await connect(Access.of(fabric, process=True), "own", patient=False)
        registry = await Registry.open(own)
        await registry.claim(CellEntry(OWN, "host", "near", "1", "1", "running", 1, 2))
        await own.jetstream().add_stream(StreamConfig("shmio~plant1~line3~near", subjects=[f"shmio.{OWN}.*.live"]))
        async with other(address, own) as found:
            streams = [*(f"KV_{bucket}" for bucket in BUCKETS), "shmio~plant1~line3~near"]
            for request in ("DELETE", "PURGE", "UPDATE", "CREATE", "SNAPSHOT", "RESTORE", "MSG.DELETE"):
                for stream in (*streams, "more"):
                    assert not await found.may_publish(f"$JS.API.STREAM.{request}.{stream}"), (request, stream)
            for stream in streams:
                assert not await found.may_publish(f"$JS.API.CONSUMER.CREATE.{stream}"), stream
            for cell, may in ((OWN, False), (FAR, True), (STRANGER, False)):
                subjects = [f"shmio.{cell}.cell.{kind}" for kind in ("live", "late")]
                subjects += [f"shmio.{cell}.status", f"$KV.shmio_cells.{cell}", f"shmio.{OWN}.cell.command.{cell}"]
                for subject in subjects:
                    assert await found.may_publish(subject) == may, subject
            assert not await found.may_publish("anything.else")
            seen: list[str] = []

            async def see(message: Msg) -> None:
                seen.append(message.subject)

            for subject in ("_INBOX.>", f"shmio.{OWN}.*.live"):
                await found.client.subscribe(subject, cb=see)
            await found.client.flush()
            assert own.new_inbox().startswith(f"{OWN_INBOX}.")
            for subject in (f"{OWN_INBOX}.x", "_INBOX.other", f"shmio.{OWN}.cell.live"):
                await own.publish(subject, b"")
            await own.flush()
            await until_async(lambda: len(seen) == 2)
            assert seen == ["_INBOX.other", f"shmio.{OWN}.cell.live"], "nobody reads the answers to the instance"
        assert [one.entry.cell for one in await registry.cells()] == [OWN], "the registry is as it was"
        await own.close()


@in_loop
async def test_shmio_of_another_user_sees_the_cells(
    address: Address, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fabric = section(address, tmp_path)
    with embedded(fabric):
        own = await connect(Access.of(fabric), "own", patient=False)
        await (await Registry.open(own)).claim(CellEntry(OWN, "host", "near", "1", "1", "running", 1, 2))
        await own.close()
        monkeypatch.setattr(own_seed, "runtime_folders", lambda: [tmp_path / "other"])
        client = await connect(Access.of(fabric), "other", patient=False)
        registry = await Registry.open(client)
        assert [one.entry.cell for one in await registry.cells()] == [OWN]
        with pytest.raises(RemoteError, match="not kept by 3 servers: this user may not"):
            await registry.spread(3)
        await client.close()
        with pytest.raises(RemoteError, match="no seed of this user"):
            await connect(Access.of(fabric, process=True), "process", patient=False)


@in_loop
async def test_the_seed_is_private_and_survives(address: Address, tmp_path: Path) -> None:
    """A killed server leaves its seed, a deleted one comes again, and clients follow a new one."""
    fabric, restored = section(address, tmp_path), asyncio.Event()

    async def again() -> None:
        restored.set()

    with embedded(fabric) as server:
        seed = find_seed(address.host, address.port)
        assert seed == find_seed("localhost", address.port)
        file = server._seed._file
        assert (file.stat().st_mode & 0o777, file.parent.stat().st_mode & 0o777) == (0o600, 0o700)
        assert seed is not None
        assert seed not in (tmp_path / "fabric" / "nats-server.conf").read_text()
        file.chmod(0o644)
        assert find_seed(address.host, address.port) is None, "others could have written it"
        server.check()
        assert (find_seed(address.host, address.port), file.stat().st_mode & 0o777) == (seed, 0o600)
        file.unlink()
        server.check()
        assert find_seed(address.host, address.port) == seed
        client = await connect(Access.of(fabric, process=True), "test", back=again)
        os.kill(server._process._process.pid, signal.SIGKILL)
        server._process._process.wait()
        assert find_seed(address.host, address.port) == seed, "a restarted supervisor's processes find it"
    assert find_seed(address.host, address.port) is None
    with embedded(fabric):
        assert find_seed(address.host, address.port) != seed
        await asyncio.wait_for(restored.wait(), TIMEOUT_S)
        await Registry.open(client)
        await client.close()


def test_an_old_server_is_refused(address: Address, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "nats-server"
    program.write_text("#!/bin/sh\necho nats-server: v2.9.10\n")
    program.chmod(0o755)
    monkeypatch.setattr(server_module, "find_server", lambda: str(program))
    with pytest.raises(EndpointError, match=r"NATS v2\.9\.10, but the fabric needs 2\.10 or later; upgrade"):
        NatsServer(ServerSettings(str(address), str(tmp_path / "fabric")), "test")


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
