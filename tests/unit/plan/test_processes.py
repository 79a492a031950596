"""The processes that the supervisor starts for a configuration."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec
import pytest

from shmio.config import Alert, Config, Emulator, Grpc, Instance, Mqtt, Recorder, Source, Token
from shmio.config.model import Metrics
from shmio.errors import ConfigError
from shmio.layout.document import load_layout
from shmio.layout.model import Layout, Register
from shmio.plan.processes import MAX_PROCESSES, MODES, MODULES, RANKS, Job, make_plan, process_names
from shmio.segment import Segment

LAYOUT = Layout("DB1", 1, 2, False, (Register("a", "INT", (), 0, None, 2, 1),))
PLAYED: dict[str, list[tuple[Layout, dict[str, object]]]] = {"plc": [(LAYOUT, {})]}


def config(folder: Path, sources: int = 1) -> Config:
    return Config(
        instance=Instance(name="a50", ring_mb=0.001),
        source=[Source(name=f"cell{i}", connector="s7", period_ms=10) for i in range(sources)],
        emulator=[Emulator(name="plc", kind="s7", layout="x.db", program="a50", listen="127.0.0.1:0")],
        grpc=Grpc(listen=["127.0.0.1:0"]),
        folder=str(folder),
    )


def test_blocks_and_processes_follow_the_configuration(tmp_path: Path) -> None:
    plan = make_plan(config(tmp_path), {"cell0": LAYOUT}, PLAYED, config_file=tmp_path / "s.toml")
    [block] = plan.blocks
    assert (block.source, block.layout, block.period_ns) == ("cell0", LAYOUT, 10_000_000)
    assert block.slots == 8, "ring_mb limits the ring"
    assert [(p.name, p.kind) for p in plan.processes] == [("plc", "emulator"), ("cell0", "source"), ("grpc", "grpc")]
    assert [job.rank for job in plan.jobs] == [0, 1, 2]
    assert plan.segment_bytes > block.size


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "sections",
    [
        {},
        {"source": [], "emulator": [], "grpc": None},
        {"mqtt": Mqtt(), "recorder": Recorder()},
        {"mqtt": Mqtt(broker="mosquitto"), "grpc": None},
        {"mqtt": Mqtt(broker="external", host="broker.example"), "emulator": []},
        {"alert": [Alert(when="a > 1")]},
    ],
)
def test_process_names_agree_with_the_plan(tmp_path: Path, sections: dict[str, Any], mode: str) -> None:
    settings = msgspec.structs.replace(config(tmp_path, sources=2), **sections)
    layouts = {"cell0": LAYOUT, "cell1": LAYOUT}
    plan = make_plan(settings, layouts, PLAYED, config_file=tmp_path / "s.toml", mode=mode)
    left_out = {"log": ("grpc", "broker", "mqtt", "alerts"), "replay": ("alerts",)}.get(mode, ())
    assert [job.name for job in plan.jobs] == [name for name in process_names(settings) if name not in left_out]


def test_computed_sources_use_the_instance_clock_which_may_start_paused(tmp_path: Path) -> None:
    settings = config(tmp_path, sources=2)
    layouts = {"cell0": LAYOUT, "cell1": LAYOUT}
    plan = make_plan(settings, layouts, PLAYED, config_file=tmp_path / "s.toml", computed=["cell1"])
    assert [block.attributes.stepped for block in plan.blocks] == [False, True]
    assert not plan.stepped
    settings.instance.clock = "stepped"
    assert make_plan(settings, layouts, PLAYED, config_file=tmp_path / "s.toml").stepped


def test_process_gets_its_configuration(tmp_path: Path) -> None:
    plan = make_plan(config(tmp_path), {"cell0": LAYOUT}, PLAYED, config_file=tmp_path / "s.toml")
    emulator, source, grpc = (json.loads(job.describe(plan.instance, 77)) for job in plan.jobs)
    assert {key: source[key] for key in ("instance", "epoch", "name", "kind")} == {
        "instance": "a50",
        "epoch": 77,
        "name": "cell0",
        "kind": "source",
    }
    assert source["log_file"] == str(tmp_path / "logs" / "cell0.log")
    assert source["config"]["connector"] == "s7"
    assert [load_layout(text.encode()) for text in emulator["config"]["layouts"]] == [LAYOUT]
    assert grpc["config"]["listen"] == ["127.0.0.1:0"]


def test_tokens_do_not_change_the_identity_of_the_process(tmp_path: Path) -> None:
    """A reload with new tokens does not restart the endpoint. An endpoint that starts later uses the new tokens."""

    def job(**changes: Any) -> Job:
        changed = config(tmp_path)
        changed.grpc = Grpc(listen=["127.0.0.1:0"], **changes)
        return make_plan(changed, {"cell0": LAYOUT}, PLAYED, config_file=tmp_path / "s.toml").jobs[-1]

    plain, guarded = job(), job(token=[Token(name="dash", roles=["read"], token_file="x")])
    assert plain.identify("a50", 7) == guarded.identify("a50", 7) != job(insecure=True).identify("a50", 7)
    assert plain.describe("a50", 7) != guarded.describe("a50", 7)
    assert (plain.rules, "token" in json.loads(guarded.describe("a50", 7))["config"]) == ({}, True)


def test_tokens_do_not_change_the_identity_of_what_serves_metrics(tmp_path: Path) -> None:
    def job(token_file: str) -> Job:
        changed = config(tmp_path)
        changed.metrics = Metrics(listen="127.0.0.1:9090", token_file=token_file)
        return make_plan(changed, {"cell0": LAYOUT}, PLAYED, config_file=tmp_path / "s.toml").jobs[-1]

    one, other = job("one"), job("other")
    assert one.identify("a50", 7) == other.identify("a50", 7)
    assert one.rules == {"token_file": "one"}, "a reload signals it"


def test_log_mode_has_a_recorder_and_no_endpoint(tmp_path: Path) -> None:
    recorded = config(tmp_path)
    recorded.recorder = Recorder(directory="dumps", fsync_s=2)
    layouts = {"cell0": LAYOUT}
    live, log = (
        make_plan(recorded, layouts, PLAYED, config_file=tmp_path / "s.toml", mode=mode) for mode in ("live", "log")
    )
    assert [job.kind for job in live.jobs] == ["emulator", "source", "grpc", "recorder"]
    assert [job.kind for job in log.jobs] == ["emulator", "source", "recorder"]
    recorder = log.jobs[-1]
    assert recorder.rank < log.jobs[1].rank, "the recorder starts before the sources and stops after them"
    assert recorder.config == {
        "directory": str(tmp_path / "dumps"),
        "fsync_s": 2,
        "buffer_mb": 16,
        "rotate_min": 60,
        "rotate_mb": 1000,
        "keep_days": 0,
        "keep_mb": 0,
        "sources": [],
        "registers": [],
        "trigger": None,
        "config_file": str(tmp_path / "s.toml"),
    }


def test_maximum_number_of_sources_fits_in_a_segment(tmp_path: Path, instance: str) -> None:
    count = MAX_PROCESSES - 2
    layouts = {f"cell{i}": LAYOUT for i in range(count)}
    plan = make_plan(config(tmp_path, count), layouts, PLAYED, config_file=tmp_path / "s.toml")
    with Segment.create(instance, plan.blocks, plan.processes) as segment:
        segment.unlink()
        assert len(segment.blocks) == count


def test_too_many_processes_are_refused(tmp_path: Path) -> None:
    count = MAX_PROCESSES - 1
    layouts = {f"cell{i}": LAYOUT for i in range(count)}
    with pytest.raises(ConfigError, match=f"{count + 2} processes"):
        make_plan(config(tmp_path, count), layouts, PLAYED, config_file=tmp_path / "s.toml")


def test_every_kind_has_a_module_and_a_rank() -> None:
    assert set(MODULES) == set(RANKS)
