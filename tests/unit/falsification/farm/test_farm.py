"""A search whose trials run on workers: same results as without them, whatever happens to workers and server."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import nats
import nkeys  # type: ignore[import-untyped]
import pytest
from msgspec.structs import replace
from nats.aio.msg import Msg

from shmio.cli.campaign import main
from shmio.errors import ConfigError, RemoteError
from shmio.fabric.client import FabricClient
from shmio.fabric.connection import Access, call_once
from shmio.falsification.farm.bundle import Bundle, make_bundle
from shmio.falsification.farm.environment import environment_of, own
from shmio.falsification.farm.exchange import open_queue, open_store, try_access
from shmio.falsification.farm.pool import FarmPool
from shmio.falsification.farm.worker import Worker
from shmio.falsification.trial import Result, Task
from tests.nats_server import NatsServer, lose_cancellation, nats_server

CONFIG = """
[instance]
name = "farm-test"
clock = "stepped"

[[source]]
name = "lift"
connector = "simulation"
model = "farm_lift:Lift"
period_ms = 20
"""
MODEL = """
import os
import time
from pathlib import Path

from farm_parts.rope import LENGTH
from shmio.simulation import Input, Model, Output, Parameter

class Lift(Model):
    speed = Input("LREAL", initial=1.0)
    height = Output("LREAL")
    gain = Parameter("LREAL", initial=1.0)
    wait = Parameter("LREAL", initial=0.0)

    def start(self):
        self.data = (Path(__file__).parent / "gain.txt").read_text()

    def step(self, time_s, dt_s):
        self.height += float(self.data) * LENGTH * self.gain * self.speed * dt_s
        if self.wait > 0 and time_s > 0.05:
            here = Path({place!r})
            (here / f"waits-{{os.getpid()}}").touch()
            while not (here / "go").exists():
                time.sleep(0.01)
        if self.gain > 1.45:
            raise ValueError("too fast in " + __file__)
"""
CAMPAIGN = """
config = "supervisor.toml"
duration_s = 0.4

[parameters.lift]
gain = { from = 0.5, to = 1.5 }

[[injection]]
name = "push"
target = "lift/height"
operation = "offset"
value = { from = 2, to = 4.9 }
start_s = { from = 0, to = 0.3, step = 0.02 }
for_s = 0.1

[[expect]]
name = "low"
always = "lift/height < 5"
"""
PUBLISH = ["shmio_farm.>", "$JS.API.>", "$JS.ACK.>", "$O.shmio_farm.>"]
SUBSCRIBE = ["shmio_farm.>", "_INBOX.>"]
"""What docs/how-to/find-a-failing-alteration.md lets a user of a farm do."""
TRIAL = {
    "duration_s": 0.2,
    "step_ms": 20.0,
    "expect": [{"name": "low", "always": "lift/height < 0.5"}],
}
OFFER: dict[str, Any] = {
    "search": "0" * 16, "host": "h", "campaign": "c", "digest": "0" * 64, "root": "/", "config": "../../etc/x",
    "folder": ".", "limit_s": 1.0, "environment": {},
}  # fmt: skip
"""An offer of a search that has no files."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "cell"
    (folder / "farm_parts").mkdir(parents=True)
    for name, text in (
        ("farm_parts/rope.py", "LENGTH = 1.0"),
        ("farm_lift.py", MODEL.format(place=str(tmp_path))),
        ("gain.txt", "1.0"),
        ("supervisor.toml", CONFIG),
        ("campaign.toml", CAMPAIGN),
    ):
        (folder / name).write_text(text)
    return folder


@pytest.fixture
def server(tmp_path: Path) -> Iterator[NatsServer]:
    with nats_server(tmp_path / "nats") as found:
        yield found


