"""The user's verbs with --host: the same output as on the instance's own host."""

from __future__ import annotations

import asyncio
import json
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest

from shmio.cli.user import main
from shmio.segment import Segment
from shmio.testing.cell import BIN
from tests.unit.endpoints.conftest import segment as segment  # noqa: PLC0414  the fixture
from tests.unit.endpoints.grpc.services.test_publish import with_plant
from tests.unit.endpoints.harness import Endpoint
from tests.unit.endpoints.plant import Plant
from tests.unit.endpoints.stepped import Model, simulate, stepped_segment

EXAMPLES = Path(__file__).parents[3] / "examples"

Output = Callable[..., tuple[int, str, str]]
Test = Callable[[Output, Output, Plant], None]


def both(segment: Segment, capsys: pytest.CaptureFixture[str], test: Test) -> None:
    """Run a test with two functions that call a command: with ``--host`` and locally."""

    async def run(served: Endpoint, device: Plant) -> None:
        def verb(*words: str) -> tuple[int, str, str]:
            capsys.readouterr()
            status = 2
            with suppress(SystemExit):
                status = main(words)
            out, err = capsys.readouterr()
            return status, out, err

        def remote(name: str, *words: str) -> tuple[int, str, str]:
            return verb(name, "--host", f"127.0.0.1:{served.port}", *words)

        def local(name: str, *words: str) -> tuple[int, str, str]:
            return verb(name, "--instance", segment.instance, *words)

        device.memory[0:4] = b"\x3d\xcc\xcc\xcd"  # 0.1
        device.memory[16:21] = b"\x08\x03abc"
        device.cycle()
        await asyncio.to_thread(test, remote, local, device)

    with_plant(segment, run, running=False)


@pytest.mark.parametrize(
    "words",
    [
        ("list",),
        ("list", "--json", "cell"),
        ("list", "cell/axis", "cell/inputs/1"),
        ("get", "cell"),
        ("get", "cell/long/2..4", "cell/axis/*", "running"),
        ("get", "--json", "cell/name", "cell/axis", "cell/inputs"),
        ("get", "cell/nothing"),
        ("get", "cell/axs/position"),
        ("get", "cell/x*"),
        ("get", "cell/step/in"),
        ("get", "SIMLOG://step"),
        ("watch", "-n", "2", "cell/axis"),
        ("watch", "--json", "-n", "3", "cell/axis", "cell/name"),
        ("inject",),
        ("inject", "--json"),
        ("inject", "--lift", "7"),
        ("set", "cell/nothing", "1"),
        ("set", "cell/*", "1"),
        ("set", "cell/step", "40000"),
        ("set", "cell/secret", "1"),
        ("get",),
    ],
)
def test_the_output_is_the_same(segment: Segment, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]) -> None:
    def test(remote: Output, local: Output, _: Plant) -> None:
        def comparable(result: tuple[int, str, str]) -> tuple[int, str, str]:
            status, out, err = result
            return status, re.sub(r'"age_s": [0-9.e-]+|"age_s": null', '"age_s": 0', out), err

        there, here = comparable(remote(*words)), comparable(local(*words))
        if words[0] == "watch":  # the order of the lines of one frame may differ
            assert sorted(there[1].splitlines()) == sorted(here[1].splitlines())
        else:
            assert there == here

    both(segment, capsys, test)


