"""What alerts see of sources and processes, and the notices that they give."""

from __future__ import annotations

import pytest

from shmio.config import Alert
from shmio.endpoints.alerts import monitor
from shmio.segment import Phase, Quality, Supervised
from tests.unit.endpoints.alerts.harness import watched
from tests.unit.endpoints.harness import image

HOT = Alert(name="hot", when="cell/axis/position > 5", every_s=10, resolved=True, text="Too hot", severity="critical")


def test_each_frame_is_evaluated_once(instance: str) -> None:
    with watched(instance, HOT, Alert(name="edge", when="rising(cell/axis/position > 5)", every_s=0.1)) as one:
        assert one.at(0, position=1) == []
        for time_s in range(1, 7):  # all before the monitor looks
            one.publish(time_s, position=9 if time_s % 2 else 1)
        notices = one.until(7)
        assert [(n.alert, str(n.state), n.clock_s) for n in notices] == [
            ("hot", "active", 1), ("edge", "active", 1), ("hot", "resolved", 2), ("edge", "active", 3),
            ("edge", "active", 5),
        ]  # fmt: skip
        assert one.monitor.missed == 0
        assert one.monitor.done == 7


def test_a_notice_tells_what_was_seen(instance: str) -> None:
    with watched(instance, HOT) as one:
        one.at(1, position=1)
        [told] = one.at(2.5, effective=image(position=6.5), position=1)
        assert (told.alert, told.instance, told.text, told.severity) == ("hot", instance, "Too hot", "critical")
        assert told.values == {"cell/axis/position": 6.5}
        assert told.injected
        assert told.provenance == "live"
        assert (told.clock_s, told.since_s) == (2.5, 2.5)
        [ended] = one.at(3.5, position=2)
        assert (ended.clock_s, ended.since_s, ended.injected) == (3.5, 2.5, False)
        assert ended.id != told.id


def test_a_rate_limit_by_the_instances_clock(instance: str) -> None:
    with watched(instance, HOT) as one:
        assert len(one.at(1, position=9)) == 1
        assert len(one.at(2, position=1)) == 1
        assert one.at(3, position=9) + one.at(4, position=1) + one.at(5, position=9) == []
        assert one.until(10.9) == []
        [told] = one.until(11)
        assert (told.suppressed, told.since_s) == (1, 5)
        assert one.monitor.suppressed == 1


def test_a_time_limit_by_the_instances_clock_without_a_frame(instance: str) -> None:
    with watched(instance, Alert(when="cell/running", for_s=3)) as one:
        assert one.at(1, running=True) + one.until(3.9) == []
        [told] = one.until(4)
        assert told.alert == "cell/running"


def test_a_time_limit_ends_at_a_frame_even_if_it_is_read_late(instance: str) -> None:
    with watched(instance, Alert(when="cell/running", for_s=3)) as one:
        one.at(0)
        one.publish(1, running=True)
        one.publish(4, running=True)
        one.publish(5, running=False)
        assert [told.clock_s for told in one.until(5)] == [4]


def test_bad_quality_is_no_edge_of_a_condition_but_one_of_the_source(instance: str) -> None:
    bad = Alert(source="c*", quality=["bad", "uncertain"], every_s=0.1, resolved=True)
    with watched(instance, HOT, Alert(name="cold", when="not (cell/axis/position > 5)"), bad) as one:
        assert [n.alert for n in one.at(1, position=9)] == ["hot"]
        [told] = one.at(2, quality=Quality.BAD, position=1)
        assert (told.alert, "cell is bad" in told.reason) == ("source c*", True)
        assert one.at(3, quality=Quality.UNCERTAIN, position=9) == []
        assert [(n.alert, str(n.state)) for n in one.at(4, position=9)] == [("source c*", "resolved")]


def test_a_stale_value_is_unknown(instance: str) -> None:
    with watched(instance, HOT, Alert(source="cell")) as one:
        one.at(1, position=9)
        assert [n.alert for n in one.until(70)] == ["source cell"]
        assert one.monitor.alerts[0].active, "it is unknown whether it is still hot"


def test_a_value_that_was_stale_in_between_interrupts_a_time_limit(instance: str) -> None:
    with watched(instance, Alert(when="cell/running", for_s=62)) as one:
        one.publish(1, running=True)
        one.publish(70, running=True)
        assert one.until(70) == []
        assert one.until(129) == []


def test_a_source_without_a_frame_is_bad(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(monitor, "LOOK_S", 0.0)
    with watched(instance, Alert(source="cell", for_s=2)) as one:
        assert one.until(1) == []
        assert [n.reason for n in one.until(3)] == ["cell is bad: no data yet"]


def test_values_of_several_sources_are_compared_in_order(instance: str) -> None:
    alert = Alert(when="a/axis/position > b/axis/position", every_s=0.1)
    with watched(instance, alert, sources=("a", "b")) as one:
        one.at(1, "a", position=5)
        one.at(1, "b", position=9)
        one.publish(2, "b", position=20)
        one.publish(3, "a", position=15)
        assert one.until(3) == [], "a never was above b"
        assert len(one.at(4, "b", position=1)) == 1


def test_states_of_processes(instance: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(monitor, "LOOK_S", 0.0)
    monkeypatch.setattr("shmio.segment.segment.Segment.supervised", True)
    died = Alert(process="*", every_s=0.1, resolved=True)
    with watched(instance, died, Alert(process="cell", state="stopped", every_s=0.1)) as one:
        slot = one.segment.processes.find("cell")

        def seen(phase: Phase, note: str = "") -> list[tuple[str, str]]:
            slot.supervised = Supervised(phase, 0, 0, note)
            one.step += 1
            return [(n.alert, str(n.state)) for n in one.until(one.step)]

        assert seen(Phase.RUNNING) == []
        assert seen(Phase.STARTING, "restarting") == [], "on request"
        assert seen(Phase.STARTING, "killed by signal 9") == [("process *", "active")], "at once after its first crash"
        assert seen(Phase.FATAL, "wrong") == []
        assert seen(Phase.STOPPED) == [("process *", "resolved"), ("process cell", "active")]
        assert one.monitor.alerts[1].finding.reason == "cell is in state stopped"


def test_a_restarted_process_repeats_no_notice(instance: str) -> None:
    with watched(instance, HOT) as one:
        one.at(1, position=9)
        before = {"hot": one.monitor.alerts[0].lifecycle.progress}
        again = monitor.Monitor(one.segment, [HOT], before, one.selector)
        assert again.run_once()[0] == []
        one.publish(2, position=1)
        assert [str(n.state) for _, n in again.run_once()[0]] == ["resolved"]
        again.close()
