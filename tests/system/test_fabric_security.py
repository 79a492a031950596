"""``shmio fabric server-config``: a real server enforces who may publish and read what."""

from __future__ import annotations

import asyncio
import json
import queue
import signal
import socket
import stat
import subprocess
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import trustme
from nats.aio.client import Client
from nats.errors import Error as NatsError
from nats.js.errors import APIError, NotFoundError

from shmio.cli.campaign import main as campaign
from shmio.cli.dump import main as dump
from shmio.cli.user import main
from shmio.config.model import FabricHistory
from shmio.connectors.fabric.link import Link
from shmio.endpoints.fabric.history import History
from shmio.endpoints.fabric.server import find_server
from shmio.errors import ConflictError, RemoteError
from shmio.fabric.archive.folder import ArchiveFolder
from shmio.fabric.archive.service import Archive, ArchiveLimits
from shmio.fabric.client import FabricClient
from shmio.fabric.connection import Access, connect
from shmio.fabric.names import CellName
from shmio.fabric.registry import BUCKETS, CELLS, CellEntry, Registry
from shmio.fabric.server_config import FARM_LIMITS
from shmio.falsification.farm.exchange import NAME, contact, open_consumer, open_store, tasks_of
from shmio.layout.model import Layout, Register
from shmio.testing.ports import reserved_port

A, B = "plant1.line3.a50", "plant1.line3.b60"
CELL_A, CELL_B = CellName.parse(A), CellName.parse(B)
LAYOUT = Layout("DB1", 1, 2, False, (Register("a", "INT", (), 0, None, 2, 1),))
END = b"end"
"""The administrator's message that ends what a listener waits for."""


class Server:
    """A running NATS server with a given configuration."""

    def __init__(self, config: Path, port: int) -> None:
        self.url = f"nats://127.0.0.1:{port}"
        self._log = config.with_suffix(".log")
        self._process = subprocess.Popen([str(find_server()), "-c", config, "-l", self._log])
        end_s = time.monotonic() + 20
        while not _answers(port):
            if self._process.poll() is not None or time.monotonic() > end_s:
                self.stop()
                pytest.fail(f"nats-server does not run: {self._log.read_text()}")
            time.sleep(0.01)

    def reload(self) -> None:
        """Make the server read its configuration again."""
        self._process.send_signal(signal.SIGHUP)
        end_s = time.monotonic() + 20
        while "Reloaded server configuration" not in self._log.read_text():
            assert time.monotonic() < end_s, self._log.read_text()
            time.sleep(0.01)

    def stop(self) -> None:
        """Stop the server."""
        self._process.terminate()
        self._process.wait(20)


def _answers(port: int) -> bool:
    try:
        with socket.create_connection(("127.0.0.1", port), 1) as probe:
            return probe.recv(4) == b"INFO"
    except OSError:
        return False


@contextmanager
def running(config: Path, port: int) -> Iterator[Server]:
    """Run a server with a configuration file."""
    server = Server(config, port)
    try:
        yield server
    finally:
        server.stop()


@pytest.fixture
def port() -> Iterator[int]:
    with reserved_port() as address:
        yield address.port


def entry(cell: str, host: str = "near", **more: Any) -> CellEntry:
    return CellEntry(cell, host, "a50", "1.0", "0", "running", 1, 2, **more)


class Fabric:
    """A server whose configuration the command wrote, and its users."""

    def __init__(self, folder: Path, server: Server) -> None:
        self.folder, self.server = folder, server

    def seed(self, user: str) -> Path:
        return next(self.folder.rglob(f"{user}.seed"))

    async def join(self, user: str) -> Client:
        return await connect(Access((self.server.url,), credentials=str(self.seed(user))), user, patient=False)


@pytest.fixture
def fabric(tmp_path: Path, port: int, capsys: pytest.CaptureFixture[str]) -> Iterator[Fabric]:
    folder = tmp_path / "nats"
    assert main(["fabric", "server-config", "-o", str(folder), "--cell", A, B, "--viewer", "eye", "--farm-user", "lab",
                 "--listen", f"127.0.0.1:{port}"]) == 0  # fmt: skip
    with running(folder / "nats-server.conf", port) as server:
        made = Fabric(folder, server)
        assert main(["fabric", "prepare", "--server", server.url, "--credentials", str(made.seed("admin"))]) == 0
        capsys.readouterr()
        yield made


