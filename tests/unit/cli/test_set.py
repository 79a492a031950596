"""``shmio set``: the values that it accepts, and the outcomes that it prints."""

from __future__ import annotations

import json
import math
import signal
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import pytest

import shmio
from shmio.cli.user import main
from shmio.connectors.commands import CommandProcessor
from shmio.connectors.output import Output
from shmio.errors import ConnectorError, ValueRangeError
from shmio.layout.model import Layout, Register
from shmio.layout.values.typed import read_value
from shmio.segment import Attributes, BlockSpec, BlockWriter, Segment

LAYOUT = Layout(
    "DB1",
    1,
    32,
    False,
    (
        Register("count", "INT", (), 0, None, 2, 1),
        Register("run", "BOOL", (), 2, 0, 1, 1),
        Register("speed", "REAL", (), 4, None, 4, 1),
        Register("name", "STRING[6]", (), 8, None, 8, 1),
        Register("wait", "TIME", (), 16, None, 4, 1),
        Register("row", "BYTE", ((1, 3),), 20, None, 3, 3),
        Register("secret", "INT", (), 24, None, 2, 1),
        Register("its place", "INT", (), 26, None, 2, 1),
    ),
)
WRITABLE = ("count", "run", "speed", "name", "wait", "row", "its place")


class Device:
    """A source that runs a cycle as soon as a command is waiting."""

    def __init__(self, writer: BlockWriter) -> None:
        self.memory = bytearray(LAYOUT.size)
        self.refusals: dict[int, str] = {}
        self.lost = False
        self.idle = False
        self.taken = threading.Event()
        self._writer = writer
        self._processor = CommandProcessor(Output(writer), WRITABLE, time.monotonic_ns, allow_nonfinite=["speed"])
        self._stop = threading.Event()
        self._threads = [threading.Thread(target=self._processor.run), threading.Thread(target=self._cycles)]
        self.processor.open()
        for thread in self._threads:
            thread.start()

    @property
    def processor(self) -> CommandProcessor:
        return self._processor

    def stop(self) -> None:
        self._stop.set()
        self._processor.stop()
        for thread in self._threads:
            thread.join(20)

    def _cycles(self) -> None:
        while not self._stop.wait(0.001):
            if not self._processor.waiting:
                continue
            self.taken.set()
            if not self.idle:
                try:
                    self._processor.carry_out(self._write)
                except ConnectorError as error:
                    self._processor.close(str(error))

    def _write(self, writes: Any) -> list[str]:
        if self.lost:
            raise ConnectorError("cable out")
        for offset, mask, data in writes:
            assert mask in (0, 1)
            self.memory[offset : offset + len(data)] = data
        return [self.refusals.get(write.offset, "") for write in writes]


