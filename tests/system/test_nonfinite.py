"""NaN and infinities: every interface refuses them until the configuration allows them."""

from __future__ import annotations

import math
from collections.abc import Callable

import grpc
import pytest
from google.protobuf.struct_pb2 import Value

import shmio
from shmio.client import connect
from shmio.errors import CommandError
from shmio.testing.cell import PATIENCE_S, Cell, until
from shmio.wire import simlog_v1_pb2 as v1
from shmio.wire import simlog_v2_pb2 as v2
from shmio.wire.simlog_v1_pb2_grpc import SimlogAPIStub
from shmio.wire.simlog_v2_pb2_grpc import SimlogAPIStub as SimlogV2Stub

CONFIG = """[instance]
name = "{instance}"

[[source]]
name = "sim"
connector = "memory"
layout = "sim.toml"
writable = ["**"]

[grpc]
listen = ["{grpc}"]
"""
REASON = "NaN and infinities are written only if"


def test_every_interface_refuses_nonfinite_values_until_a_reload_allows_them(make_cell: Callable[..., Cell]) -> None:
    cell = make_cell(config=CONFIG)
    (cell.folder / "sim.toml").write_text('[registers]\na = "REAL"\nb = "ARRAY[0..3] OF LREAL"\n')
    cell.up()
    until(lambda: cell.processes()["sim"]["quality"] == "good", "good quality")

    done = cell.run("shmio", "set", "sim/a", "NaN")
    assert (
        done.returncode,
        f"sim/a: not written, because the source did not accept the command: a: {REASON}" in done.stderr,
    ) == (
        1,
        True,
    )
    with (
        shmio.attach(cell.instance, writable=True) as local,
        connect(str(cell.grpc)) as remote,
        grpc.insecure_channel(str(cell.grpc)) as channel,
    ):
        old, new = SimlogAPIStub(channel), SimlogV2Stub(channel)  # type: ignore[no-untyped-call]
        (outcome,) = local.write({"sim/b": [0.0, 1.0, math.inf, 2.0]})
        assert (str(outcome.kind), outcome.text.startswith(f"b/2: {REASON}")) == ("rejected", True)
        (answer,) = remote.write({"sim/b/1": -math.inf})
        assert (answer.kind, answer.text.startswith(f"b/1: {REASON}")) == ("rejected", True)
        message = v2.SimlogMessage(type=v2.NUMBER, value=Value(number_value=math.nan))
        with pytest.raises(grpc.RpcError, match=REASON):
            new.Write(v2.PubRequest(topic="sim/a", data=message), timeout=PATIENCE_S)
        texts = [v1.ROSMessage(type="double", value=value) for value in ("-Infinity", "1.5")]
        old.Publish(
            iter([v1.PubRequest(topic=v1.TopicDescriptor(path="sim/a"), data=text) for text in texts]),
            timeout=PATIENCE_S,
        )
        until(lambda: local["sim/a"] == 1.5, "the value published after it")
        with local.inject("sim/a/in") as shadow:
            (outcome,) = shadow.set({"sim/a": math.nan})
            assert REASON in outcome.text
        assert local["sim/b"] == [0.0] * 4

        file = cell.folder / "supervisor.toml"
        file.write_text(file.read_text().replace('["**"]\n', '["**"]\nallow_nonfinite = ["a"]\n'))
        assert cell.supervisor("reload").returncode == 0

        def written() -> bool:
            try:
                return local.write({"sim/a": math.nan})[0].done
            except CommandError:  # the reload is not finished
                return False

        until(written, "written")
        until(lambda: math.isnan(float(str(local["sim/a"]))), "a NaN")
        (outcome,) = local.write({"sim/b/0": math.nan})
        assert REASON in outcome.text