async def received(admin: Client, listener: Client, subject: str, act: Callable[[], Awaitable[object]]) -> list[bytes]:
    """Return what a user receives at a subject because of an action."""
    found: list[bytes] = []
    ended = asyncio.Event()

    async def take(message: Any) -> None:
        if message.data == END:
            ended.set()
        else:
            found.append(message.data)

    subscription = await listener.subscribe(subject, cb=take)
    await listener.flush()
    await act()
    await admin.publish(subject, END)
    await asyncio.wait_for(ended.wait(), 20)
    await subscription.unsubscribe()
    return found


def sender(client: Client, subject: str, data: bytes = b"x") -> Callable[[], Awaitable[object]]:
    """Return an action that sends a message, and waits until the server has decided about it."""

    async def act() -> None:
        await client.publish(subject, data)
        await client.flush()

    return act


def test_cells_publish_their_own_subjects_and_no_others(fabric: Fabric) -> None:
    async def check() -> None:
        admin, cell = await fabric.join("admin"), await fabric.join(A)

        own = CELL_A.live("cell"), CELL_A.late("cell"), CELL_A.status, CELL_B.command("cell", CELL_A)
        for subject in own:
            assert await received(admin, admin, subject, sender(cell, subject)) == [b"x"], subject
        foreign = (
            CELL_B.live("cell"), CELL_B.late("cell"), CELL_B.status, CELL_A.command("cell", CELL_B),
            f"$KV.{CELLS}.{B}", "shmio.plant1", "$JS.API.STREAM.DELETE.KV_shmio_cells",
        )  # fmt: skip
        for subject in foreign:
            assert await received(admin, admin, subject, sender(cell, subject)) == [], subject
        await admin.close()
        await cell.close()

    asyncio.run(check())


def test_server_answers_carry_nothing_of_a_user_to_the_subjects_of_others(fabric: Fabric) -> None:
    """The server sends its answer to any subject that a request names, whoever may publish there."""

    async def check() -> None:
        admin, cell = await fabric.join("admin"), await fabric.join(A)
        await Registry.open(cell)
        await cell.jetstream().publish(f"$KV.{CELLS}.{A}", b"FORGED")
        victim = CELL_B.live("cell")
        push = json.dumps(
            {"stream_name": f"KV_{CELLS}", "config": {"name": "x", "deliver_subject": victim, "ack_policy": "none"}}
        )
        requests = {
            f"$JS.API.DIRECT.GET.KV_{CELLS}.$KV.{CELLS}.{A}": "",
            f"$JS.API.DIRECT.GET.KV_{CELLS}": json.dumps({"last_by_subj": f"$KV.{CELLS}.{A}"}),
            f"$JS.API.CONSUMER.CREATE.KV_{CELLS}.x": push,
            f"$JS.API.CONSUMER.CREATE.KV_{CELLS}": push,
            f"$JS.API.STREAM.MSG.GET.KV_{CELLS}": json.dumps({"last_by_subj": f"$KV.{CELLS}.{A}"}),
            f"$JS.API.STREAM.INFO.KV_{CELLS}": "",
            "$JS.API.STREAM.CREATE.mine": json.dumps({"name": "mine", "subjects": [f"$KV.{CELLS}.>"]}),
        }

        async def act() -> None:
            for subject, body in requests.items():
                await cell.publish(subject, body.encode(), reply=victim)
            await cell.flush()

        answers = await received(admin, admin, victim, act)
        assert answers, "JSON answers do arrive: the attempt was made"
        assert all(answer.startswith(b'{"type":"io.nats.jetstream') for answer in answers)
        await admin.close()
        await cell.close()

    asyncio.run(check())


