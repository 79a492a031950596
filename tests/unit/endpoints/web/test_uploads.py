from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import AsyncIterator
from contextlib import ExitStack
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.endpoints.web import uploads
from shmio.endpoints.web.uploads import compile_uploads, describe
from shmio.errors import CommandError, EndpointError
from shmio.segment import Segment
from tests.unit.endpoints.web.test_page import SECRETS, pages

BLOCK = b"""DATA_BLOCK "Press"
{ S7_Optimized_Access := 'FALSE' }
STRUCT
  Speed : Real := 1.5; // of the ram
  Done : Bool;
END_STRUCT;
BEGIN
END_DATA_BLOCK
"""
KEPSERVER = (
    b"Tag Name,Address,Data Type,Respect Data Type,Client Access,Scan Rate\n"
    b'"Pump.Speed","DB1.REAL0",Float,1,R/W,100\n"Odd","DB1.X",Nothing,1,R/W,100\n'
)
TABLE = b'[registers]\n"pump/Speed" = { type = "REAL", address = "holding 100", unit = "rpm" }\n'


def request(**files: bytes) -> bytes:
    head = [{"name": name.replace("_", "."), "size": len(data)} for name, data in files.items()]
    return json.dumps(head).encode() + b"\n" + b"".join(files.values())


def compiled(**files: bytes) -> dict[str, Any]:
    return describe(request(**files))


def test_registers_of_a_data_block() -> None:
    found = compiled(press_db=BLOCK)
    (layout,) = found["layouts"]
    assert (layout["name"], layout["count"], found["messages"]) == ("Press", 2, [])
    assert layout["registers"] == [
        ["Speed", "REAL", "0", 4, "1.5", "", "of the ram"],
        ["Done", "BOOL", "4.0", 1, "", "", ""],
    ]


def test_files_use_each_others_types() -> None:
    block = BLOCK.replace(b"Done : Bool", b'Axis : "Axis"')
    udt = b'TYPE "Axis"\nVERSION : 0.1\nSTRUCT\n  Pos : Real;\nEND_STRUCT;\nEND_TYPE\n'
    missing = compiled(press_db=block)
    assert missing["layouts"] == []
    assert missing["messages"][0].startswith("press.db:5:")
    paths = [row[0] for row in compiled(press_db=block, axis_udt=udt)["layouts"][0]["registers"]]
    assert paths == ["Speed", "Axis/Pos"]


def test_tag_table_and_the_list_of_another_tool() -> None:
    (layout,) = compiled(tags_toml=TABLE)["layouts"]
    assert layout["registers"] == [["pump/Speed", "REAL", "holding 100", 4, "", "rpm", ""]]
    found = compiled(list_csv=KEPSERVER)
    assert [row[0] for row in found["layouts"][0]["registers"]] == ["Pump/Speed"]
    assert found["messages"][0].startswith("imported 1 tag from")
    assert "skipped 1" in found["messages"][1]


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"[]\n",
        b"[" * 9000,
        b'[{"name": "a.db", "size": 5}]\nabc',
        b'[{"name": "a.db", "size": -1}]\n',
        b'[{"name": "", "size": 0}]\n',
        json.dumps([{"name": "a.db", "size": 0}] * 101).encode() + b"\n",
    ],
)
def test_malformed_request_is_refused(body: bytes) -> None:
    found = describe(body)
    assert found["layouts"] == []
    assert "malformed" in found["messages"][0]


@given(st.sampled_from(["db", "toml", "csv", "xlsx", "xml", "sdf", "x"]), st.binary(max_size=200))
def test_any_file_is_answered(suffix: str, data: bytes) -> None:
    assert json.dumps(compiled(**{f"a_{suffix}": data}))


def test_answer_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "MAX_ROWS", 1)
    (layout,) = compiled(press_db=BLOCK)["layouts"]
    assert (layout["count"], len(layout["registers"])) == (2, 1)
    monkeypatch.setattr(uploads, "MAX_ROWS", 10)
    monkeypatch.setattr(uploads, "MAX_ANSWER_BYTES", 60)
    (layout,) = compiled(press_db=BLOCK)["layouts"]
    assert (layout["count"], len(layout["registers"])) == (2, 1)


def test_page_gets_the_registers_of_its_files(segment: Segment) -> None:
    with pages(segment) as server:
        status, headers, text = server.request("POST", "/layout", request(press_db=BLOCK))
        assert (status, headers["content-type"]) == (200, "application/json")
        assert json.loads(text)["layouts"][0]["name"] == "Press"
        too_large = b"x" * (uploads.MAX_BYTES + uploads.MAX_HEAD_BYTES + 1)
        assert server.request("POST", "/layout", too_large)[0] == 413


