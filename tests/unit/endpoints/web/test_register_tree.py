from __future__ import annotations

import pytest

from shmio.endpoints.web.register_tree import Row, matching, rows, tree, window
from shmio.layout.model import Layout, Register

LAYOUT = Layout(
    "DB1",
    1,
    40,
    False,
    (
        Register("axis/position", "REAL", (), 0, None, 4, 1, comment="in the world's frame"),
        Register("axis/speed", "REAL", (), 4, None, 4, 1),
        Register("grid", "INT", ((0, 1), (1, 2)), 8, None, 8, 4),
        Register("running", "BOOL", (), 16, 3, 1, 1),
    ),
)
ROOT = tree("cell", LAYOUT)


def shown(*expanded: str) -> list[tuple[str, int]]:
    return [(row.path, row.depth) for row in rows(ROOT, LAYOUT, expanded)]


@pytest.mark.parametrize(
    ("expanded", "visible"),
    [
        ((), [("cell", 0)]),
        (("cell",), [("cell", 0), ("cell/axis", 1), ("cell/grid", 1), ("cell/running", 1)]),
        (
            ("cell", "cell/axis"),
            [
                ("cell", 0),
                ("cell/axis", 1),
                ("cell/axis/position", 2),
                ("cell/axis/speed", 2),
                ("cell/grid", 1),
                ("cell/running", 1),
            ],
        ),
        (("cell/axis",), [("cell", 0)]),
    ],
)
def test_rows_below_expanded_nodes_are_visible(expanded: tuple[str, ...], visible: list[tuple[str, int]]) -> None:
    assert shown(*expanded) == visible


def test_elements_of_an_expanded_array_are_rows() -> None:
    found = [row for row in rows(ROOT, LAYOUT, ("cell", "cell/grid")) if row.depth == 2]
    assert [(row.path, row.name) for row in found] == [
        ("cell/grid/0/1", "0, 1"),
        ("cell/grid/0/2", "0, 2"),
        ("cell/grid/1/1", "1, 1"),
        ("cell/grid/1/2", "1, 2"),
    ]
    assert [row.register.offset for row in found if row.register] == [8, 10, 12, 14]


@pytest.mark.parametrize(
    ("text", "paths"),
    [
        ("SPEED", ["cell/axis/speed"]),
        ("world", ["cell/axis/position"]),
        ("axis", ["cell/axis/position", "cell/axis/speed"]),
        ("nothing", []),
    ],
)
def test_search_finds_paths_and_comments(text: str, paths: list[str]) -> None:
    assert [row.path for row in matching(ROOT, LAYOUT, text)] == paths


def test_window_counts_rows_up_to_a_limit_and_finds_the_marked_one() -> None:
    row, marked = Row("a", "a", 0, None, expandable=False), Row("b", "b", 0, None, expandable=False)
    many = [*[row] * 9, marked]
    for first, most, shown, total, found in (
        (4, 100, 3, 10, marked),
        (7, 100, 3, 10, marked),
        (0, 5, 3, 5, None),
        (20, 100, 0, 10, marked),
    ):
        *_, window_ = window(iter(many), first, 3, most, "b")
        assert window_ is not None
        assert (len(window_.rows), window_.total, window_.marked) == (shown, total, found), (first, most)
    *_, last = window(iter(many), 7, 3, 100)
    assert last is not None
    assert last.rows == [row, row, marked]