def test_a_cell_cannot_empty_the_registry_nor_replace_a_layout(fabric: Fabric) -> None:
    async def check() -> None:
        a, b = await fabric.join(A), await fabric.join(B)
        one, other = await Registry.open(a), await Registry.open(b)
        await one.claim(entry(A))
        await other.claim(entry(B))
        await one.put_layout(LAYOUT)
        digest = LAYOUT.hash.hex()
        for headers in (
            {"Nats-Rollup": "all"},
            {"Nats-Rollup": "sub"},
            {"KV-Operation": "PURGE", "Nats-Rollup": "sub"},
        ):
            for subject in (f"$KV.{CELLS}.{B}", f"$KV.shmio_layouts.{digest}"):
                await b.publish(subject, b"", headers=headers)
        await b.publish(f"$KV.shmio_layouts.{digest}", b"another")
        await b.flush()
        assert (await one.layout(digest)).hash == LAYOUT.hash
        assert [seen.entry.cell for seen in await one.cells()] == [A, B]
        await a.close()
        await b.close()

    asyncio.run(check())


def test_replies_reach_only_their_user(fabric: Fabric) -> None:
    async def check() -> None:
        a, b, eye = await fabric.join(A), await fabric.join(B), await fabric.join("eye")
        inbox = a.new_inbox().rpartition(".")[0]
        for spy in (b, eye):
            for subject in ("_INBOX.>", f"{inbox}.>", CELL_A.command("cell", CELL_B), "$KV.>", ">"):
                got: list[Any] = []

                async def take(message: Any, got: list[Any] = got) -> None:
                    got.append(message)

                await spy.subscribe(subject, cb=take)
                await spy.flush()
                assert f'subscription to "{subject.lower()}"' in str(spy.last_error).lower()
                await a.request(f"$JS.API.STREAM.INFO.KV_{CELLS}", timeout=5)
                await spy.flush()
                assert got == []
        for user in (a, b, eye):
            await user.close()

    asyncio.run(check())


def test_viewers_read_everything_and_write_nothing(fabric: Fabric) -> None:
    async def check() -> None:
        cell, admin, eye = await fabric.join(A), await fabric.join("admin"), await fabric.join("eye")
        writer = await Registry.open(cell)
        await writer.claim(entry(A, sources=()))
        await writer.put_layout(LAYOUT)
        reader = await Registry.open(eye)
        assert [seen.entry.cell for seen in await reader.cells()] == [A]
        found = await reader.find(A)
        assert found is not None
        assert found.alive
        assert found.age_s < 5
        assert (await reader.layout(LAYOUT.hash.hex())).hash == LAYOUT.hash
        with pytest.raises((RemoteError, ConflictError, NatsError, TimeoutError)):
            await asyncio.wait_for(reader.claim(entry("plant1.line3.new")), 2)

        assert await received(admin, eye, CELL_A.live("cell"), sender(cell, CELL_A.live("cell"))) == [b"x"]
        subjects = (
            CELL_A.live("cell"), CELL_A.status, CELL_A.command("cell", CELL_B), f"$KV.{CELLS}.{A}",
            "$KV.shmio_layouts.00", "_INBOX.anything", "anything",
        )  # fmt: skip
        for subject in subjects:
            assert await received(admin, admin, subject, sender(eye, subject)) == [], subject
        for user in (cell, admin, eye):
            await user.close()

    asyncio.run(check())


def test_a_farm_has_its_own_account(fabric: Fabric) -> None:
    async def work() -> None:
        admin, cell, lab = [await fabric.join(user) for user in ("admin", A, "lab")]
        await contact(lab)
        await open_consumer(lab, "task-x", tasks_of("x"))
        await lab.jetstream().publish(tasks_of("x"), b"task")
        store = await open_store(lab)
        await store.put("bundle", b"files")
        assert (await store.get("bundle")).data == b"files"
        (task,) = await (await lab.jetstream().pull_subscribe_bind("task-x", NAME)).fetch(1, timeout=5)
        assert task.data == b"task"
        assert await received(admin, cell, CELL_A.live("*"), sender(lab, CELL_A.live("cell"))) == []
        with pytest.raises(NotFoundError):
            await admin.jetstream().stream_info(NAME)
        assert (await admin.jetstream().account_info()).limits.max_storage == -1, "cells are not limited"
        assert (await lab.jetstream().account_info()).limits.max_storage == FARM_LIMITS["max_file"]
        with pytest.raises(APIError, match="maximum number of streams"):
            await lab.jetstream().add_stream(name="more")
        for client in (admin, cell, lab):
            await client.close()

    asyncio.run(work())


