from __future__ import annotations

import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.errors import PathError
from shmio.layout.compiler import Source, compile_sources
from shmio.layout.model import Layout, Register
from shmio.layout.topic import (
    MAX_TOPIC,
    Topic,
    canonical_path,
    decode_segment,
    encode_segment,
    find,
    look_up,
    look_up_each,
    parse_topic,
)

SOURCES = ("cell", "sim", "Robot")


@pytest.mark.parametrize(
    ("text", "source", "path", "direction"),
    [
        ("cell/a/b/out", "cell", "a/b", "out"),
        ("/cell/a/in", "cell", "a", "in"),
        ("cell/a", "cell", "a", None),
        ("a/b/in", "cell", "a/b", "in"),
        ("/model/clock", "model", "clock", None),
        ("joints/R3200/Link1/R/position/out", "cell", "joints/R3200/Link1/R/position", "out"),
        ("SIM://joints/Kuka.j1/R/in", "sim", "joints/Kuka.j1/R", "in"),
        ("sim:///joints", "sim", "joints", None),
        ("SIMLOG://step", "simlog", "step", None),
        ("ROBOT://x", "Robot", "x", None),
        ("sim/out", "sim", "", "out"),
        ("sim", "sim", "", None),
        ("sim/", "sim", "", None),
        ("SIM://", "sim", "", None),
        ("CELL://in", "cell", "", "in"),
        ("Cell/a", "cell", "Cell/a", None),  # only a scheme ignores case
        ("cell/cell/a", "cell", "cell/a", None),
        ("cell/a/In", "cell", "a/In", None),
        ("cell/a/in/out", "cell", "a/%69n", "out"),
        ("cell/in/a", "cell", "%69n/a", None),
        ("cell/%69n/in", "cell", "%69n", "in"),
        ("cell/%6fut", "cell", "%6Fut", None),
        ("cell/Axs2%20Pos", "cell", "Axs2 Pos", None),
        ("cell/Axs2 Pos", "cell", "Axs2 Pos", None),
        ("cell/a%2fb", "cell", "a%2Fb", None),
        ("cell/a+b#c", "cell", "a%2Bb%23c", None),
        ("cell/%E8%BD%B41", "cell", "轴1", None),
        ("cell/a/5/out", "cell", "a/5", "out"),
    ],
)
def test_parse(text: str, source: str, path: str, direction: str | None) -> None:
    topic = parse_topic(text, SOURCES, "cell")
    assert (topic.source, topic.path, topic.direction) == (source, path, direction)
    assert parse_topic(str(topic), SOURCES, None) == topic


@pytest.mark.parametrize(
    "text",
    [
        "",
        "/",
        "in",
        "/out",
        "a//b",
        "cell//a",
        "//a",
        "a/",
        "a/%",
        "a/%4",
        "a/%zz",
        "a/%ff",
        "nope://a",
        "x" * (MAX_TOPIC + 1),
    ],
)
def test_malformed(text: str) -> None:
    with pytest.raises(PathError):
        parse_topic(text, SOURCES, "cell")


@pytest.mark.parametrize("part", ["%X0", "%B1", "%W0", "%D0", "%X31"])
def test_a_path_may_end_in_a_part_of_a_register(part: str) -> None:
    topic = parse_topic(f"cell/a b/8.{part}/in", SOURCES, "cell")
    assert (topic.path, topic.direction) == (f"a b/8.{part}", "in")
    with pytest.raises(PathError, match=rf"^8\.{part}: a bit or another part of a register is allowed only at the end"):
        parse_topic(f"cell/a/8.{part}/b", SOURCES, "cell")
    with pytest.raises(PathError, match="only at the end"):
        canonical_path(f"a/8.{part}")  # like the path of a register in a layout
    assert parse_topic("cell/8.%X07", SOURCES, "cell").path == "8.%X7"


def test_without_default_the_source_must_be_named() -> None:
    assert parse_topic("cell/a", SOURCES, None) == Topic("cell", "a", None)
    with pytest.raises(
        PathError, match=r"^a/b: 'a' is not one of the 3 sources; begin the path with cell/… or sim/… or R"
    ):
        parse_topic("a/b", SOURCES, None)
    with pytest.raises(PathError, match=r"or s3/…, …$"):
        parse_topic("a/b", [f"s{number}" for number in range(200)], None)
    with pytest.raises(PathError, match="a: there are no sources"):
        parse_topic("a", [], None)
    with pytest.raises(PathError, match=r"unknown source 'nope'; valid: cell, sim, Robot"):
        parse_topic("nope://a", SOURCES, "cell")


