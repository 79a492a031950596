"""The phrases that messages share."""

from __future__ import annotations

import errno
import os
import re

import pytest

from shmio.wording import MAX_HINTED, cannot_listen, did_you_mean, listed, name_one, unknown


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


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.EADDRINUSE, r"in use; another program, which ss -ltnp shows, has this port: end it, or choose another"),
        (errno.EADDRNOTAVAIL, r"; choose an address of this host, which ip address shows$"),
        (errno.EACCES, r"; choose a port from 1024 on, or allow .*CAP_NET_BIND_SERVICE"),
        (errno.ENOMEM, r"Cannot allocate memory$"),
    ],
)
def test_an_address_that_cannot_be_used_comes_with_the_remedy(number: int, remedy: str) -> None:
    told = cannot_listen("127.0.0.1:80", OSError(number, os.strerror(number)))
    assert told.startswith(f"cannot listen on 127.0.0.1:80: {os.strerror(number)}")
    assert re.search(remedy, told)
