"""The phrases that messages share."""

from __future__ import annotations

import pytest

from shmio.wording import MAX_HINTED, did_you_mean, listed, name_one, unknown


@pytest.mark.parametrize(
    ("word", "names", "message"),
    [
        ("Cel", ["cell", "press"], "unknown source 'Cel'; did you mean 'cell'?"),
        ("x", ["cell", "press"], "unknown source 'x'; valid: cell, press"),
        ("x", [], "unknown source 'x'; there are none"),
        (None, ["cell"], "unknown source 'None'; valid: cell"),
        ("a\x1b[2J\nb", ["cell"], "unknown source 'a\\x1b[2J\\nb'; valid: cell"),
        ("c" * (MAX_HINTED + 1), ["c" * MAX_HINTED], f"unknown source '{'c' * 79}…'; valid: {'c' * MAX_HINTED}"),
    ],
)
def test_an_unknown_word_comes_with_a_similar_one_or_all(word: object, names: list[str], message: str) -> None:
    assert unknown("source", word, names) == message


def test_several_similar_names() -> None:
    assert did_you_mean(["a"]) == "did you mean 'a'?"
    assert did_you_mean(["a", "b", "c"]) == "did you mean 'a', 'b' or 'c'?"
    assert did_you_mean([]) == ""


def test_a_long_list_is_cut() -> None:
    assert listed(map(str, range(100))).endswith("28, 29, …")


def test_a_name_is_asked_for_only_where_there_is_something_to_name() -> None:
    assert name_one("source", ["cell", "press"]) == "there are several sources; name one of them: cell, press"
    assert name_one("source", []) == "there is no source"