def test_a_misspelt_source_is_corrected_in_the_whole_topic() -> None:
    with pytest.raises(PathError, match=r"^cel/a/1: 'cel' is not one of the 3 sources; did you mean 'cell/a/1'\?$"):
        parse_topic("cel/a/1", SOURCES, None)


@pytest.mark.parametrize(
    ("text", "suggested"),
    [
        ("cell/robot/axs2", "'cell/Robot/Axs2'"),
        ("robot/axs2", "'cell/Robot/Axs2'"),
    ],
)
def test_suggestions_are_whole_topics(layout: Layout, text: str, suggested: str) -> None:
    for search in (look_up, look_up_each):
        with pytest.raises(PathError, match=rf"DB1 has no such register; did you mean {suggested}\?"):
            search(layout, parse_topic(text, ["cell"], "cell"))


@pytest.mark.parametrize(
    ("text", "rest"),
    [
        ("cel/Inputs/5", "; did you mean 'cell/Inputs/5'?"),
        ("Cell/inputs/5", "; did you mean 'cell/Inputs/5'?"),
        ("cel/Robot/Axs3", "; did you mean 'cell/Robot/Axs2' or 'cell/Robot/Axs1'?"),
        ("plc/robot/axs2", "; did you mean 'cell/Robot/Axs2'?"),
        ("plc/Inputs/5..99", "; did you mean 'cell/Inputs'?"),
        ("plc/x", ""),
        ("plc/x/8.%X3", ""),
    ],
)
def test_error_for_a_path_with_an_unknown_source_says_that_there_is_neither(
    layout: Layout, text: str, rest: str
) -> None:
    for search in (look_up, look_up_each):
        with pytest.raises(PathError) as caught:
            search(layout, parse_topic(f"{text}/out", ["cell"], "cell"))
        source = text.partition("/")[0]
        expected = f"no source '{source}' and no register '{text}' in source 'cell'{rest}"
        assert str(caught.value).startswith(expected)
        assert rest or str(caught.value) == expected


def test_error_for_a_path_without_a_source_names_the_searched_source(layout: Layout) -> None:
    with pytest.raises(PathError, match=r"^b: DB1 has no such register \(searched in source 'cell', because the path"):
        look_up(layout, parse_topic("b/out", SOURCES, "cell"))
    with pytest.raises(PathError, match=r"^cell/b: DB1 has no such register$"):
        look_up(layout, parse_topic("cell/b", SOURCES, "cell"))
    assert look_up(layout, parse_topic("Inputs/3", SOURCES, "cell")).offset == 3


@given(st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1))
def test_every_name_can_be_encoded_in_a_path(name: str) -> None:
    segment = encode_segment(name)
    assert decode_segment(segment) == name
    assert not set(segment) & set("/+#")
    assert parse_topic(f"cell/{segment}", ["cell"], None) == Topic("cell", segment, None)
    assert parse_topic(f"cell/{segment}/in", ["cell"], None) == Topic("cell", segment, "in")


@given(st.text())
def test_any_text_parses_or_is_refused(text: str) -> None:
    try:
        topic = parse_topic(text, SOURCES, "cell")
    except PathError:
        return
    assert parse_topic(str(topic), SOURCES, "cell") == topic


@pytest.fixture
def layout() -> Layout:
    text = """DATA_BLOCK DB1 STRUCT
        Inputs : Array[0..9] of Byte;
        Grid : Array[-1..0, 1..9] of Bool;
        Robot : Struct Axs1 : Real; Axs2 : Real; END_STRUCT;
        Zones : Array[1..2] of Struct Level : Array[0..1] of Int; END_STRUCT;
        END_STRUCT; BEGIN END_DATA_BLOCK"""
    return compile_sources([Source("x.db", text.encode())]).layouts[0]