def test_seeds_of_cells_and_farms_are_told_apart(
    fabric: Fabric, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A command that looks for cells in a farm's account must not create a registry there."""
    url, cell, lab = fabric.server.url, str(fabric.seed(A)), str(fabric.seed("lab"))
    assert main(["fabric", "cells", "--server", url, "--credentials", lab]) == 1
    assert "may not read the registry; use the seed of a cell or viewer" in one_line(capsys)
    assert main(["fabric", "server-config", "-o", str(tmp_path / "other"), "--farm-user", "stranger"]) == 0
    stranger = tmp_path / "other/farm-users/stranger.seed"
    for given, words in (
        ([], "asks for credentials"),
        (["--credentials", str(stranger)], "does not know the credentials"),
        (["--credentials", cell], "use the seed of a farm user"),
    ):
        assert campaign(["worker", "--farm", url, *given]) == 2, words
        assert words in one_line(capsys)

    async def look() -> None:
        client = await fabric.join("lab")
        assert await client.jetstream().streams_info() == []
        await client.close()

    asyncio.run(look())


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    """Return what was printed as an error, which must be one line."""
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_missing_messages_are_answered_across_users(fabric: Fabric) -> None:
    async def check() -> None:
        a, b, eye = await fabric.join(A), await fabric.join(B), await fabric.join("eye")

        async def answer(message: Any) -> None:
            await a.publish(message.reply, b"kept")

        await a.subscribe(CELL_A.missing("*"), cb=answer)
        await a.subscribe(CELL_A.command("cell", CELL_B).replace(B, "*.*.*"), cb=answer)
        await a.flush()
        for user in (b, eye):
            assert (await user.request(CELL_A.missing("cell"), b"", timeout=5)).data == b"kept"
        assert (await b.request(CELL_A.command("cell", CELL_B), b"", timeout=5)).data == b"kept"
        for one in (a, b, eye):
            await one.close()

    asyncio.run(check())


def test_second_run_keeps_seeds_and_adds_cells(fabric: Fabric, capsys: pytest.CaptureFixture[str]) -> None:
    seeds = {file: file.read_text() for file in fabric.folder.rglob("*.seed")}
    written = [*seeds, *fabric.folder.glob("*.conf"), *fabric.folder.glob("*.json")]
    assert {stat.S_IMODE(file.stat().st_mode) for file in written} == {0o600}
    assert main(["fabric", "server-config", "-o", str(fabric.folder), "--cell", "plant1.line3.new"]) == 0
    out = capsys.readouterr().out
    assert all(text.strip() not in out for text in seeds.values())
    assert {file: file.read_text() for file in seeds} == seeds
    fabric.server.reload()

    async def check() -> None:
        for name in (A, "plant1.line3.new"):
            client = await fabric.join(name)
            await (await Registry.open(client)).claim(entry(name))
            await client.close()

    asyncio.run(check())


def test_wrong_credentials_are_named(fabric: Fabric, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fabric", "server-config", "-o", str(tmp_path / "other"), "--viewer", "stranger"]) == 0
    capsys.readouterr()
    stranger = tmp_path / "other/viewers/stranger.seed"
    wrong = tmp_path / "wrong.seed"
    wrong.write_text("SUANOTHING")
    wrong.chmod(0o600)
    shown = tmp_path / "shown.seed"
    shown.write_text(stranger.read_text())
    shown.chmod(0o644)
    for file, words in (
        (stranger, f"does not know the credentials in {stranger}"),
        (None, "asks for credentials"),
        (wrong, f"{wrong}: the seed is damaged"),
        (shown, f"{shown}: other users may have read this file"),
        (tmp_path / "absent", "absent: No such file"),
    ):
        given = [] if file is None else ["--credentials", str(file)]
        assert main(["fabric", "cells", "--server", fabric.server.url, *given]) == 1
        assert words in one_line(capsys)


def test_seeds_of_the_wrong_user_are_named(
    fabric: Fabric, tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    """The server itself only answers nothing."""
    caplog.set_level("INFO", "shmio.fabric")
    eye, file = str(fabric.seed("eye")), str(tmp_path / "a.mem")
    for command in (
        ["fabric", "prepare", "--server", fabric.server.url, "--history", A],
        ["fetch", f"{fabric.server.url}/{A}", "-o", file],
    ):
        program = main if command[0] == "fabric" else dump
        assert program([*command, "--credentials", eye]) == 1
        err = capsys.readouterr().err
        assert f"{eye} may not use histories; reading them needs the seed of a history reader" in err, err

    async def archive() -> None:
        access = Access((fabric.server.url,), credentials=eye)
        stopping = asyncio.Event()
        folder = ArchiveFolder(tmp_path / "archive")
        task = asyncio.create_task(
            Archive(access, folder, ["*"], ArchiveLimits(1 << 20, 1.0), lambda _: None, stopping).run()
        )
        assert await _until(lambda: "does not list its streams: the user of the credentials" in caplog.text)
        stopping.set()
        await task
        folder.close()

    asyncio.run(archive())


def test_histories_are_prepared_for_cells(fabric: Fabric, capsys: pytest.CaptureFixture[str]) -> None:
    """A cell cannot create its history, but it fills the one that the administrator has created."""
    prepare = ["fabric", "prepare", "--server", fabric.server.url, "--credentials", str(fabric.seed("admin"))]
    assert main([*prepare, "--history", A, "--keep-days", "2"]) == 0
    assert A in capsys.readouterr().out
    assert main([*prepare, "--keep-days", "2"]) == 1
    assert main([*prepare, "--history", A, "--keep-days", "-1"]) == 1

    async def check() -> None:
        a, b, admin = await fabric.join(A), await fabric.join(B), await fabric.join("admin")
        mine, other = History(CELL_A, FabricHistory(keep_days=2)), History(CELL_B, FabricHistory())
        await mine.begin(a)
        assert not mine.problem
        await other.begin(b)
        assert f"shmio fabric prepare --history {B}" in other.problem
        await a.jetstream().publish(CELL_A.live("cell"), b"x")
        assert (await admin.jetstream().stream_info(CELL_A.history)).state.messages == 1
        for user in (a, b, admin):
            await user.close()

    asyncio.run(check())


def test_mirrors_ignore_what_a_history_reader_lets_the_server_send(
    fabric: Fabric, capsys: pytest.CaptureFixture[str]
) -> None:
    """A consumer delivers stored messages of one cell to the subject of another one."""
    prepare = ["fabric", "prepare", "--server", fabric.server.url, "--credentials", str(fabric.seed("admin"))]
    assert main([*prepare, "--history", A]) == 0
    assert main(["fabric", "server-config", "-o", str(fabric.folder), "--history-reader", "archive"]) == 0
    fabric.server.reload()
    taken: queue.Queue[bytes] = queue.Queue()
    access = Access((fabric.server.url,), credentials=str(fabric.seed(A)))
    link = Link(access, CELL_B, "cell", "mirror", CELL_A, taken.put, lambda _: None)
    link.start()

    async def check() -> None:
        a, b, reader = await fabric.join(A), await fabric.join(B), await fabric.join("archive")
        while not link.connected:  # noqa: ASYNC110  another thread changes it
            await asyncio.sleep(0.01)
        await a.jetstream().publish(CELL_A.live("cell"), b"forged")
        config = {"name": "x", "deliver_subject": CELL_B.live("cell"), "ack_policy": "none"}
        request = json.dumps({"stream_name": CELL_A.history, "config": config}).encode()
        bare = await reader.request(f"$JS.API.CONSUMER.CREATE.{CELL_A.history}.x", request, timeout=5)
        assert b"error" not in bare.data
        for _ in range(3):
            await sender(b, CELL_B.live("cell"), b"genuine")()
            assert await asyncio.to_thread(taken.get, timeout=20) == b"genuine"
        for user in (a, b, reader):
            await user.close()

    try:
        asyncio.run(check())
    finally:
        link.close()


def test_only_the_administrator_prepares(tmp_path: Path, port: int, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "nats"
    assert main(["fabric", "server-config", "-o", str(folder), "--cell", A, "--listen", f"127.0.0.1:{port}"]) == 0
    with running(folder / "nats-server.conf", port) as server:
        seed = str(folder / f"cells/{A}.seed")
        assert main(["fabric", "cells", "--server", server.url, "--credentials", seed]) == 1
        assert "run shmio fabric prepare" in one_line(capsys)


@pytest.fixture
def pem(tmp_path: Path) -> dict[str, str]:
    authority = trustme.CA()
    cert = authority.issue_cert("127.0.0.1", "localhost")
    files = {"ca": tmp_path / "ca.pem", "certificate": tmp_path / "cert.pem", "key": tmp_path / "key.pem"}
    authority.cert_pem.write_to_path(files["ca"])
    cert.cert_chain_pems[0].write_to_path(files["certificate"])
    cert.private_key_pem.write_to_path(files["key"])
    return {name: str(file) for name, file in files.items()}


def test_tls_is_required_when_configured(
    tmp_path: Path, port: int, pem: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "nats"
    given = ["--certificate", pem["certificate"], "--key", pem["key"], "--listen", f"0.0.0.0:{port}"]
    assert main(["fabric", "server-config", "-o", str(folder), "--viewer", "eye", *given]) == 0
    with running(folder / "nats-server.conf", port) as server:
        url, seed = f"tls://127.0.0.1:{port}", str(folder / "admin.seed")
        assert main(["fabric", "prepare", "--server", url, "--credentials", seed, "--ca", pem["ca"]]) == 0
        capsys.readouterr()
        assert main(["fabric", "cells", "--server", url, "--credentials", seed]) == 1  # an unknown authority
        assert "certificate" in capsys.readouterr().err

        async def in_plain_text() -> None:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            assert b'"tls_required":true' in await reader.readline()
            writer.write(b"CONNECT {}\r\nPING\r\n")
            assert b"PONG" not in await reader.read()
            writer.close()

        asyncio.run(in_plain_text())
        assert server.url


def test_the_printed_command_reaches_the_server(
    tmp_path: Path, port: int, pem: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "nats"
    given = ["--certificate", pem["certificate"], "--key", pem["key"], "--listen", f"127.0.0.1:{port}"]
    assert main(["fabric", "server-config", "-o", str(folder), *given]) == 0
    assert main(["fabric", "server-config", "-o", str(tmp_path / "farm"), "--farm-user", "lab", *given]) == 0
    out, _, farm = capsys.readouterr().out.partition(f"wrote {tmp_path / 'farm'}")
    assert f"--credentials of shmio-campaign worker --farm tls://127.0.0.1:{port}" in farm
    assert "prepare" not in farm, "a farm needs no registry"
    assert "fabric.credentials" not in farm
    command = out.partition("then run shmio ")[2].partition(" once")[0].split()
    with running(folder / "nats-server.conf", port):
        assert main(command) == 0, capsys.readouterr().err


def test_clients_need_a_certificate_of_the_given_authority(tmp_path: Path, port: int, pem: dict[str, str]) -> None:
    folder = tmp_path / "nats"
    given = [f"--{name}={file}" for name, file in pem.items()]
    assert main(["fabric", "server-config", "-o", str(folder), "--listen", f"127.0.0.1:{port}", *given]) == 0
    with running(folder / "nats-server.conf", port):
        access = ["--server", f"tls://127.0.0.1:{port}", "--credentials", str(folder / "admin.seed")]
        assert main(["fabric", "prepare", *access, "--ca", pem["ca"]]) == 1
        assert main(["fabric", "prepare", *access, *given]) == 0


def test_servers_of_a_cluster_share_the_registry(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "nats"
    with ExitStack() as stack:
        ports = [stack.enter_context(reserved_port()).port for _ in range(3)]
        _run_cluster(folder, ports, capsys)


def _run_cluster(folder: Path, ports: list[int], capsys: pytest.CaptureFixture[str]) -> None:
    listen = [f"127.0.0.1:{port}" for port in ports]
    users = ["--cell", A, "--farm-user", "lab"]
    assert main(["fabric", "server-config", "-o", str(folder), *users, "--listen", *listen]) == 0
    servers = [Server(folder / f"nats-server-{number}.conf", port) for number, port in enumerate(ports, 1)]
    try:
        prepare = ["fabric", "prepare", "--replicas", "3", "--credentials", str(folder / "admin.seed")]
        end = asyncio.run(_until(lambda: main([*prepare, "--server", servers[0].url]) == 0))
        assert end, capsys.readouterr().err

        async def spread(cell: FabricClient) -> None:
            """An older registry, which one server keeps, follows a cell whose history more servers keep."""
            admin = await connect(Access((servers[0].url,), credentials=str(folder / "admin.seed")), "a", patient=False)
            stream = admin.jetstream()
            for bucket in BUCKETS:
                config = (await stream.stream_info(f"KV_{bucket}")).config
                assert config.num_replicas == 3
                config.num_replicas = 1
                await stream.update_stream(config)
            with pytest.raises(RemoteError, match="this user may not change it"):
                await (await Registry.open(cell)).spread(3)
            await (await Registry.open(admin)).spread(3)
            assert {(await stream.stream_info(f"KV_{bucket}")).config.num_replicas for bucket in BUCKETS} == {3}
            await admin.close()

        async def check() -> None:
            seed = str(folder / f"cells/{A}.seed")
            near = await connect(Access((servers[0].url,), credentials=seed), "near", patient=False)
            far = await connect(Access((servers[2].url,), credentials=seed), "far", patient=False)
            await (await Registry.open(near)).claim(entry(A))
            assert await (await Registry.open(far)).find(A) is not None
            await spread(far)
            await near.close()
            await far.close()
            seed = str(folder / "farm-users/lab.seed")
            farm = await connect(Access((servers[1].url,), credentials=seed), "farm", patient=False)
            await contact(farm)
            await open_store(farm)
            replicas = [one.config.num_replicas for one in await farm.jetstream().streams_info()]
            assert replicas == [3, 3], "the queue and the bundles survive the loss of a server"
            await farm.close()

        asyncio.run(check())
    finally:
        for server in servers:
            server.stop()


async def _until(done: Callable[[], bool]) -> bool:
    for _ in range(20):
        if await asyncio.to_thread(done):
            return True
        await asyncio.sleep(0.5)
    return False


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--cell", "a50"], "--cell: 'a50' is not the name of a cell"),
        (["--viewer", "../x"], "--viewer: '../x' is not a name"),
        (["--listen", "0.0.0.0:4222"], "in plain text; give --certificate and --key, or --insecure"),
        (["--listen", "nats"], "--listen: 'nats' is not an address"),
        (["--listen", "127.0.0.1:0"], "choose a port"),
        (["--insecure", "--listen", "0.0.0.0:4222", "b:4222"], "name or address"),
        (["--certificate", "none.pem"], "both --certificate and --key"),
        (["--certificate", "none.pem", "--key", "none.pem"], "none.pem: No such file"),
    ],
)
def test_faulty_options_write_nothing(
    given: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fabric", "server-config", "-o", str(tmp_path / "nats"), *given]) == 1
    assert words in capsys.readouterr().err
    assert not (tmp_path / "nats").exists()


def test_open_seeds_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fabric", "server-config", "-o", str(tmp_path), "--cell", A]) == 0
    seed = tmp_path / f"cells/{A}.seed"
    seed.chmod(0o644)
    assert main(["fabric", "server-config", "-o", str(tmp_path), "--viewer", "eye"]) == 1
    assert "chmod 600" in capsys.readouterr().err
