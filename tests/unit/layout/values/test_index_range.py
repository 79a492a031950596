"""Index ranges, with the examples and rules of OPC 10000-4, section 7.27."""

from __future__ import annotations

from typing import Any

import pytest

from shmio.layout.values.index_range import NoDataError, ShapeError, parse, replace, select

SQUARE = [[1, 2, 3], [4, 5, 6]]
CASES: list[tuple[Any, str, Any]] = [
    ([10, 11, 12, 13], "2", [12]),
    ([10, 11, 12, 13], "1:2", [11, 12]),
    ([10, 11, 12, 13], "2:9", [12, 13]),
    ([10, 11, 12, 13], "4", NoDataError),
    ([10, 11, 12, 13], "4:9", NoDataError),
    ([10, 11], "0,0", NoDataError),
    (SQUARE, "1,0:1", [[4, 5]]),
    (SQUARE, "0:1,2", [[3], [6]]),
    (SQUARE, "0:1,0:2", SQUARE),
    (SQUARE, "1", NoDataError),
    (SQUARE, "0,3", NoDataError),
    (SQUARE, "0,0,0", NoDataError),
    ("shmio", "1:3", "hmi"),
    ("shmio", "0", "s"),
    ("shmio", "5", NoDataError),
    (b"\1\2\3", "1:2", b"\2\3"),
    (["abcd", "e"], "0:1,1:2", ["bc", ""]),
    (["abcd", "e"], "1,1", NoDataError),
    (7, "0", NoDataError),
    ([], "0", NoDataError),
]


def test_the_part_that_a_range_selects() -> None:
    for value, text, expected in CASES:
        if expected is NoDataError:
            with pytest.raises(NoDataError):
                pytest.fail(f"{value} has {select(value, parse(text))} at {text}")
        else:
            assert select(value, parse(text)) == expected, (value, text)


def test_a_text_that_is_no_range_is_refused() -> None:
    for text in ("", "a", "-1", "1:1", "2:1", "1:", ":1", "1,", ",1", "1:2:3", " 1", "1 ", "٣", "1;2", "99999999999"):
        with pytest.raises(ValueError, match="range"):
            pytest.fail(f"{text!r} is {parse(text)}")


def test_new_contents_leave_the_rest_as_it_was() -> None:
    written: list[tuple[Any, str, Any, Any]] = [
        ([1, 2, 3], "1", [9], [1, 9, 3]),
        ([1, 2, 3], "1:2", [8, 9], [1, 8, 9]),
        (SQUARE, "1,0:1", [[8, 9]], [[1, 2, 3], [8, 9, 6]]),
        (SQUARE, "0:1,1", [[8], [9]], [[1, 8, 3], [4, 9, 6]]),
        ("shmio", "1:2", "HM", "sHMio"),
        (b"abc", "0", b"x", b"xbc"),
    ]
    for value, text, part, expected in written:
        assert replace(value, parse(text), part) == expected, (value, text)
    refused: list[tuple[Any, str, Any, type[Exception]]] = [
        ([1, 2, 3], "2:3", [1, 2], NoDataError),
        ([1, 2, 3], "3", [1], NoDataError),
        ([1, 2, 3], "0,0", [[1]], NoDataError),
        (SQUARE, "0", [[1, 2, 3]], NoDataError),
        ([1, 2, 3], "0:1", [1], ShapeError),
        ([1, 2, 3], "0", 1, ShapeError),
        (SQUARE, "0,0:1", [[1, 2, 3]], ShapeError),
        ("abc", "0:1", "x", ShapeError),
    ]
    for value, text, part, error in refused:
        with pytest.raises(error):
            pytest.fail(f"{value} at {text} became {replace(value, parse(text), part)}")