@pytest.mark.parametrize(
    ("path", "offset", "bit", "type_"),
    [
        ("Inputs", 0, None, "BYTE"),
        ("Inputs/0", 0, None, "BYTE"),
        ("Inputs/9", 9, None, "BYTE"),
        ("Grid/-1/1", 10, 0, "BOOL"),
        ("Grid/-1/9", 11, 0, "BOOL"),
        ("Grid/0/2", 12, 1, "BOOL"),
        ("Robot/Axs2", 18, None, "REAL"),
        ("Zones/2/Level", 26, None, "INT"),
        ("Zones/2/Level/1", 28, None, "INT"),
    ],
)
def test_find(layout: Layout, path: str, offset: int, bit: int | None, type_: str) -> None:
    register = find(layout, path)
    assert (register.path, register.offset, register.bit, register.type) == (path, offset, bit, type_)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("", "names a source"),
        ("Robot", "a structure, not a register; it contains Robot/Axs1, Robot/Axs2"),
        ("Zones/1", "a structure"),
        ("Robot/Axs3", "DB1 has no such register; did you mean 'Robot/Axs2' or 'Robot/Axs1'?"),
        ("inputs", "did you mean 'Inputs'"),
        ("inputs/5", "did you mean 'Inputs/5'"),
        ("ROBOT/axs2", "did you mean 'Robot/Axs2'"),
        ("robot", "did you mean 'Robot'"),
        ("rboot/axs2", "did you mean 'Robot/Axs2' or"),
        ("cell/Robot/Axs2", "did you mean 'Robot/Axs2' or"),
        ("zones/2/Level/1", "did you mean 'Zones/2/Level/1'"),
        ("zones/7/level", "did you mean 'Zones/2/Level', 'Zones/1/Level'"),
        ("Robot/5", "DB1 has no such register; did you mean 'Robot/Axs2' or 'Robot/Axs1'?"),
        ("Inputs/10", "outside [0..9]"),
        ("Inputs/05", "no such register"),
        ("Inputs/+5", "no such register"),
        ("Inputs/5/5", "outside"),
        ("Grid/0", "outside"),
        ("Grid/1/1", "outside [-1..0,1..9]"),
        ("Robot/Axs1/0", "a single REAL, not an array"),
        ("5", "no such register"),
        ("Zones/7/Level", "Zones/7: the index is outside "),
        ("Robots", "did you mean 'Robot'"),
        ("x" * 10_000, "no such register"),
        ("Inputs" + "/1" * 5000, "no such register"),
    ],
)
def test_not_found(layout: Layout, path: str, message: str) -> None:
    with pytest.raises(PathError) as caught:
        find(layout, path)
    assert message in str(caught.value)
    assert len(str(caught.value)) < 400


def test_members(layout: Layout) -> None:
    assert layout.members("Robot") == (2, 3)
    assert layout.members("Zones") == (4, 5)
    assert layout.members("Zones/2") == (5,)
    assert layout.members("Inputs") == layout.members("Rob") == layout.members("") == ()


def test_deep_and_long_paths_are_looked_up_in_little_memory() -> None:
    """The paths have the maximum length. A table of all structures would take 180 MB."""
    deep = "/".join(["x" * 70] * 222)
    paths = [f"{index}/{deep}/Last" for index in range(100)]
    layout = Layout("x", None, 100, False, tuple(Register(p, "BYTE", (), i, None, 1, 1) for i, p in enumerate(paths)))
    tracemalloc.start()
    try:
        assert layout.members(f"7/{deep}") == (7,)
        with pytest.raises(PathError, match="no such register"):
            find(layout, f"7/{deep}/last")
        assert layout.in_any_case(f"7/{deep}/last".upper()) == paths[7]
        assert layout.in_any_case(f"7/{deep}".upper()) == f"7/{deep}"
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()


def test_structures_are_distinguished_from_names_with_the_same_prefix() -> None:
    paths = ["a.b/c", "a/c", "a-b", "A/d", "a0", "a/b/c"]
    layout = Layout("x", None, 6, False, tuple(Register(p, "BYTE", (), i, None, 1, 1) for i, p in enumerate(paths)))
    assert layout.members("a") == (1, 5)
    assert layout.members("a/b") == (5,)
    assert layout.members("a/c") == layout.members("") == layout.members("a0") == ()
    assert layout.in_any_case("A.B/C") == "a.b/c"
    assert layout.in_any_case("a/D") == "A/d"
    assert layout.in_any_case("A/B") == "a/b"
    assert layout.in_any_case("A.") is None
