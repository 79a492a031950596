"""The addresses of message fields: how they are parsed, and which values of a message they find."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.ros import messages
from shmio.connectors.ros.addresses import (
    Address,
    FieldError,
    Step,
    extract,
    getter,
    leaf_type,
    parse,
    row_getter,
    scope_of,
)
from shmio.connectors.ros.messages import DEFINITIONS, PRIMITIVES, conforms, default

_NAMES = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,8}", fullmatch=True)
_KEYS = st.tuples(_NAMES, st.text("abj_-. /=ü1", min_size=1, max_size=9))
_STEPS = st.one_of(
    _NAMES.map(Step),
    st.tuples(_NAMES, st.integers(0, 99_999)).map(lambda one: Step(*one)),
    st.tuples(_NAMES, _KEYS).map(lambda one: Step(one[0], None, one[1])),
)
_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["a", "b", "name"]), inner, max_size=3),
    max_leaves=12,
)

_ORDERS = st.lists(st.sampled_from(["a", "b", "c"]), max_size=3)
_ROBOT = st.fixed_dictionaries({"name": _ORDERS, "b": st.lists(st.floats(), max_size=3)}).flatmap(
    lambda one: st.sampled_from([one, {"a": one}])
)


def _text(step: Step) -> str:
    if step.key:
        return f"{step.name}[{step.key[0]}={step.key[1]}]"
    return step.name if step.place is None else f"{step.name}[{step.place}]"


@given(st.lists(_STEPS, min_size=1, max_size=8))
def test_an_address_is_read_as_it_was_meant(steps: list[Step]) -> None:
    assert parse(f" /a/b_1   std_msgs/msg/Thing  {'.'.join(map(_text, steps))} ").steps == tuple(steps)


@given(st.text(max_size=60) | st.text("/ab.[]=0 _M", max_size=40).map(lambda end: f"/t std_msgs/M {end}"))
def test_any_other_text_is_refused(text: str) -> None:
    try:
        address = parse(text)
    except ValueError:
        return
    assert ".".join(map(_text, address.steps)) == address.text


@given(_JSON, st.sampled_from(["a", "a.b", "a[0]", "a[1].b[0]", "a[name=x]", "a.b[name=]x", "b[a=1].a"]))
def test_no_message_breaks_the_extraction(message: Any, field: str) -> None:
    try:
        address = parse(f"/t std_msgs/M {field}")
    except ValueError:
        return
    found, other = _outcome(lambda: extract(message, address)), _outcome(lambda: getter(address)(message))
    assert found is other or found == other


_ROWS = (
    ["a", "b"], ["a.b", "a.a"], ["b[1]", "b[0]"], ["a.b[0]", "a.b[2]", "a.b[0]"], ["b[name=a]", "b[name=b]"],
    ["a.b[name=b]", "a.b[name=a]"],
)  # fmt: skip


@given(st.lists(_JSON | _ROBOT, min_size=1, max_size=3), st.sampled_from(_ROWS))
def test_a_row_finds_what_its_addresses_find(messages: list[Any], fields: list[str]) -> None:
    addresses = [parse(f"/t std_msgs/M {field}") for field in fields]
    assert len({scope_of(address) for address in addresses}) == 1
    get = row_getter(addresses)
    for message in messages:
        alone = [_outcome(partial(extract, message, address)) for address in addresses]
        try:
            found = get(message)
        except (TypeError, LookupError, ValueError):
            assert any(type(one) is tuple for one in alone) or fields == _ROWS[-1]  # the names may be further out
        else:
            assert [*map(id, found)] == [*map(id, alone)]


def test_fields_of_different_messages_form_no_row() -> None:
    texts = ["a", "a.b", "b[0]", "a[name=x]", "b[name=x]", "b[other=x]", "a.b[0]"]
    scopes = [scope_of(parse(f"/t std_msgs/M {text}")) for text in texts]
    assert None not in scopes
    assert len({*scopes}) == len(texts)
    assert scope_of(parse("/t std_msgs/M a[0].b")) is None


def _outcome(call: Callable[[], object]) -> object:
    """Return the value that a call returns, or the text and the code of its error."""
    try:
        return call()
    except FieldError as error:
        return str(error), error.code


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("position[1]", 2.0),
        ("position[name=b]", 2.0),
        ("position", [1.0, 2.0]),
        ("inner.data", 3),
        ("inner.list[0]", "x"),
        ("inner.list[name=a]", "x"),
    ],
)
def test_a_getter_finds_what_the_extraction_finds(field: str, value: object) -> None:
    message = {"name": ["a", "b"], "position": [1.0, 2.0], "inner": {"data": 3, "list": ["x"]}}
    address = parse(f"/t std_msgs/M {field}")
    assert (getter(address)(message), extract(message, address)) == (value, value)


def test_base64_becomes_numbers_at_any_depth(monkeypatch: pytest.MonkeyPatch) -> None:
    """A server sends a sequence of uint8 as base64, also in a sequence of messages."""
    added = {"test_msgs/Image": {"data": "uint8[]", "text": "string"}, "test_msgs/Images": {"all": "test_msgs/Image[]"}}
    monkeypatch.setattr(messages, "DEFINITIONS", {**DEFINITIONS, **added})
    image, there = {"data": "AQL/", "text": "AQL/"}, {"data": [1, 2, 255], "text": "AQL/"}
    assert messages.from_json({"all": [image, image]}, "test_msgs/Images") == {"all": [there, there]}
    assert messages.from_json({"all": [{"data": "*"}, 7]}, "test_msgs/Images") == {"all": [{"data": "*"}, 7]}


@pytest.mark.parametrize("kind", DEFINITIONS)
def test_each_field_of_each_type_is_found_in_its_default(kind: str) -> None:
    assert conforms(default(kind), kind)
    for name, inner in DEFINITIONS[kind].items():
        address = Address("/t", kind, (Step(name),), name)
        assert extract(default(kind), address) == default(inner)
        if inner.removesuffix("[]") in PRIMITIVES:
            assert leaf_type(address) == inner


def test_names_of_a_message_around() -> None:
    message = {"joint_names": ["a", "b"], "points": [{"positions": [1.0, 2.0]}]}
    address = parse("/t trajectory_msgs/JointTrajectory points[0].positions[joint_names=b]")
    assert (extract(message, address), leaf_type(address)) == (2.0, "float64")
