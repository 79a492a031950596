"""The benchmarks of single mechanisms run and print ratios; no speed is asserted."""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from shmio.testing.mosquitto import missing

ROOT = Path(__file__).parents[2]
RATIO = r"(?: +(\d+\.\d+) times as fast)?$"
ROW = re.compile(r"^(\S.*?) +(\d+) +(\d+)" + RATIO, re.MULTILINE)
SPREAD = re.compile(r"^(\S.*?) +(\d+\.\d+) +(\d+\.\d+) +(\d+\.\d+)" + RATIO, re.MULTILINE)


def printed(benchmark: str) -> str:
    """Run a benchmark; return its output."""
    command = [sys.executable, f"benchmarks/{benchmark}.py", "--quick"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    assert (run.returncode, run.stderr) == (0, ""), run.stdout + run.stderr
    return run.stdout


@pytest.mark.parametrize(
    ("benchmark", "row", "tables"),
    [
        (
            "shared_memory",
            ROW,
            {"shmio Ring": 2, "copy alone (the limit)": 2, "multiprocessing.Lock, copy": 2, "ring_publish": 1},
        ),
        ("s7_read", ROW, {"shmio": 6, "python-snap7 db_read": 6, "shmio, one request at a time": 6}),
        (
            "scan",
            ROW,
            {"shmio": 20, "struct, all values": 8, "numpy, all bytes": 8, "all by codec": 8, "numpy record, astype": 4},
        ),
        (
            "wakeup",
            SPREAD,
            {
                "shmio Cursor.next, frame": 8,
                "eventfd for each reader": 4,
                "multiprocessing.Condition, frame": 4,
                "threading.Condition, frame": 4,
                "ring,frame": 4,
                "eventfd": 4,
            },
        ),
        (
            "step",
            ROW,
            {
                "v2, 100 topics in one stream": 1,
                "v2, a structure of 100 as one topic": 1,
                "v2, an array of 100 as one topic": 1,
                "v1, 100 topics and model/clock": 1,
                "shmio.v1, 100 registers in one update": 1,
                "a bare server: v2, 100 topics in one stream": 1,
                "a bare server: v2, an array of 100 as one topic": 1,
                "a bare server: shmio.v1, 100 registers in one update": 1,
                "a bare server: the same, steps on a stream, one by one": 1,
            },
        ),
        (
            "remote_model",
            ROW,
            {
                "a model elsewhere, a program on the host steps": 1,
                "the same in the instance, a program on the host steps": 1,
                "a model elsewhere, a client of shmio.v1 steps, and has all values": 1,
            },
        ),
        (
            "fmu",
            ROW,
            {
                "shmio, the runner alone": 2,
                "FMPy alone": 2,
                "shmio, an instance": 2,
                "FMPy in a loop, the FMUs only": 1,
            },
        ),
        ("command", SPREAD, {"shmio": 2, "python-snap7, without an instance": 2, "accepted to written": 1}),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_each_table_lists_all_contenders(benchmark: str, row: re.Pattern[str], tables: dict[str, int]) -> None:
    """Each table has all contenders. shmio's row has no ratio, because the other rows are compared with it."""
    found = [match.groups("") for match in row.finditer(printed(benchmark))]
    assert all(float(value) > 0 for _, *values, _ in found for value in values)
    assert {name: sum(name == other for other, *_ in found) for name in tables} == tables
    ours = next(iter(tables))
    assert all((ratio == "") == (name == ours) for name, *_, ratio in found if name in (ours, *list(tables)[1:2]))


def test_benchmark_of_judging() -> None:
    found = printed("judging")
    rows = re.findall(r"^10 expectations, (?:1|8|64|512) frames at once +(\d+\.\d+) +\d+\.\d+$", found, re.MULTILINE)
    assert len(rows) == 4
    assert len(re.findall(r"^1 formula, .*? +\d+\.\d+ +\d+\.\d+$", found, re.MULTILINE)) == 5


def test_benchmark_of_recording() -> None:
    found = printed("recording")
    sizes = re.findall(
        r"^(?:emulated cell|with noise|at rest) +(\d\.\d+) +(\d\.\d+) +(\d\.\d+) +7$", found, re.MULTILINE
    )
    assert len(sizes) == 3
    assert all(0 < float(ours) < float(raw) / 10 for raw, _, ours in sizes)
    assert len(re.findall(r"^(?:50|1000) Hz +\d+\.\d+ +\d+\.\d+ +\d+\.\d+ +\d+$", found, re.MULTILINE)) == 2
    [ours] = re.findall(r"^as it is, zstd 3 +(\d\.\d+)$", found, re.MULTILINE)
    [whole] = re.findall(r"^times whole, as of shmio.frame.v1 +(\d\.\d+)$", found, re.MULTILINE)
    assert 0 < float(ours) < 0.9 * float(whole)


def test_benchmark_of_killed_recorders() -> None:
    found = re.findall(
        r"^\d+ +\d+\.\d+ +\d+ +\d+\.\d+ +([1-9]\d*) of (\d+) +(\d+) +(\d+)$", printed("recorder_kills"), re.MULTILINE
    )
    assert len(found) == 2
    for recovered, written, lost, told in found:
        assert (recovered, lost) == (written, told)


def test_benchmark_of_reading_recordings() -> None:
    found = printed("dump_read")
    for contender in ("shmio columns", "shmio, frame by frame", "mcap library and struct"):
        assert re.search(rf"^{contender} +[1-9]\d* +[1-9]\d*", found, re.MULTILINE)
    assert len(re.findall(r"^(?:shmio|mcap library, .*?) +\d+\.\d+ +\d+\.\d+ +\d+\.\d+", found, re.MULTILINE)) == 4
    assert len(re.findall(r"^(?:parquet|csv|mcap) +[1-9]\d* +\d+\.\d$", found, re.MULTILINE)) == 3


def test_benchmark_of_cycles_in_progress() -> None:
    assert len(re.findall(r"^[0-9]+ jobs: [124] under way +[1-9]", printed("s7_cycle"), re.MULTILINE)) == 3


@pytest.mark.skipif(
    shutil.which("node") is None or not (ROOT / "tests/unit/endpoints/node/node_modules").exists(),
    reason="needs Node and its packages",
)
def test_benchmark_of_streams_against_a_plain_server() -> None:
    found = printed("grpc_streams")
    rates = re.findall(r"^(version [12]|bare.*?)  +([1-9]\d*) +\d+\.\d+ +\d+\.\d+ +\d+\.\d+$", found, re.MULTILINE)
    assert [name for name, _ in rates] == [
        "version 1",
        "version 2",
        "bare, out of a queue",
        "bare grpc.aio, ready bytes",
    ]
    latencies = re.findall(r"^version [12], (?:1|50) subscribers +(\d+\.\d+)", found, re.MULTILINE)
    assert len(latencies) == 4
    assert all(float(latency) > 0 for latency in latencies)


@pytest.mark.skipif(bool(missing()) or shutil.which("mosquitto_sub") is None, reason="needs mosquitto and its clients")
def test_benchmark_of_large_cells_by_mqtt() -> None:
    found = re.findall(r"^(20|200) registers, (\S.*?) +\d+ +(\d+) +\d+$", printed("mqtt_cells"), re.MULTILINE)
    assert len(found) == 12
    assert all(int(told) > 0 for _, way, told in found if "max_rate_hz" not in way)


@pytest.mark.skipif(bool(missing()), reason=missing())
def test_benchmark_of_mqtt_against_a_plain_publisher() -> None:
    found = printed("mqtt")
    rates = re.findall(r"^(shmio's bridge|paho, bare) +([1-9]\d*) +([1-9]\d*)", found, re.MULTILINE)
    assert [name for name, *_ in rates] == ["shmio's bridge", "paho, bare"] * 2
    assert len(re.findall(r"^QoS [01] +\d+\.\d+ +\d+\.\d+ +\d+\.\d+ +\d+\.\d+$", found, re.MULTILINE)) == 2


def test_benchmark_of_one_client_of_shmio_v1() -> None:
    found = re.findall(
        r"^(every frame|latest|raw frames, every one) +([1-9]\d*) +([1-9]\d*) ", printed("grpc_client"), re.MULTILINE
    )
    assert [name for name, *_ in found] == ["every frame", "latest", "raw frames, every one"] * 2


def test_benchmark_of_a_growing_load() -> None:
    found = re.search(r"^2 of each +(.+)$", printed("scaling"), re.MULTILINE)
    assert found is not None
    cells = [float(cell) for cell in found[1].split()]
    assert len(cells) == 11
    assert cells[6] > 0  # ms from due to frame
    assert cells[10] == 0  # frames that readers missed


def test_benchmark_of_neighbouring_clients() -> None:
    found = re.findall(
        r"^(alone|one never reads|50 come and go) +\d+\.\d+ +\d+\.\d+ +\d+\.\d+ +[1-9]\d*\.\d +[1-9]\d*\.\d$",
        printed("neighbours"),
        re.MULTILINE,
    )
    assert found == ["alone", "one never reads", "50 come and go"]


def test_benchmark_of_replay_timing_and_speed() -> None:
    text = printed("replay")
    assert re.findall(r"^(50|1000) Hz +([1-9]\d*)( +\d+){4}$", text, re.MULTILINE)
    [missed] = re.findall(r"^50 Hz +[1-9]\d* +[1-9]\d* +(\d+)$", text, re.MULTILINE)
    assert missed == "0"


def test_the_soak_run_watches_all_processes_and_the_recording() -> None:
    found = printed("soak")
    rows = re.findall(r"^(plc|cell|grpc|recorder) +\d+\.\d\d +\d+\.\d\d +[1-9]\d* +[1-9]\d*$", found, re.MULTILINE)
    assert sorted(rows) == ["cell", "grpc", "plc", "recorder"]
    assert re.search(
        r"^[1-9]\d* frames, \d+ overruns, .* [1-9]\d* changes, [1-9]\d* messages received", found, re.MULTILINE
    )
    assert re.search(r"^the machine stood still .* of \d+ skipped cycles came without that", found, re.MULTILINE)
    assert re.search(r"^[1-9]\d* frames recorded in [1-9]\d* files", found, re.MULTILINE)


def test_the_start_of_a_large_cell_is_measured() -> None:
    found = re.findall(r"^(\w+) +\d+\.\d\d +\d+\.\d\d +\d+\.\d\d$", printed("large_cell"), re.MULTILINE)
    assert found == ["up", "good", "attach", "get", "list"]


def test_benchmark_of_reading_opc_ua() -> None:
    pytest.importorskip("asyncua")
    found = printed("opcua_read")
    for contender, ratios in (("shmio, 1 session", r" +\d+\.\d+ +\d+\.\d+"), ("asyncua", "")):
        rows = re.findall(rf"^{contender} +[1-9]\d* .*?{ratios} +(?:none|client|server).*$", found, re.MULTILINE)
        assert len(rows) == 2, found


def test_benchmark_of_reading_modbus() -> None:
    pytest.importorskip("pymodbus")
    found = printed("modbus_read")
    assert (
        len(re.findall(r"^pymodbus, (?:words|REALs) +[1-9]\d* +\d+\.\d+ +\d+\.\d+ +\d+\.\d+$", found, re.MULTILINE))
        == 4
    ), found


def test_benchmark_of_reading_mqtt() -> None:
    if reason := missing():
        pytest.skip(reason)
    found = printed("mqtt_read")
    assert len(re.findall(r"^(?:shmio|paho) +[1-9]\d* +\d+\.\d+", found, re.MULTILINE)) == 2, found


def test_benchmark_of_a_reload() -> None:
    pytest.importorskip("asyncua")
    pytest.importorskip("pymodbus")
    found = printed("reload")
    assert len(re.findall(r"^(?:modbus|opcua) +[1-9]\d* +[1-9]\d* +\d+\.\d$", found, re.MULTILINE)) == 2, found


def test_benchmark_of_reading_mtconnect() -> None:
    found = printed("mtconnect_read")
    assert re.search(r"^shmio +[1-9]\d* +\d+\.\d+$", found, re.MULTILINE), found
    assert re.search(r"^urllib, ElementTree +[1-9]\d* +\d+\.\d+ +\d+\.\d+ +\d+\.\d+$", found, re.MULTILINE), found


def test_benchmark_of_reading_ros() -> None:
    pytest.importorskip("cyclonedds")
    found = printed("ros_read")
    clients = r"^(?:rosbridge|websockets, json|ros2|cyclonedds) +[1-9]\d* +\d+\.\d+"
    assert len(re.findall(clients, found, re.MULTILINE)) == 4, found


def test_benchmark_of_the_web_page() -> None:
    pytest.importorskip("uvicorn")
    found = printed("web_page")
    assert (
        len(re.findall(r"^(?:1|10) pages?, (?:20|200) signals(?:, 500 silent)? +\d+\.\d +[1-9]", found, re.MULTILINE))
        == 5
    ), found
    if shutil.which("chromium") is not None:
        assert len(re.findall(r"^Chromium, (?:20|200) signals +\d+\.\d +[1-9]", found, re.MULTILINE)) == 2, found


def test_benchmark_of_clients_beside_the_web_page() -> None:
    pytest.importorskip("uvicorn")
    found = printed("web_neighbours")
    row = r"^(?:grpc|mqtt), (?:alone|500 silent WebSockets|10 pages, 20 signals) +\d+\.\d\d +\d+\.\d\d .* \d+$"
    assert len(re.findall(row, found, re.MULTILINE)) == 6, found


def test_benchmark_of_a_large_tree() -> None:
    pytest.importorskip("uvicorn")
    if shutil.which("chromium") is None:
        pytest.skip("chromium is not installed")
    found = printed("web_tree")
    assert len(re.findall(r"^(?:first|registers|a search).*(?: +\d+){3}$", found, re.MULTILINE)) == 3, found


def test_benchmark_of_serving_opc_ua() -> None:
    pytest.importorskip("asyncua")
    found = printed("opcua_server")
    assert len(re.findall(r"^1 client, (?:shmio|asyncua alone) +[1-9]\d* +[1-9]\d* .*[\w)]$", found, re.MULTILINE)) == 2


def test_benchmark_of_neighbours_on_the_opc_ua_endpoint() -> None:
    pytest.importorskip("asyncua")
    found = printed("opcua_neighbours")
    assert len(re.findall(r"^[\w ,]+(?: +\d+\.\d){5} +no$", found, re.MULTILINE)) == 10, found


def test_benchmark_of_sixteen_sources() -> None:
    pytest.importorskip("asyncua")
    pytest.importorskip("pymodbus")
    found = printed("sixteen_sources")
    assert len(re.findall(r"^1 of (?:s7|opcua|modbus) +\d+\.\d +\d+\.\d+ +\d+ .* 0$", found, re.MULTILINE)) == 3, found


def test_benchmark_of_the_audit_log() -> None:
    found = printed("audit")
    row = r"^a (?:client of shmio.v1|program on the host), (?:audit log|none)(?: +\d+\.\d{3}){3}(?: +\d+){3}$"
    assert len(re.findall(row, found, re.MULTILINE)) == 4, found


def test_benchmark_of_falsification() -> None:
    pytest.importorskip("optuna")
    found = printed("falsify")
    assert len(re.findall(r"^[12] +\d+\.\d\d +\d+$", found, re.MULTILINE)) == 2, found
    assert len(re.findall(r"^(?:tpe|cmaes|random|grid) +[01] of 1 +(?:\d+|over 10)$", found, re.MULTILINE)) == 4, found


TINY = """
from common import begin, report

begin("tiny")
report("copy", "ns", {"ours": [20.0, 30.0, 40.0], "theirs": [60.0, 60.0, 60.0]}, "ours", "less", "theirs")
"""


def test_a_benchmark_stores_its_figures_with_the_commit(tmp_path: Path) -> None:
    (tmp_path / "benchmarks").mkdir()
    shutil.copy(ROOT / "benchmarks/common.py", tmp_path / "benchmarks")
    (tmp_path / "benchmarks/tiny.py").write_text(TINY)
    history = tmp_path / "docs/reference/benchmark-history.csv"
    history.parent.mkdir(parents=True)
    history.write_text((ROOT / "docs/reference/benchmark-history.csv").read_text().splitlines(keepends=True)[0])
    (tmp_path / ".gitignore").write_text("__pycache__\n")

    def git(*words: str) -> str:
        command = ["git", "-c", "user.name=x", "-c", "user.email=x@x", *words]
        return subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True).stdout.strip()

    def run(*options: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "benchmarks/tiny.py", *options]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "x")
    assert [run(*options).returncode for options in ((), ("--store",), ("--store",))] == [0, 0, 0]
    with history.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["figure"], row["value"], row["unit"], row["better"]) for row in rows] == 2 * [
        ("copy: ours", "30", "ns", "less"),
        ("copy: ours, times as fast as theirs", "2", "ratio", "more"),
    ]
    assert {(row["benchmark"], row["commit"]) for row in rows} == {("tiny", git("rev-parse", "--short=8", "HEAD"))}
    (tmp_path / "benchmarks/tiny.py").write_text(TINY + "\n")
    refused = run("--store")
    assert refused.returncode == 2
    assert "commit your changes first" in refused.stderr
    assert run("--store", "--quick").returncode == 2
