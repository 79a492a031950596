"""A fetched span of the history equals the cell's own recording, and has a gap for all that is missing."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import pytest
import trustme

from shmio.cli.dump import main
from shmio.cli.supervisor import main as supervisor
from shmio.errors import RecordingError, RemoteError
from shmio.fabric.history import fetch
from shmio.fabric.messages import decode_entries, encode
from shmio.fabric.names import CellName
from shmio.recording.check import check
from shmio.recording.dump import open_dump
from shmio.recording.format.encoding import Reason
from shmio.recording.reading.reader import Reader
from shmio.segment import EventKind, Record, Segment
from tests.nats_server import nats_server
from tests.unit.fabric.stored import CELL, History, Stored, Uplink, late, recorded
from tests.unit.recorder.harness import OTHER, gaps, numbers, publish, spec


def checked(file: Path) -> Path:
    """Return the file of a recording without any problem."""
    with Reader(file) as reader:
        assert check(reader).texts() == []
    return file


def fetched(history: History, folder: Path, *times: int | None) -> Path:
    file = folder / "fetched.mem"
    file.unlink(missing_ok=True)
    fetch(history.place, file, *times)
    return checked(file)


def diff(one: Path, other: Path, capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, Any]:
    capsys.readouterr()
    status = main(["diff", str(one), str(other), "--json", *options])
    return status, json.loads(capsys.readouterr().out)


def test_names_of_streams_differ_for_all_cells() -> None:
    names = [CellName("a-b", "c", "d"), CellName("a", "b-c", "d"), CellName("a_b", "c", "d")]
    assert len({name.history for name in names}) == 3
    assert [CellName.of_history(name.history) for name in names] == names
    assert CellName.of_history("KV_shmio_cells") is None


def test_a_span_equals_the_cells_own_recording(
    segment: Segment, history: History, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Several sources, more than one batch, events, late messages after live ones, and duplicates."""
    history.create()
    uplink = Uplink(segment)
    messages: list[Stored] = []
    with recorded(segment, tmp_path / "own") as own:
        for turn in range(12):
            for source in ("cell", "press"):
                publish(segment.writer(source), 40, first=turn * 40)
            segment.writer("cell").event(Record(EventKind.QUALITY, f"turn {turn}"))
            messages += uplink.messages(each=1 + turn % 3)
            own.run_once()
    assert len(messages) > 500
    outage = messages[200:300]
    rest = [one for one in messages if one not in outage]
    history.publish(*rest[:200], *rest[200:], *map(late, outage), *rest[-50:], *map(late, outage[:10]))
    file = fetched(history, tmp_path)
    assert gaps(file) == []
    assert diff(own.output.path, file, capsys)[0] == 0
    for source in ("cell", "press"):
        assert numbers(file, source) == numbers(own.output.path, source) == list(range(1, 481))
    with open_dump([file]) as one, open_dump([own.output.path]) as other:
        assert [(entry.time_ns, entry.item) for entry in one.frames("cell")] == [
            (entry.time_ns, entry.item) for entry in other.frames("cell")
        ]
        assert one.about["started_utc_ns"] == other.about["started_utc_ns"]


def test_missing_messages_are_gaps_with_their_reason(segment: Segment, history: History, tmp_path: Path) -> None:
    history.create()
    uplink = Uplink(segment)
    publish(segment.writer("cell"), 30)
    event, *messages = uplink.messages()
    lost, damaged = messages[5:8], messages[15]
    broken = damaged._replace(data=damaged.data[:-1])
    noise = damaged._replace(data=b"not a message")
    intact = [one for one in messages if one not in lost and one is not damaged]
    history.publish(event, *intact[:10], broken, noise, *intact[10:])
    file = fetched(history, tmp_path)
    assert [(gap.first, gap.last, gap.reason) for gap in gaps(file)] == [
        (6, 8, Reason.NO_ROOM),
        (16, 16, Reason.DAMAGED),
    ]
    assert len(numbers(file)) == 26