def test_users_without_a_role_and_foreign_pages_drop_nothing(segment: Segment) -> None:
    with pages(segment, SECRETS, roles=()) as server:
        assert server.request("POST", "/layout", request(press_db=BLOCK))[0] == 403
    with pages(segment) as server:
        assert server.request("POST", "/layout", b"", Origin="http://evil.example")[0] == 403


def test_slow_page_uploads_do_not_block_others(segment: Segment, caplog: pytest.LogCaptureFixture) -> None:
    with pages(segment) as server, ExitStack() as slow:
        for _ in range(2 * uploads.MAX_RECEIVING):
            client = slow.enter_context(socket.create_connection(("127.0.0.1", server.port)))
            client.sendall(b"POST /layout HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 100\r\n\r\nabc")
        assert server.request("POST", "/layout", request(press_db=BLOCK))[0] == 200
    assert not caplog.records


def test_a_newer_upload_ends_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "MAX_RECEIVING", 1)

    async def run() -> None:
        some = uploads.Uploads()
        more = asyncio.Event()

        async def slow() -> AsyncIterator[bytes]:
            yield b"a"
            await more.wait()
            yield b"b"

        async def fast() -> AsyncIterator[bytes]:
            yield b"whole"

        old = asyncio.create_task(some.receive(slow()))
        await asyncio.sleep(0)
        assert await some.receive(fast()) == b"whole"
        more.set()
        with pytest.raises(EndpointError, match="try again"):
            await old

    asyncio.run(run())


def test_an_upload_waits_for_others_to_be_compiled_but_not_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        some, done = uploads.Uploads(), asyncio.Event()

        async def long(_: bytes) -> bytes:
            await done.wait()
            return b"done"

        monkeypatch.setattr(uploads, "compile_uploads", long)
        first = [asyncio.create_task(some.compile(b"", str(number))) for number in range(uploads.MAX_COMPILING)]
        await asyncio.sleep(0)
        with monkeypatch.context() as impatient:
            impatient.setattr(uploads, "WAIT_S", 0)
            with pytest.raises(EndpointError, match="try again"):
                await some.compile(b"", "another")
        waiting = asyncio.create_task(some.compile(b"", "another"))
        done.set()
        assert await asyncio.gather(*first, waiting) == [b"done"] * (uploads.MAX_COMPILING + 1)

    asyncio.run(run())


def test_deep_files_are_refused_with_a_reason() -> None:
    """100,000 levels in each format: no parser may follow them."""
    levels = 100_000
    for name, text, reason in (
        ("x.db", f"DATA_BLOCK x STRUCT {'a : STRUCT ' * levels}", "structures are nested more than 32 deep"),
        ("x.toml", f"a = {'[' * levels}1{']' * levels}", "nested too deeply"),
        ("x.toml", f"a = {'{a=' * levels}1{'}' * levels}", "nested too deeply"),
        ("x.toml", f"{'a.' * levels}a = 1", "a key has more than 64 parts"),
        ("x.toml", f"[{'a.' * levels}a]", "a key has more than 64 parts"),
        ("x.xml", f"<Document>{'<a>' * levels}{'</a>' * levels}</Document>", "nested more than 200 deep"),
        ("x", "[" * levels, "expected DATA_BLOCK"),
    ):
        found = describe(f'[{{"name": "{name}", "size": {len(text)}}}]\n{text}'.encode())
        assert reason in "\n".join(found["messages"]), name
    assert "malformed" in describe(b"[" * levels)["messages"][0]


def test_uploads_of_one_client_leave_room_for_another(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        some, done = uploads.Uploads(), asyncio.Event()

        async def compiled(body: bytes) -> bytes:
            if body == b"long":
                await done.wait()
            return body

        monkeypatch.setattr(uploads, "compile_uploads", compiled)
        busy = [asyncio.create_task(some.compile(b"long", "a")) for _ in range(5)]
        await asyncio.sleep(0)
        assert await some.compile(b"short", "b") == b"short"
        done.set()
        await asyncio.gather(*busy)

    asyncio.run(run())


def test_page_is_told_if_files_take_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uploads, "LIMIT_S", 0)
    with pytest.raises(CommandError, match="use shmio-layout"):
        asyncio.run(compile_uploads(request(press_db=BLOCK)))
