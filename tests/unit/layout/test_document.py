from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import LayoutError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.document import load_layout, load_part
from shmio.layout.image import initial_frame
from shmio.layout.model import Layout
from shmio.layout.topic import find

TEXT = """DATA_BLOCK DB5 STRUCT a : Bool; b : Bool; "c/d" : Array[-1..1] of Byte := [1, 2]; // of c
    s : Array[1..2] of Struct t : String[3] := 'ä'; END_STRUCT; r : Real := 1.5; m : DT; n : Int := "MAX"; p : DTL;
    o : Array[0..1] of DT;
    END_STRUCT; BEGIN END_DATA_BLOCK"""


@pytest.fixture
def layout() -> Layout:
    return compile_sources([Source("x.db", TEXT.encode())]).layouts[0]


def test_round_trip(layout: Layout) -> None:
    data = layout.to_json()
    again = load_layout(data)
    assert again == layout
    assert again.to_json() == data
    assert again.hash == layout.hash
    assert len(layout.hash) == 32


def test_documented_object(layout: Layout) -> None:
    document = json.loads(layout.to_json())
    assert list(document) == ["name", "number", "size", "optimized", "registers", "byte_order"]
    assert document["registers"][2] == {
        "path": "c%2Fd",
        "type": "BYTE",
        "dims": [[-1, 1]],
        "offset": 2,
        "bit": None,
        "size": 3,
        "count": 3,
        "comment": "of c",
        "initial": "[1, 2]",
    }
    assert document["registers"][0]["dims"] is None


def test_different_layouts_have_different_hashes(layout: Layout) -> None:
    other = compile_sources([Source("x.db", TEXT.replace("// of c", "// of d").encode())]).layouts[0]
    assert other.hash != layout.hash


CHANGES: list[tuple[str, Any]] = [
    ("name", 5),
    ("number", -1),
    ("number", 1 << 16),
    ("size", 10),
    ("size", -1),
    ("size", 1 << 40),
    ("size", "10"),
    ("optimized", 1),
    ("registers", {}),
    ("registers", None),
    ("byte_order", "middle"),
    ("extra", 1),
]
REGISTER_CHANGES: list[tuple[int, str, Any]] = [
    (0, "path", ""),
    (0, "path", "a/"),
    (0, "path", "a%zz"),
    (0, "path", "in"),
    (0, "path", "a%2fb"),
    (0, "path", "x" * 20_000),
    (0, "path", "/".join("a" * 225)),
    (0, "path", "a\nb"),
    (1, "path", "a"),  # twice
    (0, "type", "Bool"),
    (0, "type", "TOD"),
    (0, "type", "NOPE"),
    (0, "type", "STRING"),
    (0, "type", "BYTE"),  # with a bit
    (0, "bit", None),
    (0, "bit", 8),
    (1, "bit", 0),  # overlap
    (2, "bit", 0),
    (2, "offset", 0),  # overlap
    (2, "offset", 1 << 30),
    (2, "offset", 2.5),
    (2, "size", 4),
    (2, "count", 2),
    (2, "dims", [[1, -1]]),
    (2, "dims", [[0, 1 << 40]]),
    (2, "dims", [[0, 2, 3]]),
    (2, "dims", []),
    (2, "dims", [[0, 0]] * 7),
    (2, "dims", None),
    (2, "comment", None),
    (2, "initial", 5),
    (2, "more", 5),
    (2, "partial", True),
]


@pytest.mark.parametrize(("key", "value"), CHANGES)
def test_changed_layouts_are_refused(layout: Layout, key: str, value: Any) -> None:
    document = json.loads(layout.to_json()) | {key: value}
    with pytest.raises(LayoutError):
        load_layout(json.dumps(document).encode())


@pytest.mark.parametrize(("index", "key", "value"), REGISTER_CHANGES)
def test_changed_registers_are_refused(layout: Layout, index: int, key: str, value: Any) -> None:
    document = json.loads(layout.to_json())
    document["registers"][index][key] = value
    with pytest.raises(LayoutError):
        load_layout(json.dumps(document).encode())


@pytest.mark.parametrize(
    "data",
    [b"", b"[]", b"null", b"\xff", b"{", b"[" * 100_000, b'{"registers":' * 50_000, b'{"name":"\\ud800"}'],
)
def test_other_data_is_refused(data: bytes) -> None:
    with pytest.raises(LayoutError):
        load_layout(data)


@given(st.data())
def test_damaged_json_is_refused_or_consistent(data: st.DataObject) -> None:
    original = compile_sources([Source("x.db", TEXT.encode())]).layouts[0].to_json()
    damaged = bytearray(original)
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    try:
        read = load_layout(bytes(damaged))
    except LayoutError:
        return
    assert load_layout(read.to_json()) == read