def test_frames_that_a_rule_leaves_out_are_no_loss(segment: Segment, history: History, tmp_path: Path) -> None:
    history.create()
    uplink = Uplink(segment)
    publish(segment.writer("cell"), 9)
    items = [entry.item for entry in uplink._follower.take()[0] if hasattr(entry, "follower")][1:]
    block = segment.blocks["cell"]
    history.publish(*(uplink.message("cell", block.layout, items[at : at + 1], 2) for at in (0, 3, 6)))
    file = fetched(history, tmp_path)
    assert [(gap.first, gap.last, gap.reason) for gap in gaps(file)] == [
        (2, 3, Reason.LEFT_OUT),
        (5, 6, Reason.LEFT_OUT),
    ]


def test_what_the_uplink_missed_stays_a_gap(segment: Segment, history: History, tmp_path: Path) -> None:
    history.create()
    uplink = Uplink(segment)
    writer = segment.writer("cell")
    publish(writer, 3)
    messages = uplink.messages()
    publish(writer, 700)  # the ring has 512
    messages += uplink.messages(each=10)
    history.publish(*messages)
    (gap,) = gaps(fetched(history, tmp_path))
    assert gap.first == 4
    assert gap.reason is Reason.OVERTAKEN


def test_restarts_of_uplink_and_instance_and_a_reload(
    segment: Segment, history: History, instance: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    history.create(OTHER, segment.blocks["cell"].layout)
    uplink = Uplink(segment, stream=(1 << 63) - 5)
    publish(segment.writer("cell"), 5)
    messages = uplink.messages()
    publish(segment.writer("cell"), 3, first=5)
    again = Uplink(segment, stream=7)
    messages += again.messages()[8:]  # the uplink was restarted; it begins with new frames
    with Segment.create(f"{instance}-b", [spec("cell", OTHER)], []) as other:
        try:
            restarted = Uplink(other, stream=3)
            publish(other.writer("cell"), 4)
            messages += restarted.messages()
        finally:
            other.unlink()
    random.Random(1).shuffle(messages)
    history.publish(*messages)
    file = fetched(history, tmp_path)
    assert numbers(file) == [1, 2, 3, 4, 5, 7, 8, 1, 2, 3, 4]
    assert [(gap.what, gap.first, gap.last, gap.reason) for gap in gaps(file)] == [
        ("frames", 6, 6, Reason.NOT_RUNNING),
    ]
    with open_dump([file]) as dump:
        assert [block.layout.size for block in dump.blocks] == [2, 6]


@pytest.mark.parametrize("stalled", [False, True])
def test_a_span_of_time_is_found_by_the_owners_clock(
    segment: Segment, history: History, tmp_path: Path, stalled: bool
) -> None:
    """The server's clock differs from the owner's by a day, and late messages come at the end.

    If the uplink is stalled, it makes the messages of 30 s only after this time.
    """
    history.create()
    uplink = Uplink(segment)
    day_ns = 86_400 * 10**9
    messages: list[Stored] = []
    for turn in range(60):
        publish(segment.writer("cell"), 1, first=turn)
        for one in uplink.messages():
            times = {
                "made_ns": one.header.made_ns + day_ns + turn * 10**9,
                "zero_ns": one.header.zero_ns + day_ns + turn * 10**9,
            }
            messages.append(_with(one, **times))
    if stalled:
        messages[20:80] = [_with(one, made_ns=messages[80].header.made_ns) for one in messages[20:80]]
    history.publish(*messages[:20], *messages[30:], *map(late, messages[20:30]))
    with open_dump([fetched(history, tmp_path)]) as dump:
        times_ns = [entry.time_ns for entry in dump.frames("cell")]
    assert len(times_ns) == 60
    with open_dump([fetched(history, tmp_path, times_ns[25], times_ns[34])]) as dump:
        assert [entry.time_ns for entry in dump.frames("cell")] == times_ns[25:35]
    with pytest.raises(RecordingError, match="no history in that time"):
        fetched(history, tmp_path, times_ns[-1] + 10**12, None)


def _with(message: Stored, **fields: Any) -> Stored:
    header = message.header._replace(**fields)
    return Stored(message.subject, header, bytes(encode(header, decode_entries(message.data))))


def test_a_cell_without_history_is_named(history: History, tmp_path: Path) -> None:
    with pytest.raises(RemoteError, match=f"no history of {CELL}.*fabric.history"):
        fetched(history, tmp_path)
    assert not list(tmp_path.glob("*.mem"))


def test_commands_read_a_history(segment: Segment, history: History, tmp_path: Path) -> None:
    history.create()
    uplink = Uplink(segment)
    publish(segment.writer("cell"), 20)
    history.publish(*uplink.messages())
    place = f"{history.url}/{CELL}"
    file = tmp_path / "history.mem"
    assert main(["fetch", place, "-o", str(file)]) == 0
    assert numbers(checked(file)) == list(range(1, 21))
    table = tmp_path / "cell.csv"
    assert main(["export", place, "-o", str(table)]) == 0
    assert len(table.read_text().splitlines()) == 21


def test_an_end_before_the_begin_is_named(history: History, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    times = ["--from", "2026-11-27T09:00", "--to", "2026-11-27T08:00"]
    assert main(["fetch", f"{history.url}/{CELL}", "-o", str(tmp_path / "a.mem"), *times]) != 0
    assert "--to 2026-11-27T08:00 is before --from 2026-11-27T09:00" in capsys.readouterr().err


def test_a_history_behind_an_own_authority(
    segment: Segment, instance: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Commands name the authority by ``--ca``, a replay by ``[fabric.tls]``."""
    with nats_server(tmp_path / "nats") as server:
        history = History(server.url)
        history.create()
        publish(segment.writer("cell"), 20)
        history.publish(*Uplink(segment).messages())
    authority = trustme.CA()
    ca, pem = tmp_path / "ca.pem", tmp_path / "server.pem"
    authority.cert_pem.write_to_path(ca)
    authority.issue_cert("127.0.0.1").private_key_and_cert_chain_pem.write_to_path(pem)
    tls = {"cert_file": str(pem), "key_file": str(pem), "handshake_first": False}
    with nats_server(tmp_path / "nats", tls=tls) as server:
        url = f"tls://127.0.0.1:{server.port}"
        file, table = tmp_path / "history.mem", tmp_path / "cell.csv"
        assert main(["fetch", f"{url}/{CELL}", "-o", str(file), "--ca", str(ca)]) == 0
        assert numbers(checked(file)) == list(range(1, 21))
        assert main(["export", f"{url}/{CELL}", "-o", str(table), "--ca", str(ca)]) == 0
        assert main(["fetch", f"{url}/{CELL}", "-o", str(tmp_path / "other.mem")]) == 1
        assert "the server's certificate is not trusted; give --ca" in capsys.readouterr().err
        config = tmp_path / "supervisor.toml"
        source = f'name = "cell"\nconnector = "replay"\nfile = "{url}/{CELL}"'
        fabric = f'[fabric]\nserver = "{url}"\n'
        text = f'[instance]\nname = "{instance}"\nlog_dir = "logs"\n[[source]]\n{source}\n{fabric}'
        config.write_text(text)
        assert supervisor(["check", "-c", str(config)]) == 1
        assert "not trusted; give fabric.tls.ca" in capsys.readouterr().err
        config.write_text(f'{text}[fabric.tls]\nca = "ca.pem"\n')
        assert supervisor(["check", "-c", str(config)]) == 0, capsys.readouterr().err


def test_a_replay_fetches_its_part_once(
    segment: Segment, history: History, instance: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    history.create()
    uplink = Uplink(segment)
    publish(segment.writer("cell"), 20)
    history.publish(*uplink.messages())
    config = tmp_path / "supervisor.toml"
    source = f'name = "cell"\nconnector = "replay"\nfile = "{history.url}/{CELL}"'
    config.write_text(f'[instance]\nname = "{instance}"\nlog_dir = "logs"\n[[source]]\n{source}\n')
    assert supervisor(["check", "-c", str(config)]) == 0, capsys.readouterr().err
    (file,) = (tmp_path / "logs").iterdir()
    assert numbers(checked(file)) == list(range(1, 21))
    file.rename(file.with_suffix(".part"))
    file.with_suffix(".part").write_bytes(b"of a process that was killed")
    assert supervisor(["check", "-c", str(config)]) == 0
    publish(segment.writer("cell"), 5)
    history.publish(*uplink.messages())
    assert supervisor(["check", "-c", str(config)]) == 0
    assert numbers(checked(file)) == list(range(1, 21))