@contextmanager
def worker(server: NatsServer, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Run a worker that is connected."""
    command = [sys.executable, "-m", "shmio.cli.campaign", "worker", "--farm", server.url, *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as one:
        try:
            until(one, "waiting for searches")
            yield one
        finally:
            one.terminate()


def until(process: subprocess.Popen[str], text: str) -> str:
    """Read standard error until a line has a text, and return the line."""
    assert process.stderr is not None
    seen = []
    for line in process.stderr:
        seen.append(line)
        if text in line:
            return line
    raise AssertionError("".join(seen))


def pool(
    server: NatsServer, bundle: Bundle, told: list[str], credentials: str | None = None, **environment: str
) -> FarmPool:
    return FarmPool(
        Access((server.url,), credentials=credentials), bundle, own() | environment, "campaign.toml", 2, 60, told.append
    )


@pytest.fixture
def bundle(folder: Path) -> Bundle:
    return make_bundle(folder / "supervisor.toml", folder / "campaign.toml", TRIAL, [folder / "gain.txt"])


def task(number: int, **parameters: float) -> Task:
    return Task(number, {**TRIAL, "parameters": {"lift": parameters}})


def results(farm: FarmPool, count: int) -> dict[int, Result]:
    found: list[Result] = []
    while len(found) < count:
        found += farm.wait(1)
    return {one.number: one for one in found}


def waiting(folder: Path, count: int) -> list[int]:
    """Wait until some trials wait for the file that lets them go on; return the ids of their processes."""
    while len(found := list(folder.parent.glob("waits-*"))) < count:
        time.sleep(0.01)  # another process creates them
    return [int(one.name.partition("-")[2]) for one in found]


def parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def journal(folder: Path) -> list[Any]:
    """Return the lines of a search without the times that trials took."""
    lines = [json.loads(line) for line in (folder / "trials.jsonl").read_text().splitlines()]
    for one in lines:
        if one.get("result"):
            del one["result"]["taken_s"]
    return lines


def contents(folder: Path) -> dict[str, bytes]:
    """Return the campaigns of all cases. Each has the digest of its recording, which also has the host's clocks."""
    return {file.parent.name: file.read_bytes() for file in folder.glob("case-*/campaign.toml")}


def test_a_farm_gives_the_same_journal_and_cases_although_a_worker_is_killed(
    folder: Path, server: NatsServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    words = ["falsify", "campaign.toml", "--search", "random", "--seed", "334", "--all", "--jobs", "2"]
    words += ["--trials", "6", "--shrink", "1", "-o", "out"]
    assert main(words) == 1
    (folder / "out").rename(folder / "local")
    with worker(server) as first, worker(server):
        whole = [sys.executable, "-m", "shmio.cli.campaign", *words, "--farm", server.url, "--send", "gain.txt"]
        with subprocess.Popen(whole, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as search:
            until(search, "the workers get 4 files")
            assert "2 workers" in until(search, " of 6 trials")
            first.kill()
            _, said = search.communicate()
        assert search.returncode == 1, said
    assert journal(folder / "out") == journal(folder / "local")
    assert contents(folder / "local").keys() == {"case-001"}
    assert contents(folder / "out") == contents(folder / "local")
    assert any("too fast in /" in str(line) for line in journal(folder / "out")), "errors are equal, too"


@pytest.fixture
def credentials(tmp_path: Path) -> tuple[str, str]:
    """Return a file with the seed of a user, and the user's public key."""
    file = tmp_path / "farm.nk"
    seed = nkeys.encode_seed(os.urandom(32), nkeys.PREFIX_BYTE_USER)
    file.write_bytes(seed)
    file.chmod(0o600)
    return str(file), nkeys.from_seed(bytearray(seed)).public_key.decode()


def test_the_trial_of_a_dead_worker_is_repeated_although_users_may_do_only_what_is_needed(
    folder: Path, tmp_path: Path, bundle: Bundle, credentials: tuple[str, str]
) -> None:
    told: list[str] = []
    seed, key = credentials
    user = {"nkey": key, "permissions": {"publish": PUBLISH, "subscribe": SUBSCRIBE}}
    with (
        nats_server(tmp_path / "nats", authorization={"users": [user]}) as server,
        worker(server, "--credentials", seed) as first,
        pool(server, bundle, told, seed) as farm,
    ):
        farm.submit(task(7, wait=1))
        (running,) = waiting(folder, 1)
        assert parent(running) == first.pid
        farm.submit(task(8))
        assert farm.idle == 0
        first.kill()
        with worker(server, "--credentials", seed) as second:
            (folder.parent / f"waits-{running}").unlink()
            (again,) = waiting(folder, 1)
            assert parent(again) == second.pid
            (folder.parent / "go").touch()
            found = results(farm, 2)
            assert {number: one.status for number, one in found.items()} == {7: "passed", 8: "passed"}
            assert found[7].simulated_s == pytest.approx(0.2)
            assert farm.idle == 2
    assert not Path(f"/proc/{running}").exists(), "it ended with its worker"
    assert told == []


def test_a_search_survives_a_new_start_of_the_server_and_can_cancel(
    folder: Path, server: NatsServer, bundle: Bundle
) -> None:
    told: list[str] = []
    with worker(server) as one:
        with pool(server, bundle, told) as farm:
            farm.submit(task(1, wait=1))
            farm.submit(task(2))
            waiting(folder, 1)
            server.stop(signal.SIGKILL)
            (folder.parent / "go").touch()
            until(one, "connection is lost")
            server.start()
            assert {number: one.status for number, one in results(farm, 2).items()} == {1: "passed", 2: "passed"}
            assert any("connection is lost" in line for line in told)
            (folder.parent / "go").unlink()
            for old in folder.parent.glob("waits-*"):
                old.unlink()
            farm.submit(task(3, wait=1))
            farm.submit(task(4, wait=1))
            (pid,) = waiting(folder, 1)
            farm.cancel()
            assert farm.idle == 2
            farm.submit(task(5))
            assert results(farm, 1).keys() == {5}
            assert not Path(f"/proc/{pid}").exists()
        until(one, "is over: 3 trials")


def test_workers_that_are_missing_or_different_are_named(server: NatsServer, bundle: Bundle) -> None:
    told: list[str] = []

    def look(farm: FarmPool, text: str) -> None:
        while not any(re.search(text, line) for line in told):
            assert farm.wait(0.1) == []

    with pool(server, bundle, told) as farm:
        look(farm, f"no worker; start one .* shmio-campaign worker --farm {server.url}")
        assert farm.workers == 0
    with worker(server) as one, pool(server, bundle, told, msgspec="0.1", nothing="3") as farm:
        farm.submit(task(1))
        look(farm, rf"pid {one.pid}.*msgspec is 0\.\d+\.\d+ here, but 0\.1 on .*; nothing is not installed here, but 3")
        until(one, "msgspec is")
        assert farm.workers == 0
    with worker(server) as one, pool(server, bundle, told, shmio="0.0.1 (code 1)") as farm:
        look(farm, r"shmio is .*code .* here, but 0\.0\.1")
    server.stop()
    with pytest.raises(RemoteError, match="no NATS server can be reached"), pool(server, bundle, told):
        pass


def test_the_command_for_a_worker_has_the_credentials(
    tmp_path: Path, bundle: Bundle, credentials: tuple[str, str]
) -> None:
    told: list[str] = []
    seed, key = credentials
    with nats_server(tmp_path / "nats", authorization={"users": [{"nkey": key}]}) as server:
        with pool(server, bundle, told, seed) as farm:
            while not told:
                assert farm.wait(0.1) == []
        assert told[0].endswith(f"worker --farm {server.url} --credentials {seed}")
        with pytest.raises(ConfigError, match="asks for credentials"), pool(server, bundle, told):
            pass


def test_wrong_options_are_named_before_the_search(
    server: NatsServer, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    for words, error in (
        (["--farm", "nats://192.0.2.1:4222"], "plain text"),
        (["--farm", "http://127.0.0.1"], "not a NATS server"),
        (["--farm", "nats://u:p@127.0.0.1"], "--credentials"),
        (["--send", "gain.txt"], "only for --farm"),
        (["--farm", server.url, "--send=gain.txt", "--credentials", "farm.nk"], "--credentials: farm.nk: No such file"),
        (["--farm", server.url, "--send=gain.txt", "--ca", "farm.pem"], "--ca: farm.pem"),
    ):
        assert main(["falsify", "campaign.toml", "-o", "out", *words]) == 2
        assert error in capsys.readouterr().err
    assert not (folder / "out").exists(), "the next attempt needs no --resume"


def test_files_that_the_models_need_are_named_before_the_search(folder: Path) -> None:
    def problem(*more: Path) -> str:
        return environment_of(make_bundle(folder / "supervisor.toml", folder / "campaign.toml", TRIAL, more))[1]

    assert "gain.txt" in problem()
    assert problem(folder / "gain.txt") == ""
    (folder / "farm_parts").rename(folder / ".farm_parts")
    (folder / "farm_parts").symlink_to(".farm_parts")
    with pytest.raises(ConfigError, match=r"--send.*farm_parts"):
        problem(folder / "gain.txt")


async def publish(url: str, subject: str, *messages: bytes) -> None:
    client = await nats.connect(url)
    for message in messages:
        await client.publish(subject, message)
    await client.drain()


async def heard(url: str, subject: str) -> bytes:
    client = await nats.connect(url)
    subscription = await client.subscribe(subject)
    message = await subscription.next_msg(timeout=30)
    await client.close()
    return message.data


def test_a_result_that_comes_again_does_not_count_again(server: NatsServer, bundle: Bundle) -> None:
    with pool(server, bundle, []) as farm:
        search = json.loads(asyncio.run(heard(server.url, "shmio_farm.offer")))["search"]

        def answer(*numbers: int) -> None:
            results = [msgspec.json.encode(Result(number, "passed")) for number in numbers]
            asyncio.run(publish(server.url, f"shmio_farm.result.{search}", b"{}", *results))

        farm.submit(task(7))
        answer(0, 0, 1)
        assert results(farm, 1).keys() == {7}
        farm.submit(task(8))
        farm.submit(task(9))
        answer(0, 2, 2)
        assert results(farm, 1).keys() == {9}
        answer(0, 1)
        assert results(farm, 1).keys() == {8}
        assert farm.wait(0.1) == []
        assert farm.idle == 2


def test_a_search_ends_although_a_cancellation_is_lost(
    server: NatsServer, bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits = lose_cancellation(monkeypatch, "PURGE")
    with pool(server, bundle, []) as farm:
        farm.cancel()
        assert waits.wait(30)


def test_a_worker_ends_although_a_cancellation_is_lost(
    server: NatsServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The request for its files fails, and would be repeated for ever."""

    async def work() -> None:
        stop, ready, refused = asyncio.Event(), asyncio.Event(), asyncio.Event()

        def tell(line: str) -> None:
            if "waiting for searches" in line:
                ready.set()
            if "is not served" in line:
                refused.set()

        running = asyncio.create_task(Worker(Access((server.url,)), 1, tmp_path / "work", tell).run(stop))
        await asyncio.wait_for(ready.wait(), 30)
        waits = lose_cancellation(monkeypatch, "STREAM.INFO.OBJ_")
        await publish(server.url, "shmio_farm.offer", json.dumps(OFFER).encode())
        assert await asyncio.to_thread(waits.wait, 30)
        await publish(server.url, "shmio_farm.offer", json.dumps({**OFFER, "over": True}).encode())
        await asyncio.wait_for(refused.wait(), 30)
        stop.set()
        await asyncio.wait_for(running, 30)

    asyncio.run(work())


def test_a_worker_says_once_why_it_waits(server: NatsServer, tmp_path: Path) -> None:
    server.stop()
    told: list[str] = []

    async def work() -> None:
        stop = asyncio.Event()

        def hear(record: logging.LogRecord) -> bool:
            told.append(record.getMessage())
            stop.set()
            return False

        log = logging.getLogger("shmio.fabric")
        log.addFilter(hear)
        try:
            await asyncio.wait_for(Worker(Access((server.url,)), 1, tmp_path / "work", told.append).run(stop), 30)
        finally:
            log.removeFilter(hear)

    asyncio.run(work())
    (line,) = told
    assert re.search("no NATS server can be reached.*trying again", line)


@pytest.mark.parametrize(("code", "said"), [(10_005, "on 3 servers: no suitable.*start"), (10_023, "no space")])
def test_a_cluster_that_cannot_keep_the_queue_is_named(
    code: int, said: str, server: NatsServer, bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The queue on one server would not survive its loss."""
    ask = FabricClient.request
    error = {"code": 400, "err_code": code, "description": "no suitable peers" if code == 10_005 else "no space"}

    async def request(client: FabricClient, subject: str, data: bytes, *arguments: Any, **options: Any) -> Msg:
        if "STREAM.CREATE" in subject and json.loads(data)["num_replicas"] == 3:
            return Msg(client, data=json.dumps({"error": error}).encode())
        return await ask(client, subject, data, *arguments, **options)

    monkeypatch.setattr(FabricClient, "request", request)
    with pytest.raises(RemoteError, match=said), pool(server, bundle, []):
        pass


STATE = ("messages", "bytes", "first_seq", "last_seq", "consumer_count")


@pytest.mark.parametrize(
    ("code", "said"), [(0, ""), (10_005, "kept by only 1 server.*no suitable peers"), (10_074, "")]
)
def test_a_queue_of_a_single_server_is_kept_by_the_cluster_that_it_joins(
    code: int, said: str, server: NatsServer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    ask, asked = FabricClient.request, dict[str, int]()

    async def request(client: FabricClient, subject: str, data: bytes, *arguments: Any, **options: Any) -> Msg:
        if "STREAM.UPDATE" not in subject:
            return await ask(client, subject, data, *arguments, **options)
        config = json.loads(data)
        asked[config["name"]] = config["num_replicas"]
        error = {"code": 400, "err_code": code, "description": "no suitable peers"}
        answer = {"error": error} if code else {"config": config, "state": dict.fromkeys(STATE, 0)}
        return Msg(client, data=json.dumps(answer).encode())

    async def prepare(client: Any) -> None:
        await open_queue(client)
        await open_store(client)

    asyncio.run(call_once(Access((server.url,)), prepare))
    monkeypatch.setattr(FabricClient, "request", request)
    asyncio.run(try_access(Access((server.url,))))
    assert asked == {"shmio_farm": 3, "OBJ_shmio_farm": 3}
    assert re.search(said, caplog.text)
    assert bool(caplog.text) is bool(said)


def test_hostile_messages_do_not_stop_a_worker(server: NatsServer, bundle: Bundle) -> None:
    """Offers are checked, and a bundle must have its digest."""
    bad: list[Any] = [None, [], {**OFFER, "search": "../../x"}, {**OFFER, "digest": 1}, {**OFFER, "limit_s": -1}]
    with worker(server) as one:
        offers = [json.dumps(offer).encode() for offer in [*bad, OFFER]]
        asyncio.run(publish(server.url, "shmio_farm.offer", b"\xff", *offers))
        assert "its files cannot be fetched" in until(one, "is not served")
        with pool(server, bundle, []) as farm:
            farm.submit(task(1))
            assert results(farm, 1)[1].status == "passed"
        outside = replace(bundle, config="../../etc/passwd")
        with pool(server, outside, []):
            assert "does not lead into its folder" in until(one, "is not served")
        one.send_signal(signal.SIGINT)
        assert one.wait() == 0