def test_initial_frame(layout: Layout) -> None:
    frame, unread = initial_frame(layout)
    assert unread == ("n",)  # a constant only the controller knows
    expected = bytes.fromhex(
        "0000"  # a, b
        "01020000"  # c
        "0301e40000" + "00" + "0301e40000" + "00"  # s
        "3fc00000"  # r
        "9001010000000002"  # m
        "0000"  # n
        "07b201010500000000000000"  # p
         + "9001010000000002" * 2  # o
    )
    assert frame.hex() == expected.hex()


def test_several_threads_may_load_the_first_documents() -> None:
    """A program may attach in each of its threads. A crash would end the whole process."""
    program = """
import sys, threading
from shmio.layout.document import load_layout
data = b'{"name":"x","number":null,"size":1,"optimized":false,"registers":[],"byte_order":"big"}'
sys.setswitchinterval(1e-6)
barrier = threading.Barrier(8)
def load():
    barrier.wait()
    load_layout(data)
threads = [threading.Thread(target=load) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
"""
    for _ in range(5):
        done = subprocess.run([sys.executable, "-c", program], check=False, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")


def test_the_columns_of_a_tag_table_are_in_the_json_where_they_say_something() -> None:
    table = b"""[registers]
    plain = "INT"
    full = { type = "REAL", unit = "bar", address = "ns=2;s=p", scale = [0.1, -4], deadband = 0.5, writable = true }"""
    layout = compile_sources([Source("x.toml", table)]).layouts[0]
    plain, full = json.loads(layout.to_json())["registers"]
    assert plain.keys().isdisjoint(full.keys() - {"path", "type", "offset", "size", *plain})
    given = {key: full[key] for key in full.keys() - plain.keys()}
    assert given == {"unit": "bar", "address": "ns=2;s=p", "scale": [0.1, -4.0], "deadband": 0.5, "writable": True}
    assert load_layout(layout.to_json()) == layout


def test_a_layout_with_a_status_area(layout: Layout) -> None:
    wide = layout.with_statuses()
    assert wide.status_offset == -(-layout.size // 8) * 8
    assert wide.size == wide.status_offset + -(-4 * len(layout.registers) // 8) * 8 + 8 * len(layout.registers)
    assert load_layout(wide.to_json()) == wide
    assert wide.with_statuses() is wide
    assert wide.hash != layout.hash


@pytest.mark.parametrize(("key", "by"), [("size", 8), ("size", -8), ("status_offset", 8), ("status_offset", -1 << 10)])
def test_a_status_area_that_does_not_fit_is_refused(layout: Layout, key: str, by: int) -> None:
    document = json.loads(layout.with_statuses().to_json())
    document[key] += by
    with pytest.raises(LayoutError):
        load_layout(json.dumps(document).encode())


def test_a_status_area_that_is_not_aligned_is_refused(layout: Layout) -> None:
    document = json.loads(layout.with_statuses().to_json())
    document["status_offset"] += 4
    document["size"] += 4
    with pytest.raises(LayoutError, match="not aligned"):
        load_layout(json.dumps(document).encode())


@pytest.mark.parametrize(
    "path", ["a", "b", "c%2Fd", "c%2Fd/-1", "c%2Fd/0..1", "c%2Fd/1.%X3", "s/1/t", "n.%X15", "o/1", "p"]
)
def test_a_part_has_the_same_register(layout: Layout, path: str) -> None:
    part = load_part(layout.to_json(), path)
    assert part is not None
    assert find(part, path) == find(layout, path)
    assert [find(part, one.path) for one in part.registers] == [find(layout, one.path) for one in part.registers]
    assert len(part.registers) == 1
    assert (part.name, part.number, part.size, part.byte_order) == ("DB5", 5, layout.size, "big")


@pytest.mark.parametrize("path", ["s", "s/1", "c%2Fd/2", "c%2Fd/7..8", "r.%X0", "A", "x", "s/1/t/1", "", "aa"])
def test_a_part_of_what_is_no_register_takes_the_whole_layout(layout: Layout, path: str) -> None:
    assert load_part(layout.to_json(), path) is None


def test_a_part_of_a_layout_with_statuses_takes_the_whole_layout(layout: Layout) -> None:
    assert load_part(layout.with_statuses().to_json(), "a") is None


def test_a_comment_cannot_look_like_a_register() -> None:
    text = """DATA_BLOCK DB5 STRUCT a : Int; // {"path":"b","type":"BYTE"}, {"path":"b",
        b : Real; END_STRUCT; BEGIN END_DATA_BLOCK"""
    (layout,) = compile_sources([Source("x.db", text.encode())]).layouts
    assert '"b"' in layout.registers[0].comment
    part = load_part(layout.to_json(), "b")
    assert part is not None
    assert part.registers == layout.registers[1:]


@given(st.data())
def test_a_part_of_damaged_json_is_none_or_possible(data: st.DataObject) -> None:
    (layout,) = compile_sources([Source("x.db", TEXT.encode())]).layouts
    damaged = bytearray(layout.to_json())
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    part = load_part(bytes(damaged), "c%2Fd/0")
    if part is not None:
        (register,) = part.registers
        assert register.offset + register.size <= part.size
        assert load_layout(part.to_json()) == part