def test_set_and_inject(segment: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    def test(remote: Output, local: Output, device: Plant) -> None:
        device.run()
        assert remote("set", "cell/step", "7", "cell/running", "true")[1].splitlines() == [
            "cell/step     written",
            "cell/running  written",
        ]
        assert device.memory[13] == 7
        assert json.loads(remote("set", "--json", "cell/step", "8")[1])["cell/step"]["outcome"] == "written"
        status, out, _ = remote("inject", "--keep", "--name", "x", "cell/step", "9")
        assert status == 0
        number = out.partition(":")[0]
        assert remote("get", "cell/step")[1] == "cell/step  9  (injected)\n"
        assert json.loads(remote("get", "--json", "cell/step")[1])["cell/step"]["provenance"] == "injected"
        assert remote("inject")[1] == local("inject")[1]
        assert remote("inject", "--lift", number)[0] == 0
        assert remote("get", "cell/step")[1] == "cell/step  8\n"
        assert remote("inject", "--lift-all") == (0, "", "")

    both(segment, capsys, test)


CAMPAIGN = """
[[injection]]
name = "drift"
target = "cell/axis/position"
operation = "offset"
value = 2.5
when = "cell/running"
times = 1

[[injection]]
name = "noise"
target = "cell/step"
operation = "noise"
amplitude = 3
start_s = 1e6
"""


@pytest.fixture
def without_signals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let verbs run without signal handlers, which only the main thread may set."""
    monkeypatch.setattr("shmio.cli.inject.stop_on_signals", lambda: nullcontext(threading.Event()))


def lines(out: str) -> list[tuple[str, ...]]:
    """Return the words of each line, without those that differ from run to run."""
    return [tuple(re.sub(r"^.*?(?=\w+: )", "", line).split()) for line in out.splitlines()]


@pytest.mark.usefixtures("without_signals")
def test_campaign_file(segment: Segment, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "campaign.toml"
    file.write_text(CAMPAIGN)
    words = ("inject", "--seed", "7", "--file", str(file))

    def test(remote: Output, local: Output, device: Plant) -> None:
        device.run()
        there, here = remote(*words, "--for", "0.01"), local(*words, "--for", "0.01")
        assert there[::2] == here[::2] == (0, "")
        assert lines(there[1]) == lines(here[1])
        assert [line[0] for line in lines(there[1])][-2:] == ["injected:", "injected:"]
        assert local("inject") == (0, "", "")
        assert remote(*words, "--keep", "--json")[0] == 0
        assert remote("inject") == local("inject")
        assert remote("inject", "--json") == local("inject", "--json")
        told = [json.loads(line) for line in remote(*words, "--json", "--for", "0.01")[1].splitlines()]
        assert [(one.get("what"), one.get("text")) for one in told[-2:]] == [
            ("injected", "drift"),
            ("injected", "noise"),
        ]
        assert remote("inject", "--lift-all")[0] == 0
        assert local("inject") == (0, "", "")

    both(segment, capsys, test)


@pytest.mark.usefixtures("without_signals")
def test_inject_ends_when_the_campaign_is_over(
    segment: Segment, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "campaign.toml"
    file.write_text(CAMPAIGN.partition('\n[[injection]]\nname = "noise"')[0])

    def test(remote: Output, __: Output, device: Plant) -> None:
        device.run()
        flips = iter(range(1 << 30))

        def flip() -> None:
            while not over.wait(0.01):
                device.memory[8] = 8 * (next(flips) % 2)

        over = threading.Event()
        flipping = threading.Thread(target=flip)
        flipping.start()
        try:
            status, out, _ = remote("inject", "--json", "--seed", "1", "--file", str(file))
        finally:
            over.set()
            flipping.join()
        assert status == 0
        told = [json.loads(line) for line in out.splitlines()]
        assert [one["what"] for one in told if "what" in one] == ["injected", "activated", "deactivated", "lifted"]

    both(segment, capsys, test)


@pytest.mark.usefixtures("without_signals")
def test_faulty_file_injects_nothing(segment: Segment, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "campaign.toml"
    file.write_text(CAMPAIGN.replace("cell/step", "cell/stop"))

    def test(remote: Output, local: Output, _: Plant) -> None:
        words = ("inject", "--seed", "7", "--file", str(file))
        assert remote(*words) == local(*words)
        assert "injection[1].target: cell/stop: DB1 has no such register" in remote(*words)[2]
        assert remote("inject") == (0, "", "")

    both(segment, capsys, test)


def test_unusable_host_is_reported(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["get", "--host", "127.0.0.1:1", "cell"]) == 1
    assert capsys.readouterr().err == (
        "127.0.0.1:1: no instance serves there, or it has ended: nothing listens on that port\n"
    )
    assert main(["get", "--host", "nonsense", "cell"]) == 1
    assert capsys.readouterr().err == "'nonsense' is not an address; expected host:port, such as 127.0.0.1:8089\n"
    assert main(["get", "--host", "127.0.0.1:1", "--instance", "x", "cell"]) == 1
    assert capsys.readouterr().err == "--host already names the instance; remove -c and --instance\n"
    assert main(["get", "--host", "127.0.0.1:1", "--token-file", str(tmp_path / "none"), "cell"]) == 1
    assert capsys.readouterr().err == f"{tmp_path / 'none'}: No such file or directory\n"


def test_example_for_remote_access(segment: Segment) -> None:
    async def run(served: Endpoint, device: Plant) -> None:
        device.memory[13] = 7
        command = [sys.executable, str(EXAMPLES / "remote.py"), f"127.0.0.1:{served.port}", "cell/step", "--count", "1"]
        done = await asyncio.to_thread(subprocess.run, command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stderr
        assert re.search(r"cell/step +7\b", done.stdout)

    with_plant(segment, run)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ((sys.executable, str(EXAMPLES / "subscribe.py"), "{}", "cell/step"), "{}: the endpoint has stopped\n"),
        (
            (str(BIN / "shmio"), "watch", "--host", "{}", "cell/step"),
            "{}: no instance serves there, or it has ended: the endpoint has stopped\n",
        ),
    ],
)
def test_stopped_endpoint_is_reported(segment: Segment, words: tuple[str, ...], told: str) -> None:
    async def run(served: Endpoint, _: Plant) -> None:
        address = f"127.0.0.1:{served.port}"
        command = [word.format(address) for word in words]
        client = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        assert client.stdout is not None
        assert await asyncio.wait_for(client.stdout.readline(), 60)
        await served.server.stop()
        error = (await asyncio.wait_for(client.communicate(), 60))[1]
        assert (client.returncode, error.decode()) == (1, told.format(address))

    with_plant(segment, run)


def test_step(instance: str, capsys: pytest.CaptureFixture[str]) -> None:
    async def run(served: Endpoint, _: dict[str, Model]) -> None:
        def verb(*words: str) -> str:
            assert main(["step", "--host", f"127.0.0.1:{served.port}", *words]) == 0
            return capsys.readouterr().out

        told = json.loads(await asyncio.to_thread(verb, "--json", "--count", "2", "--dt-ms", "20"))
        assert (told["mode"], told["step"], told["time_s"]) == ("virtual", 2, 0.04)
        assert "0.040" in await asyncio.to_thread(verb, "--pause")

    simulate(instance, run)


def test_step_needs_consent_if_a_source_has_a_device(segment: Segment, capsys: pytest.CaptureFixture[str]) -> None:
    def test(remote: Output, local: Output, _: Plant) -> None:
        refused = remote("step")
        assert refused == local("step")
        assert (refused[0], "source cell continues in real time; to step anyway, add --yes" in refused[2]) == (1, True)
        assert remote("step", "--pause", "--yes")[0] == 0
        assert remote("step", "--pause")[0] == 0, "consent is needed only once"

    with Segment.open(segment.instance, writable=True) as opened:  # mapped again, as by another process
        both(opened, capsys, test)


def test_step_without_host(instance: str, capsys: pytest.CaptureFixture[str]) -> None:
    with stepped_segment(instance, "sim") as segment:
        model = Model(segment, "sim")
        try:
            assert main(["step", "--instance", instance, "--json"]) == 0
        finally:
            model.stop()
    assert json.loads(capsys.readouterr().out)["step"] == 1
