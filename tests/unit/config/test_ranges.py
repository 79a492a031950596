"""Ranges of a campaign file: what they mean, and what is refused."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path

import pytest

from shmio.config.campaign import (
    Campaign,
    CampaignFile,
    campaign_text,
    parse_campaign,
    read_campaign,
    read_settings,
    tables_of,
)
from shmio.config.ranges import Range
from shmio.errors import ConfigError

HEAD = 'duration_s = 3\n[[expect]]\nname = "e"\nalways = "cell/a < 5"\n'
INJECTION = '[[injection]]\nname = "late"\ntarget = "cell/a"\noperation = "offset"\n'


def campaign(tmp_path: Path, keys: str, head: str = HEAD) -> CampaignFile:
    file = tmp_path / "c.toml"
    file.write_text(head + INJECTION + keys)
    return CampaignFile(file)


def load_campaign(file: Path, settings: Sequence[str] = ()) -> Campaign:
    return CampaignFile(file).at(read_settings(settings))


def test_a_point_makes_a_campaign_without_ranges(tmp_path: Path) -> None:
    found = campaign(
        tmp_path,
        "value = { from = -1, to = 5 }\nstart_s = { from = 0, to = 2 }\ntimes = { from = 1, to = 4 }\n"
        'when = { choice = ["cell/a > 1", "cell/b"] }\n',
        HEAD + '[parameters.lift]\n"top m" = { from = 1e-3, to = 10.0, log = true }\nkind = 3\n',
    )
    names = [one.name for one in found.space.dimensions]
    assert names == ["late.value", "late.start_s", "late.times", "late.when", "parameters.lift.top m"]
    middle = found.space.shares(0.5)
    assert middle == {
        "late.value": 2.0, "late.start_s": 1.0, "late.times": 3, "late.when": "cell/b",
        "parameters.lift.top m": pytest.approx(0.1),
    }  # fmt: skip
    concrete = found.at(middle)
    (one,) = concrete.injection
    assert (one.value, one.start_s, one.times, one.when) == (2.0, 1.0, 3, "cell/b")
    assert concrete.parameters == {"lift": {"top m": pytest.approx(0.1), "kind": 3}}
    written = tmp_path / "again.toml"
    written.write_text(campaign_text(tables_of(concrete), ["a case", ""]))
    assert load_campaign(written) == concrete
    assert written.read_text().startswith("# a case\n#\n")


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("{ from = 0, to = 5 }", (0.0, 2.5, 5.0)),
        ("{ from = 0, to = 5, step = 1 }", (0, 3, 5)),
        ("{ from = 0.1, to = 0.7, step = 0.2 }", (0.1, 0.5, 0.7)),
        ("{ from = 1, to = 10000, log = true }", (1.0, 100.0, 10000.0)),
    ],
)
def test_values_of_a_range(tmp_path: Path, text: str, values: tuple[float, ...]) -> None:
    (one,) = campaign(tmp_path, f"value = {text}\n").space.dimensions
    assert isinstance(one, Range)
    found = [one.at(share) for share in (0, 0.5, 1)]
    assert found == [pytest.approx(value) for value in values]
    assert [type(value) for value in found] == [type(value) for value in values]
    assert [one.nearest(value) for value in found] == found
    assert one.nearest(1e9) == values[-1]
    assert one.nearest(-1e9) == values[0]


@pytest.mark.parametrize(
    ("keys", "error"),
    [
        ("value = { from = 5, to = 5 }", r"injection\[0\]\.value\.to: 5 is not above from, 5"),
        ("value = { from = 0 }", r"value\.to: this key is needed"),
        ("value = { form = 0, to = 1 }", r"value\.form: unknown key; did you mean 'from'"),
        ("value = { from = 0, to = 1, step = 2 }", r"value\.step: 2 is not"),
        ("value = { from = 0, to = 1, log = true }", r"value\.from: 0 is not above 0.*logarithm"),
        ("value = { from = 1, to = 2, step = 1, log = true }", r"value\.log: .* step"),
        ("value = { from = nan, to = 1 }", r"value\.from: expected a number"),
        ("value = { from = true, to = 2 }", r"value\.from: expected a number"),
        ("value = { from = 0, to = 1, step = 1e-300 }", r"value\.step: .*1e9"),
        ("value = { choice = [1] }", r"value\.choice: expected a list of 2"),
        ("value = { choice = [1, 2, 1] }", r"value\.choice\[2\]: 1 is given twice"),
        ("value = { choice = [1, { from = 0, to = 1 }] }", r"value\.choice\[1\]: a choice cannot contain a range"),
        ("value = 1\nprobability = { from = 0.1, to = 1.5 }", r"probability: expected .*<= 1"),
        ("value = 1\ntimes = { from = 1, to = 2.5 }", r"times\.from: times takes only whole numbers"),
        ("value = 1\nwhen = { from = 1, to = 2 }", r"injection\[0\]\.when: expected text"),
        ("value = 1\nstart_s = { from = 5, to = 6 }\nend_s = { from = 1, to = 2 }", r"end_s: .* is not after start_s"),
        ("value = 1\nend = { from = 1, to = 2 }", r"end: unknown key"),
        ("amplitude = { from = 1, to = 2 }\nvalue = 1", r"amplitude: operation 'offset' has no such key"),
    ],
)
def test_an_invalid_range_is_named(tmp_path: Path, keys: str, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        campaign(tmp_path, keys + "\n")


@pytest.mark.parametrize(
    ("head", "error"),
    [
        (HEAD.replace("= 3", "= { from = 1, to = 3 }"), "duration_s: only injections and parameters"),
        (HEAD + "within_s = { from = 1, to = 3 }\n", r"expect\[0\]\.within_s: an expectation has no ranges"),
        (HEAD + INJECTION.replace('"late"', '{ choice = ["a", "b"] }') + "value = 1\n", r"\.name: a name has no range"),
    ],
)
def test_what_has_no_range(tmp_path: Path, head: str, error: str) -> None:
    with pytest.raises(ConfigError, match=error):
        campaign(tmp_path, "value = 1\n", head)


def test_ranges_that_contradict_each_other_at_some_points_only(tmp_path: Path) -> None:
    found = campaign(tmp_path, "value = 1\nstart_s = { from = 0, to = 5 }\nend_s = { from = 0, to = 5 }\n")
    found.at({"late.start_s": 1.0, "late.end_s": 2.0})
    with pytest.raises(ConfigError, match="end_s: 1 is not after start_s, 2"):
        found.at({"late.start_s": 2.0, "late.end_s": 1.0})


def test_a_range_is_refused_where_nothing_searches_it(tmp_path: Path) -> None:
    file = campaign(tmp_path, "value = { from = 0, to = 5 }\n").file
    with pytest.raises(ConfigError, match=r"value: this is a range.*falsify.*--set late\.value"):
        load_campaign(file)
    assert load_campaign(file, ["late.value=2.5"]).injection[0].value == 2.5
    with pytest.raises(ConfigError, match=r"unknown range .late\.valu.; did you mean .late\.value"):
        load_campaign(file, ["late.valu=2"])
    with pytest.raises(ConfigError, match=r"value: this is a range.*falsify"):
        read_campaign(file)
    with pytest.raises(ConfigError, match="value: this is a range"):
        parse_campaign(tomllib.loads(INJECTION + "value = { from = 0, to = 5 }\n"))
    for text in ("late.value", "late.value=oh", "late.value=1\nx=2", "=1", "late.value=" + "[" * 100_000):
        with pytest.raises(ConfigError, match="--set"):
            read_settings([text])


@pytest.mark.parametrize(
    ("key", "good", "wrong", "limits"),
    [
        ("value = { from = 0, to = 5 }", ("0", "0.5", "5"), ("-0.1", "6", "nan", "true", '"3"', "[1]"), "0 to 5"),
        ("value = { from = 0, to = 4, step = 2 }", ("1",), ("5",), "0 to 4"),
        ('value = { choice = [1, "NaN"] }', ("1", '"NaN"'), ("true", "0", '"nan"'), "1, 'NaN'"),
    ],
)
def test_a_value_that_is_not_in_the_range_is_refused(
    tmp_path: Path, key: str, good: tuple[str, ...], wrong: tuple[str, ...], limits: str
) -> None:
    file = campaign(tmp_path, f"{key}\n").file
    for text in good:
        load_campaign(file, [f"late.value={text}"])
    for text in wrong:
        with pytest.raises(ConfigError, match=rf"injection\[0\]\.value: .* is not in the range late\.value, {limits} "):
            load_campaign(file, [f"late.value={text}"])


def test_faults_beside_a_range_have_their_own_lines(tmp_path: Path) -> None:
    keys = 'valu = 1\n[[injection]]\nname = "b"\ntarget = "cell/a"\noperation = "offset"\n'
    with pytest.raises(ConfigError) as refused:
        campaign(tmp_path, f"{keys}value = {{ from = 0, to = 5 }}\nend_s = {{ from = -1, to = 5 }}\n")
    found = str(refused.value).replace(str(tmp_path), "").splitlines()
    assert [line.partition(";")[0] for line in found] == [
        "/c.toml:9: injection[0].valu: unknown key",
        '/c.toml:15: injection[1].end_s: expected a number >= 0.0, found -1.0 (injection "b")',
    ]


def test_parameters_of_models_are_not_for_a_running_instance(tmp_path: Path) -> None:
    found = campaign(tmp_path, "value = 1\n", HEAD + "[parameters.lift]\ntop = 1\n")
    with pytest.raises(ConfigError, match=r"parameters: .*--lab"):
        read_campaign(found.file)
