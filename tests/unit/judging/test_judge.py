"""Verdicts on each form of an expectation: passed, failed and inconclusive, in any portions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shmio.config import Expectation
from shmio.config.expectation import expectation_faults
from shmio.errors import ConfigError
from shmio.judging.judge import Judge
from shmio.judging.source import Frames
from shmio.judging.verdict import Outcome, Verdict
from shmio.model.statuses import BAD_DEVICE_FAILURE, UNCERTAIN, RegisterStatus, status_area
from tests.unit.judging.traces import LAYOUT, PERIOD_NS, STALE_NS, golden, image, judge, portions, some

PASSED, FAILED, INCONCLUSIVE = Outcome.PASSED, Outcome.FAILED, Outcome.INCONCLUSIVE
S = PERIOD_NS


def expect(**keys: Any) -> Expectation:
    found = msgspec.convert({"name": "it", **keys}, Expectation)
    assert not list(expectation_faults([found]))
    return found


def trace(
    x: Sequence[float],
    *,
    on: str = "",
    bad: Sequence[int] = (),
    missed: Sequence[int] = (),
    time: Sequence[int] | None = None,
    raw_x: Sequence[float] | None = None,
) -> Frames:
    """Return a frame each second; ``on`` has a 1 for each in which ``on`` is true."""
    count = len(x)

    def images(values: Sequence[float]) -> Any:
        rows = [image((value, 0, 0), on=on[i : i + 1] == "1", n=i) for i, value in enumerate(values)]
        return np.frombuffer(b"".join(rows), np.uint8).reshape(count, LAYOUT.size)

    number = np.arange(1, count + 1) + [sum(at <= i for at in missed) for i in range(count)]
    return Frames(
        number.astype(np.uint64),
        np.arange(count) * S if time is None else np.array(time),
        np.array([0 if i in bad else 2 for i in range(count)], np.uint8),
        np.zeros(count, np.uint32),
        images(x),
        None if raw_x is None else images(raw_x),
    )


def verdict(frames: Frames, **keys: Any) -> Verdict:
    found = judge(expect(**keys))
    found.add("cell", frames)
    found.turn()
    found.finish()
    return found.verdicts[0]


UP = trace([0, 1, 2, 3, 4, 5], on="001110")


@pytest.mark.parametrize(
    ("keys", "outcome", "robustness", "moment_s"),
    [
        ({"always": "x < 6"}, PASSED, 1, None),
        ({"always": "x < 3"}, FAILED, -2, 3),
        ({"always": "x <= 5"}, PASSED, 0, None),
        ({"always": "x < 5"}, FAILED, 0, 5),
        ({"never": "x > 3"}, FAILED, -2, 4),
        ({"never": "x > 9"}, PASSED, 4, None),
        ({"never": "on and x > 4"}, PASSED, 0, None),
        ({"when": "on", "within_s": 2, "then": "x = 4"}, PASSED, 0, None),
        ({"when": "on", "within_s": 1.9, "then": "x = 4"}, FAILED, -1, 2),
        ({"when": "x > 4", "within_s": 2, "then": "x > 9"}, INCONCLUSIVE, None, None),
        ({"when": "x > 9", "within_s": 2, "then": "on"}, INCONCLUSIVE, None, None),
        ({"stays": "on", "for_s": 3}, PASSED, 1, None),
        ({"stays": "on", "for_s": 3.1}, FAILED, -1, 2),
        ({"stays": "x > 4", "for_s": 3}, INCONCLUSIVE, None, None),
        ({"when": "x >= 1", "stays": "not on", "for_s": 1}, PASSED, 0, None),
        ({"when": "x >= 1", "stays": "not on", "for_s": 1.5}, FAILED, 0, 1),
        ({"signal": "x", "max_rate": 1}, PASSED, 0, None),
        ({"signal": "2 * x", "max_rate": 1.5}, FAILED, -0.5, 1),
        ({"formula": "eventually x > 4.5"}, PASSED, 0.5, None),
        ({"formula": "eventually[0, 3] x > 4.5"}, FAILED, -1.5, 3),
        ({"formula": "eventually x > 9"}, FAILED, -4, 5),
        ({"formula": "always[1, 9] x > 0"}, INCONCLUSIVE, None, None),
        ({"formula": "always[1, 9] x < 4"}, FAILED, -1, 4),
        ({"formula": "not eventually on"}, FAILED, -1, 2),
        ({"formula": "not on until x > 1"}, PASSED, 1, None),
        ({"formula": "not on until x > 2.5"}, FAILED, -0.5, 2),
        ({"formula": "always(x < 9) and eventually(x > 4) and always(on implies x > 1)"}, PASSED, 1, None),
        ({"formula": "always(x > 9 implies on)"}, INCONCLUSIVE, None, None),
        ({"formula": "always(on implies once[0, 3] rising(on))"}, PASSED, 1, None),
        ({"formula": "always quality(x) = good"}, PASSED, 0, None),
        ({"always": "age(x) <= 1"}, PASSED, 0, None),
        ({"always": "n = x"}, PASSED, 0, None),
        ({"always": "(x > 2) + on < 3 and 6 / (x + 1) > 0.5"}, PASSED, 0.5, None),
    ],
)
def test_verdicts(keys: Mapping[str, Any], outcome: Outcome, robustness: float | None, moment_s: float | None) -> None:
    found = verdict(UP, **keys)
    assert (found.outcome, found.robustness) == (
        outcome,
        robustness if robustness is None else pytest.approx(robustness),
    )
    assert found.moment_ns == (None if moment_s is None else moment_s * S)
    assert bool(found.reason) == (outcome is not PASSED)
    assert bool(found.around) == (outcome is FAILED)


def test_failed_max_rate_has_the_greatest_rate() -> None:
    found = verdict(trace([0, 1, 4, 8, 9]), signal="x", max_rate=1.5)
    assert (found.reason, found.moment_ns) == ("x changed by more than 1.5 a second (up to 4)", 2 * S)


def test_failure_has_the_values_around_it() -> None:
    found = verdict(UP, never="x > 2 and not on")
    assert found.around == {
        "cell/x": [(3 * S, 3), (4 * S, 4), (5 * S, 5)],
        "cell/on": [(3 * S, 1), (4 * S, 1), (5 * S, 0)],
    }
    found = verdict(UP, always="x != 3")
    assert found.around == {"cell/x": [(S, 1), (2 * S, 2), (3 * S, 3), (4 * S, 4), (5 * S, 5)]}


@pytest.mark.parametrize(
    ("frames", "keys", "outcome", "reason"),
    [
        (
            trace([1, 2, 3], bad=[1]),
            {"always": "x > 0"},
            INCONCLUSIVE,
            "quality of cell is bad from 1.000 s to 2.000 s",
        ),
        (trace([1, 2, 3], bad=[1]), {"always": "x < 3"}, FAILED, "x < 3 was false"),
        (trace([1, 2, 3], bad=[0]), {"formula": "eventually x > 2"}, PASSED, ""),
        (trace([1, 2, 3], bad=[1]), {"never": "quality(x) < good"}, FAILED, "was true"),
        (trace([1, 2, 3], missed=[2]), {"always": "x > 0"}, INCONCLUSIVE, "frames of cell were missed from 1.000 s"),
        (trace([1, 2, 3], missed=[2]), {"always": "x < 3"}, FAILED, "x < 3"),
        (trace([1, 2, 3], time=[0, S, 20 * S]), {"always": "x > 0"}, INCONCLUSIVE, "cell is stale from 11.000 s"),
        (trace([1, 2, 3], time=[0, S, 20 * S]), {"always": "age(x) < 10"}, FAILED, "age(x)"),
        (trace([1, 2, 3], time=[0, S, 20 * S]), {"never": "quality(x) = bad"}, FAILED, "quality"),
        (trace([1, float("nan"), 3]), {"always": "x > 0"}, INCONCLUSIVE, "not a number at 1.000 s"),
        (trace([1, 0, 3]), {"always": "1 / x > 0"}, INCONCLUSIVE, "not a number"),
        (trace([1, 2, 3]), {"formula": "eventually[0, 5] x > 3"}, INCONCLUSIVE, "ended at 2.000 s, before"),
        (trace([1, 2, 3, 4], time=[0, 2 * S, S, 3 * S]), {"always": "x > 0"}, INCONCLUSIVE, "missed from 2.000 s"),
        (trace([1, 9, 3], time=[0, 0, S]), {"always": "x > 2"}, PASSED, ""),
        (trace([1, 9], raw_x=[1, 2]), {"always": "raw(x) < 3"}, PASSED, ""),
        (trace([1, 9], raw_x=[1, 2]), {"always": "x < 3"}, FAILED, ""),
        (trace([1]), {"always": "x > 0"}, PASSED, ""),
        (trace([1, 2, 3], missed=[2]), {"formula": "always[1.5, 1.9] not rise(x > 9)"}, INCONCLUSIVE, "missed"),
        (trace([1, 2, 3]), {"formula": "always[1.5, 1.9] not changed(x)"}, PASSED, ""),
    ],
)
def test_unknown_values_never_decide(frames: Frames, keys: Mapping[str, Any], outcome: Outcome, reason: str) -> None:
    for most in (1, 2, 9):
        found = judge(expect(**keys))
        for part in portions(len(frames.number), np.random.default_rng(1), most):
            found.add("cell", some(frames, part))
            found.turn()
        found.finish()
        assert found.verdicts[0].outcome is outcome
        assert reason in found.verdicts[0].reason


def test_nothing_is_decided_without_frames() -> None:
    found = judge(expect(always="x > 0"), expect(never="on", name="other"))
    found.turn()
    found.finish()
    assert {(one.outcome, one.reason) for one in found.verdicts} == {(INCONCLUSIVE, "there was no frame of cell")}


def test_frame_is_as_old_as_the_device_made_it() -> None:
    slow = trace([1, 2, 3], time=[0, S, 9 * S])._replace(delay_us=np.full(3, 3_000_000, np.uint32))
    found = judge(expect(never="quality(x) = bad"), expect(name="age", always="age(x) < 11"))
    found.add("cell", slow)
    found.finish()
    assert [one.moment_ns for one in found.verdicts] == [8 * S + 1, S], (
        "bad 7 s after the frame of 3 s, and 8 + 3 s old"
    )


def test_status_of_a_register() -> None:
    layout = LAYOUT.with_statuses()
    area = status_area(layout)
    assert area is not None
    rows = []
    for at, code in enumerate((0, UNCERTAIN, BAD_DEVICE_FAILURE, 0)):
        data = bytearray(layout.size)
        data[: LAYOUT.size] = image((at, at, 0))
        area.put(data, 0, RegisterStatus(code, 0))
        rows.append(bytes(data))
    found = Judge(
        [
            expect(always="x < 9"),
            expect(name="y", always="y < 9"),
            expect(name="q", never="quality(x) = bad or quality(y) < good"),
            expect(name="u", formula="eventually[0, 1] quality(x) = uncertain"),
        ],
        {"cell": layout},
        {"cell": STALE_NS},
    )
    images = np.frombuffer(b"".join(rows), np.uint8).reshape(4, layout.size)
    found.add("cell", trace([0, 1, 2, 3])._replace(images=images))
    found.turn()
    found.finish()
    assert [(one.outcome, one.moment_ns) for one in found.verdicts] == [
        (INCONCLUSIVE, None), (PASSED, None), (FAILED, 2 * S), (PASSED, None),
    ]  # fmt: skip


def test_block_that_a_reload_has_replaced() -> None:
    """Its frames count from 1 again; a register that is gone is unknown."""
    other = replace(LAYOUT, registers=LAYOUT.registers[1:])
    found = judge(expect(always="x < 9"), expect(name="y", always="y < 9"), expect(name="q", never="quality(x) = bad"))
    found.add("cell", UP)
    found.turn()
    found.follow("cell", other, STALE_NS)
    found.add("cell", trace([0, 0], time=[6 * S, 7 * S]))
    found.finish()
    assert [(one.outcome, one.moment_ns) for one in found.verdicts] == [
        (INCONCLUSIVE, None), (PASSED, None), (FAILED, 6 * S),
    ]  # fmt: skip


def test_nothing_has_passed_before_the_end() -> None:
    found = judge(expect(always="x < 9"), expect(name="b", formula="eventually x > 2"))
    found.add("cell", UP)
    found.turn()
    assert [(one.outcome, one.reason) for one in found.verdicts] == [
        (INCONCLUSIVE, "the run is not over"),
        (PASSED, ""),
    ]


def test_failure_is_known_as_soon_as_it_is_certain() -> None:
    found = judge(expect(when="on", within_s=1, then="x > 9"))
    told = []
    for at in range(6):
        found.add("cell", some(UP, slice(at, at + 1)))
        found.turn()
        told.append(found.failed)
    assert told == [False, False, False, False, True, True]
    assert found.verdicts[0].moment_ns == 2 * S


def test_two_sources_at_their_own_rates() -> None:
    layouts = {"cell": LAYOUT, "slow": LAYOUT}
    found = Judge(
        [expect(always="cell/x - slow/x < 3"), expect(name="b", never="changed(slow/x) and cell/x > 3")],
        layouts,
        dict.fromkeys(layouts, STALE_NS),
    )
    slow = trace([0, 1, 2], time=[S // 2, 2 * S + S // 2, 4 * S + S // 2])
    for part in range(3):
        found.add("cell", some(UP, slice(2 * part, 2 * part + 2)))
        found.add("slow", some(slow, slice(part, part + 1)))
        found.turn()
    found.finish()
    first, second = found.verdicts
    assert (first.outcome, first.moment_ns, first.robustness) == (FAILED, 4 * S, 0)
    assert (second.outcome, second.moment_ns) == (FAILED, 4 * S + S // 2)
    assert found.begin_ns == S // 2


@pytest.mark.parametrize(
    ("recorded", "keys", "outcome", "robustness", "moment_s"),
    [
        ((0, 1, 2, 3, 4, 5), {}, PASSED, 0, None),
        ((0, 1, 2, 3, 4, 5), {"tolerance": 0.5}, PASSED, 0.5, None),
        ((0, 1, 2, 2, 4, 5), {"tolerance": 0.5}, FAILED, -0.5, 3),
        ((0, 1, 2, 2, 4, 5), {"tolerance_s": 1}, PASSED, 0, None),
        ((1, 2, 3, 4, 5, 6), {"tolerance_s": 0.9}, FAILED, -1, 0),
        ((1, 2, 3, 4, 5, 6), {"tolerance_s": 1}, FAILED, -1, 0),
        ((0, 0, 1, 2, 3, 4), {"tolerance_s": 1, "tolerance": 0.25}, FAILED, -0.75, 5),
        ((0, 1, 2, 3), {}, PASSED, 0, None),
        ((0, 1, 2, 3, 4, 5, 6), {}, INCONCLUSIVE, None, None),
        ((0, 1, float("nan"), 3, 4, 5), {}, INCONCLUSIVE, None, None),
        ((0, 1, float("nan"), 3, 4, 4), {}, FAILED, -1, 5),
    ],
)
def test_like_a_recording(
    recorded: Sequence[float], keys: Mapping[str, Any], outcome: Outcome, robustness: float | None, moment_s: int | None
) -> None:
    for most in (1, 6):
        found = judge(expect(signal="x", like="golden.mem", **keys), golden=golden(*recorded))
        later = UP._replace(clock_ns=UP.clock_ns + 100 * S)
        for part in portions(6, np.random.default_rng(1), most):
            found.add("cell", some(later, part))
            found.turn()
        found.finish()
        one = found.verdicts[0]
        assert (one.outcome, one.robustness) == (outcome, robustness)
        assert one.moment_ns == (None if moment_s is None else (100 + moment_s) * S)


FORMULAS: list[dict[str, Any]] = [
    {"formula": "always(rise(x > 0) implies eventually[0, 2.5] y >= 0)"},
    {"formula": "always[1, 7](y < 3 or once[0.5, 3] rate(x) > 1)"},
    {"stays": "x > -1", "for_s": 1.5},
    {"when": "changed(n)", "within_s": 3, "then": "x * y >= -4"},
    {"signal": "x + y", "max_rate": 5},
    {"signal": ["x", "n"], "like": "g.mem", "tolerance": 4, "tolerance_s": 2.2},
    {"formula": "(x < 4 until[0, 4] y > 1) and always(age(x) < 3 and quality(x) >= uncertain)"},
    {"formula": "always((eventually[0, 1] x > -3) until[0, 60] y > 3)"},
    {"formula": "eventually[0, 6] always[0, 2] (x > 0 and historically[0, 1] y < 9)"},
]


@settings(max_examples=25)
@given(st.integers(0, 2**32))
def test_verdicts_do_not_depend_on_portions(seed: int) -> None:
    random = np.random.default_rng(seed)
    count = 25
    time = np.cumsum(random.choice([0, S // 2, S, 2 * S, 11 * S], count, p=[0.05, 0.3, 0.5, 0.1, 0.05]))
    whole = trace(
        random.integers(-4, 5, count).tolist(),
        bad=random.choice(count, 2).tolist(),
        missed=random.choice(count, 1).tolist(),
        time=time.tolist(),
    )
    found = []
    for most in (1, 4, count):
        one = judge(*(expect(**{"name": f"e{i}", **keys}) for i, keys in enumerate(FORMULAS)), golden=golden(*range(9)))
        for part in portions(count, random, most):
            one.add("cell", some(whole, part))
            one.turn()
        one.finish()
        found.append(one.verdicts)
    assert found[0] == found[1] == found[2]


BOUNDED = [
    "always[0, 20](rise(x > 0) implies eventually[0, 2.5] y >= 0)",
    "always[0, 20] eventually[0, 3] (rise(x > 0) or falling(x > 1) or changed(y))",
    "eventually[2, 18] always[0, 1.5] (x > 0 or historically[0, 1] y < 3)",
    "always[0, 20](fall(x > 0) implies not on until[0, 4] y > -2)",
    "always[1, 17](once[0.5, 3] rate(x) > 1 or x * y < 9)",
    "not eventually[0, 20](rising(x > 1 and y > 1) and once changed(x))",
]


@settings(max_examples=60)
@given(st.integers(0, 2**32))
def test_what_is_hidden_may_only_widen_the_robustness(seed: int) -> None:
    """The robustness of what there really was lies between the bounds for what was seen of it."""
    random = np.random.default_rng(seed)
    count = 27
    time = np.cumsum(random.choice([S // 2, S, 2 * S], count))
    images = [image(random.integers(-4, 5, 3).tolist(), on=bool(random.integers(2))) for _ in range(count)]
    whole = trace([0] * count, time=time.tolist())._replace(
        images=np.frombuffer(b"".join(images), np.uint8).reshape(count, LAYOUT.size)
    )
    quality = whole.quality.copy()
    quality[random.choice(count, 3)] = 0
    kept = np.sort(random.choice(count, count - 3, replace=False))
    kept = np.unique(np.concatenate(([0], kept)))  # the judged time begins with the first frame
    seen = [whole._replace(quality=quality)] if seed % 3 == 0 else [some(whole, kept)]
    seen += [some(whole, slice(0, int(random.integers(2, count))))]
    bounds = []
    for frames in [whole, *seen]:
        found = judge(*(expect(name=f"e{at}", formula=text) for at, text in enumerate(BOUNDED)))
        found.add("cell", frames)
        found.turn()
        found.finish()
        bounds.append([(one.low, one.high) for one in found.verdicts])
    for other in bounds[1:]:
        for text, (low, high), (least, most) in zip(BOUNDED, bounds[0], other, strict=True):
            assert least <= low <= high <= most, text


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"formula": "x < 5"}, "expect[0].formula: this formula judges only the first moment; write always"),
        ({"formula": "always x <"}, "expect[0].formula: at character 11: expected a register or a number"),
        (
            {"formula": "always(eventually x > 1)"},
            "formula: at character 8: 'eventually' within another operator needs",
        ),
        ({"formula": "always rise(once x > 1)"}, "formula: at character 8: rise( ) compares a frame with the one"),
        ({"formula": "always[2, 1] x"}, "formula: at character 8: the first bound is above the second one"),
        ({"formula": "always[0, 1e9] x"}, "formula: at character 11: a bound is at most 1000000 s"),
        (
            {"formula": "always[0,2s] x"},
            "at character 10: '2s' is not a number; times are in s, without a unit: write 2",
        ),
        (
            {"formula": "always[0, 500ms] x"},
            "at character 11: '500ms' is not a number; times are in s, without a unit: write 0.5",
        ),
        (
            {"formula": "always[0 min, 1] x"},
            "at character 10: expected ',', found 'min'; a bound is a time in s, without",
        ),
        ({"formula": "always(x/4 > 1)"}, "x is a number: put blanks around the '/' of a division: x / 4"),
        (
            {"formula": "always(cell/x/4/2 > 1)"},
            "cell/x is a number: put blanks around the '/' of a division: cell/x / 4/2",
        ),
        ({"formula": "always[0 1] x"}, "at character 10: expected ',', found '1'"),
        ({"formula": "always quality(x + 1) = good"}, "at character 8: quality( ) takes one register"),
        ({"formula": "always q > 1"}, "expect[0].formula: at character 8: q: DB1 has no such register"),
        ({"formula": "always true"}, "expect[0].formula: at character 1: 'always' is always the same"),
        ({"formula": "always(1 > 2 or x)"}, "at character 10: '>' is always the same here"),
        ({"never": "x and"}, "expect[0].never: at character 6"),
        ({"when": "always x", "within_s": 1, "then": "x"}, "expect[0].when: a temporal operator has no meaning here"),
        ({"when": "x", "within_s": 1, "then": "z >"}, "expect[0].then: at character 4"),
        ({"signal": "x >", "max_rate": 1}, "expect[0].signal: at character 4"),
        ({"always": "("}, "expect[0].always: at character 2"),
        ({"always": "eventually[0, 1] " * 6 + "x"}, None),
        ({"always": "eventually[0, 1] " * 7 + "x"}, "nested more than 6 levels deep"),
        ({"formula": "once x > 1"}, "judges only the first moment"),
        ({"always": "eventually[0, 1e6] eventually[0, 1] x"}, "add up to more than 1000000 s"),
        ({"always": " + ".join(["x"] * 101)}, "more than 200 parts"),
        ({"always": "x" * 1001}, "at most 1000 characters"),
    ],
)
def test_wrong_expectation_is_refused(keys: Mapping[str, Any], message: str | None) -> None:
    if message is None:
        assert judge(expect(**keys)).sources == ("cell",)
        return
    with pytest.raises(ConfigError, match=r'^[^\n]*\(expect "it"\)$') as raised:
        judge(expect(**keys))
    assert message in str(raised.value)


TEXT = (
    "x y on 1 2.5 true good always eventually once historically until [0,1] [1,1] implies and or not rise fall rate "
    "changed quality age raw abs ( ) ( ) + - * / mod < == >="
)
WORDS = st.sampled_from(TEXT.split(" "))


@settings(max_examples=100)
@given(st.lists(WORDS, min_size=1, max_size=14).map(" ".join))
def test_any_formula_is_judged_or_refused(text: str) -> None:
    try:
        found = judge(expect(formula=text))
    except ConfigError:
        return
    for part in (slice(0, 2), slice(2, 3), slice(3, 6)):
        found.add("cell", some(UP, part))
        found.turn()
    found.finish()
    assert found.verdicts[0].outcome in Outcome
