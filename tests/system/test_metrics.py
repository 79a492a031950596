"""The figures of a running cell, read by a real Prometheus: formats, alert rules, and the dashboard's queries."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import grpc
import pytest

from shmio.config import Address
from shmio.testing.cell import CONFIG, Cell, until
from shmio.testing.ports import reserved_port
from shmio.wire.simlog_v1_pb2 import TopicDescriptor

PACKAGING = Path(__file__).parents[2] / "packaging/prometheus"
pytestmark = pytest.mark.skipif(
    shutil.which("prometheus") is None or shutil.which("promtool") is None, reason="needs Prometheus"
)


def get(url: str, token: str = "") -> bytes:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=20) as answer:
        return bytes(answer.read())


@contextmanager
def prometheus(folder: Path, target: Address, address: Address, token: Path) -> Iterator[str]:
    """Run Prometheus with the packaged rules. It reads the figures every 200 ms."""
    shutil.copytree(PACKAGING, folder, dirs_exist_ok=True)
    file = folder / "prometheus.yml"
    text = (
        file.read_text().replace("127.0.0.1:9464", str(target)).replace("scrape_interval: 5s", "scrape_interval: 200ms")
    )
    text = text.replace("# authorization:", "authorization:").replace(
        "#   credentials_file: metrics.token", f"  credentials_file: {token}"
    )
    assert str(token) in text
    file.write_text(text.replace("rule_files", "  evaluation_interval: 200ms\nrule_files"))
    command = ["prometheus", f"--config.file={file}", f"--storage.tsdb.path={folder / 'data'}"]
    process = subprocess.Popen(
        [*command, f"--web.listen-address={address}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield f"http://{address}/api/v1"
    finally:
        process.terminate()
        process.wait(20)


def query(api: str, expression: str) -> list[Any]:
    answer = json.loads(get(f"{api}/query?{urllib.parse.urlencode({'query': expression})}"))
    assert answer["status"] == "success", (expression, answer)
    return list(answer["data"]["result"])


def test_a_cell_is_monitored(make_cell: Callable[..., Cell], tmp_path: Path) -> None:
    with reserved_port() as target, reserved_port() as server, reserved_port() as broker, reserved_port() as opcua:
        section = f'[recorder]\n[mqtt]\nlisten = "{broker}"\nbroker = "mosquitto"\n[metrics]\nlisten = "{target}"\n'
        section += 'token_file = "metrics.token"\n'
        section += f'[opcua]\nlisten = "{opcua}"\n'
        cell = make_cell(config=CONFIG.replace("timeout = 1000", 'timeout = 1000\nwritable = ["Outputs"]') + section)
        token = tmp_path / "metrics.token"  # that of Prometheus, of 64 digits, as openssl rand -hex 32 makes it
        token.touch(0o600)
        token.write_text(f"{'0123456789abcdef' * 4}\n")
        (cell.folder / token.name).touch(0o600)
        (cell.folder / token.name).write_text(token.read_text())
        cell.up()
        with pytest.raises(urllib.error.HTTPError, match="401"):
            get(f"http://{target}/metrics")
        cell.output("shmio", "set", "Outputs/0", "3")
        with grpc.insecure_channel(str(cell.grpc)) as channel:
            get_topic: Any = channel.unary_unary(
                "/simulation.server.SimlogAPI/GetTopic", TopicDescriptor.SerializeToString
            )
            assert get_topic(TopicDescriptor(path="cell/Outputs/0"), timeout=20)
        figures = get(f"http://{target}/metrics", token.read_text().strip())
        checked = subprocess.run(["promtool", "check", "metrics"], input=figures, capture_output=True, check=False)
        assert (checked.returncode, checked.stdout, checked.stderr) == (0, b"", b"")
        rules = (PACKAGING / "alerts.yml").read_text()
        for name in re.findall(r"\bshmio_\w+", rules):
            assert f"\n{name}".encode() in figures, f"alerts.yml has the unknown metric {name}"
        subprocess.run(["promtool", "check", "rules", PACKAGING / "alerts.yml"], check=True, capture_output=True)
        with prometheus(tmp_path / "prometheus", target, server, token) as api:

            def ready() -> bool:
                try:
                    found = query(api, 'count_over_time(shmio_source_command_seconds_count{source="cell"}[1m])')
                except OSError:
                    return False
                return bool(found) and float(found[0]["value"][1]) >= 3

            until(ready, "three scrapes")
            dashboard = json.loads((PACKAGING / "grafana-dashboard.json").read_text())
            queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
            for expression in queries:
                text = expression.replace("$__rate_interval", "1m").replace("$instance", ".*")
                assert query(api, text), text
            assert query(api, "shmio_source_quality")[0]["value"][1] == "2"
            until(lambda: query(api, "shmio_grpc_sent_bytes_total > 0") != [], "the bytes of the answer")
            until(lambda: query(api, "shmio_mqtt_sent_bytes_total > 0") != [], "the bytes of the bridge")

            def lag(process: str) -> float:
                found = query(api, f'shmio_reader_lag_seconds{{source="cell",process="{process}"}}')
                return float(found[0]["value"][1])

            assert {lag(process) < 1 for process in ("recorder", "mqtt", "grpc", "opcua")} == {True}
            recorder = cell.processes()["recorder"]["pid"]
            os.kill(recorder, signal.SIGSTOP)
            try:
                until(lambda: lag("recorder") > 2, "a recorder that reads nothing")
                (source,) = [one for one in cell.status()["processes"] if one["name"] == "cell"]
                assert source["readers"][0]["process"] == "recorder"
                assert source["readers"][0]["frames"] > 50
                assert "recorder is" in cell.output("shmio-supervisor", "status")
            finally:
                os.kill(recorder, signal.SIGCONT)
            until(lambda: lag("recorder") < 1, "a recorder that has caught up")

            def alerts() -> set[str]:
                return {one["labels"]["alertname"] for one in json.loads(get(f"{api}/alerts"))["data"]["alerts"]}

            plc = cell.processes()["plc"]["pid"]
            os.kill(plc, signal.SIGSTOP)  # a killed one is back before a slow machine's next scrape
            try:
                until(lambda: query(api, "shmio_source_quality == 0") != [], "a bad source")
                until(lambda: "ShmioSourceBad" in alerts(), "the alert")
            finally:
                os.kill(plc, signal.SIGCONT)


SERIES = {
    "ShmioUnreachable": {'up{job="shmio"}': "0x20"},
    "ShmioSourceBad": {'shmio_source_quality{source="cell"}': "0x20"},
    "ShmioSourceStale": {'shmio_source_age_seconds{source="cell"}': "11x20", "shmio_clock_virtual": "0x20"},
    "ShmioProcessDown": {'shmio_process_running{process="grpc"}': "0x20"},
    "ShmioProcessProblem": {'shmio_process_problem{process="mqtt"}': "1x20"},
    "ShmioProcessRestarts": {'shmio_process_restarts_total{process="cell"}': "0+1x20"},
    "ShmioOverruns": {
        'shmio_source_overruns_total{source="cell"}': "0+30x20",
        'shmio_source_polls_total{source="cell"}': "0+2000x20",
    },
    "ShmioReaderLags": {'shmio_reader_lag_seconds{source="cell",process="recorder"}': "3x20"},
    "ShmioRecorderMisses": {"shmio_recorder_missed_total": "0+1x20"},
    "ShmioClientsMiss": {"shmio_grpc_dropped_total": "0+1x20"},
    "ShmioDiskFull": {
        'shmio_disk_free_bytes{folder="recordings"}': "4x20",
        'shmio_disk_size_bytes{folder="recordings"}': "100x20",
    },
}
"""Series in which each alert of the packaged rules is active after 10 minutes, with a value every 30 s."""


def test_each_alert_rule_fires_on_its_series_alone(tmp_path: Path) -> None:
    rules = (PACKAGING / "alerts.yml").read_text()
    assert sorted(SERIES) == sorted(line.split()[-1] for line in rules.splitlines() if "- alert:" in line)
    tests = [
        {
            "interval": "30s",
            "input_series": [{"series": name, "values": values} for name, values in series.items()],
            "promql_expr_test": [
                {
                    "expr": 'count by (alertname) (ALERTS{alertstate="firing"})',
                    "eval_time": "10m",
                    "exp_samples": [{"labels": f'{{alertname="{alert}"}}', "value": 1}],
                }
            ],
        }
        for alert, series in SERIES.items()
    ]
    (tmp_path / "test.yml").write_text(json.dumps({"rule_files": [str(PACKAGING / "alerts.yml")], "tests": tests}))
    done = subprocess.run(
        ["promtool", "test", "rules", tmp_path / "test.yml"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