@pytest.fixture
def device(instance: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> Iterator[Device]:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "supervisor.toml"
    file.write_text(f'[instance]\nname = "{instance}"\n')
    blocks = [
        BlockSpec(name, LAYOUT, 20_000_000, 3600 * 10**9, 1 << 16, Attributes("test", WRITABLE))
        for name in ("cell", "other")
    ]
    with Segment.create(instance, blocks, [], config=file.resolve()) as segment:
        device = Device(segment.writer("cell"))
        segment.writer("other")
        yield device
        device.stop()
        segment.unlink()


def register(path: str) -> Register:
    return LAYOUT.registers[LAYOUT.by_path[path]]


@pytest.mark.parametrize(
    ("path", "text", "value"),
    [
        ("count", "5", 5),
        ("count", "-5", -5),
        ("count", "5.0", 5),
        ("count", "16#FF", 255),
        ("count", "INT#-7", -7),
        ("count", "2#1010", 10),
        ("run", "true", True),
        ("run", "TRUE", True),
        ("run", "1", True),
        ("run", "FALSE", False),
        ("speed", "1.0E-4", 1e-4),
        ("speed", "2", 2.0),
        ("speed", "1_000.5", 1000.5),
        ("speed", "Infinity", math.inf),
        ("speed", '"-Infinity"', -math.inf),
        ("name", "'it$'s'", "it's"),
        ("name", '"a\\"b"', 'a"b'),
        ("wait", "T#1s", 1000),
        ("wait", "T#1m_500ms", 60_500),
        ("wait", "250", 250),
        ("row", "[1,2,3]", [1, 2, 3]),
        ("row", "[16#FF, 2(0)]", [255, 0, 0]),
        ("row", "1, 2, 3", [1, 2, 3]),
    ],
)
def test_a_value_is_json_or_a_literal(path: str, text: str, value: object) -> None:
    assert read_value(text, register(path)) == value


@pytest.mark.parametrize(
    ("path", "text", "message"),
    [
        ("count", "x", "expected a literal such as 0"),
        ("count", "40000", r"INT: 40000 is out of range -32768\.\.32767$"),
        ("count", "16#1FFFF", r"out of range -32768\.\.32767"),
        ("count", "1.5", "expected a whole number"),
        ("count", "[1]", "expected one INT"),
        ("count", "null", "expected one INT"),
        ("count", "true", "expected a number"),
        ("run", "2", "expected true or false"),
        ("speed", '"fast"', "expected a number"),
        ("speed", "1e400", r"out of range -3\.4028235e\+38\.\.3\.4028235e\+38"),
        ("speed", "1e39", r"out of range -3\.4028235e\+38\.\.3\.4028235e\+38"),
        ("wait", "2147483648", r"out of range -2147483648\.\.2147483647"),
        ("name", "hello", "put text in quotes, and these in quotes for the shell"),
        ("name", "5", "put text in quotes"),
        ("name", f"'{'x' * 60}'", r"the text has 60 characters, but at most [0-9]+ are allowed\Z"),
        ("wait", "T#1x", "expected a literal"),
        ("row", "[1,2]", "expected all of the array's 3 elements, found 2"),
        ("row", "[1,2,3,4]", "expected all of the array's 3 elements, found 4"),
        ("row", "[1, 16#2]", "found 2"),
        ("row", "[1, 2, 3, 16#4]", "found 4"),
        ("row", "5(0)", "found 4"),
        ("row", "7", "found 1"),
        ("row", "[1,2,300]", r"BYTE: 300 is out of range 0\.\.255"),
        ("row", "[[1,2,3]]", "found"),
        ("count", "9" * 6000, "expected a literal"),
        ("row", "[" * 20_000, "found"),
    ],
)
def test_invalid_value_is_refused(path: str, text: str, message: str) -> None:
    with pytest.raises(ValueRangeError, match=message) as caught:
        read_value(text, register(path))
    assert len(str(caught.value)) < 300


def test_values_are_written_and_each_outcome_is_printed(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        main(["set", "cell/count", "16#0203", "cell/run/in", "TRUE", "CELL://row/2", "-0", "cell/its place", "1"]) == 0
    )
    assert device.memory[:3] == b"\2\3\1"
    assert capsys.readouterr().out.splitlines() == [
        "cell/count      written",
        "cell/run        written",
        "cell/row/2      written",
        "cell/its place  written",
    ]


def test_json_output_is_an_object_by_path(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    device.refusals = {0: "locked"}
    assert main(["set", "--json", "cell/count", "1", "cell/run", "true"]) == 1
    out, err = capsys.readouterr()
    assert json.loads(out) == {
        "cell/count": {"outcome": "refused", "reason": "locked"},
        "cell/run": {"outcome": "written", "reason": ""},
        "error": "cell/count: the source refused the write: locked",
    }
    assert err == "cell/count: the source refused the write: locked\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cell/nothing", "1"], "cell/nothing: DB1 has no such register"),
        (["nothing/count", "1"], "'nothing' is not one of the 2 sources; begin the path with cell/… or other/…"),
        (["cell/COUNT", "1"], "did you mean 'cell/count'"),
        (["nope://count", "1"], "unknown source 'nope'; valid: cell, other"),
        (["cell/count/out", "1"], "leave out /out"),
        (["model/clock", "1"], "unknown source 'model'"),
        (["cell/count", "70000"], "cell/count: INT: 70000 is out of range -32768..32767\n"),
        (["cell/*n*", "1"], "cell/*n*: set takes one register, not a pattern; this one matches cell/count, cell/run, "),
        (["cell/**", "1"], "this one matches cell/count, cell/run, cell/speed, …\n"),
        (["cell/c*", "1"], "this one matches cell/count\n"),
        (["cell/z*", "1"], "this one matches nothing\n"),
        (["cell/row", "[1]"], "cell/row: expected all"),
        (
            ["cell/secret", "1"],
            "cell/secret is not writable; name it in the source",
        ),
        (["cell/count", "1", "CELL://count", "2"], "cell/count: this path is given twice"),
        (["cell", "1"], "names a source, not a register"),
    ],
)
def test_invalid_argument_is_refused_in_one_line_and_nothing_is_written(
    device: Device, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(["set", "cell/run", "true", *arguments]) == 1
    out, err = capsys.readouterr()
    assert out.strip() in ("", "{}")
    assert message in err
    assert err.count("\n") == 1
    assert device.memory == bytes(LAYOUT.size)


def test_source_without_its_device_rejects_the_values(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    device.processor.close("no answer from 10.0.0.1")
    assert main(["set", "cell/count", "1", "cell/run", "true"]) == 1
    out, err = capsys.readouterr()
    assert out.splitlines() == ["cell/count  rejected", "cell/run    rejected"]
    assert err == (
        "cell/count: not written, because the source did not accept the command: the source is not connected: no "
        "answer from 10.0.0.1; see shmio-supervisor status (and 1 more)\n"
    )


def test_command_for_a_restarted_source_can_be_repeated(
    device: Device, instance: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with Segment.open(instance, writable=True) as segment, ExitStack() as stack:
        queues = segment.blocks["other"].commands
        seen = queues.bell()

        def replace() -> None:
            queues.wait(seen, 20 * 10**9)  # until the command has come
            stack.callback(Device(segment.writer("other")).stop)

        replacing = threading.Thread(target=replace)
        replacing.start()
        assert main(["set", "other/count", "1"]) == 1
        replacing.join()
        assert capsys.readouterr().err == (
            "other/count: not written, because the source did not accept the command: the source was restarted "
            "after the command was sent; send it again; see shmio-supervisor status\n"
        )
        assert main(["set", "other/count", "1"]) == 0, "the remedy works"


def test_further_refusals_are_printed_with_their_reason(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    device.refusals = {0: "locked", 4: "worn out"}
    assert main(["set", "cell/count", "1", "cell/speed", "2", "cell/run", "true"]) == 1
    out, err = capsys.readouterr()
    assert out.splitlines() == ["cell/count  refused", "cell/speed  refused: worn out", "cell/run    written"]
    assert err == "cell/count: the source refused the write: locked (and 1 more)\n"


def test_unknown_outcome_is_reported_with_a_remedy(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    device.lost = True
    assert main(["set", "cell/its place", "1"]) == 1
    _, err = capsys.readouterr()
    assert "cable out" in err
    assert "check the value with shmio get 'cell/its place' before you write it again" in err


def test_timeout_limits_the_wait(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    device.idle = True
    assert main(["set", "--timeout", "0.2", "cell/count", "1"]) == 1
    assert "no cycle began before the command's deadline" in capsys.readouterr().err


def test_each_source_gets_its_own_command_and_partial_success_is_printed(
    device: Device, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["set", "--timeout", "0.2", "cell/count", "5", "other/count", "6"]) == 1
    out, err = capsys.readouterr()
    assert out.splitlines()[0] == "cell/count   written"
    assert err.startswith("other/count: the source gave no answer in time")
    assert device.memory[1] == 5


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["cell/count"],
        ["cell/count", "1", "cell/run"],
        ["--timeout", "0", "cell/count", "1"],
        ["--timeout", "nan", "cell/count", "1"],
        ["--timeout", "x", "cell/count", "1"],
    ],
)
def test_wrong_usage(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["set", *arguments])
    assert stop.value.code == 2
    assert "usage: shmio" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("path", "text", "value"),
    [
        ("cell/count", "-3", -3),
        ("cell/count", "-16#A", -10),
        ("cell/speed", "-1.5e-3", pytest.approx(-1.5e-3)),
        ("cell/speed", "-Infinity", -math.inf),
    ],
)
@pytest.mark.parametrize("before", [[], ["--"], ["--timeout", "60"]])
def test_negative_number_is_a_value_not_an_option(
    device: Device, path: str, text: str, value: float, before: list[str]
) -> None:
    assert main(["set", *before, path, text]) == 0
    at, form = (0, ">h") if path == "cell/count" else (4, ">f")
    assert struct.unpack_from(form, device.memory, at)[0] == value


def test_message_quotes_a_negative_number_as_it_was_typed(device: Device, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, said in (
        (["--timeout", "-1e3", "cell/speed", "1"], "'-1e3' is not a number of seconds above 0"),
        (["cell/speed", "1", "-1e3"], "'-1e3' has no value"),
    ):
        with pytest.raises(SystemExit):
            main(["set", *arguments])
        assert said in capsys.readouterr().err


def test_ctrl_c_while_waiting_frees_the_command_queue(
    device: Device, instance: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    device.idle = True

    def interrupt() -> None:
        device.taken.wait(20)
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    assert main(["set", "--timeout", "600", "cell/count", "1"]) == 130
    thread.join()
    device.idle = False
    with shmio.attach(instance, writable=True) as cell:  # the queue of the ended command is free again
        assert cell.write({"cell/count": 2})[0].done
