"""The plan of a tag table's reads: few jobs, each within the limits of the controller."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shmio.connectors.s7 import pdu
from shmio.connectors.s7.plan import MAX_ITEMS, Field, merge, most_bytes, pack
from shmio.layout.s7.address import Area

SIZES = [240, 480, 960]


def field(index: int, area: Area, db: int, start: int, size: int) -> Field:
    return Field(index, area, db, start, start + size)


@st.composite
def _fields(draw: st.DrawFn) -> list[Field]:
    found = []
    for index in range(draw(st.integers(1, 60))):
        area = draw(st.sampled_from([Area.BLOCK, Area.INPUT, Area.TIMER]))
        db = draw(st.integers(1, 3)) if area is Area.BLOCK else 0
        if area is Area.TIMER:
            found.append(field(index, area, db, 2 * draw(st.integers(0, 200)), 2))
        else:
            found.append(
                field(index, area, db, draw(st.integers(0, 3000)), draw(st.sampled_from([1, 2, 4, 12, 256, 1500])))
            )
    return found


@given(_fields(), st.sampled_from(SIZES))
def test_each_field_is_read_once_and_each_job_fits(fields: list[Field], pdu_size: int) -> None:
    ranges = merge(fields, most_bytes(pdu_size))
    assert sorted(one.register for whole in ranges for one in whole.fields) == list(range(len(fields)))
    read: dict[object, set[int]] = {}
    for job in pack(ranges, pdu_size):
        assert 1 <= len(job) <= MAX_ITEMS
        request = pdu.read_request(0, [piece.address for piece in job])
        assert len(request) - pdu.FRAME_OVERHEAD <= pdu_size
        answer = 14 + sum(4 + piece.size + piece.size % 2 for piece in job)
        assert answer <= pdu_size
        for piece in job:
            read.setdefault(piece.range, set()).update(range(piece.start, piece.start + piece.size))
    for whole in ranges:
        assert read[whole] == set(range(whole.start, whole.stop))
        assert all(whole.start <= one.start and one.stop <= whole.stop for one in whole.fields)
        assert {(one.area, one.db) for one in whole.fields} == {(whole.area, whole.db)}


@pytest.mark.parametrize(("pdu_size", "expected"), [(240, 3), (480, 2), (960, 2)])
def test_scattered_values_share_jobs_up_to_the_limit_of_items(pdu_size: int, expected: int) -> None:
    fields = [field(index, Area.BLOCK, 1, 100 * index, 2) for index in range(40)]
    assert len(pack(merge(fields, most_bytes(pdu_size)), pdu_size)) == expected


@pytest.mark.parametrize(("pdu_size", "expected"), [(240, 5), (480, 3), (960, 2)])
def test_a_value_longer_than_a_pdu_takes_several_jobs(pdu_size: int, expected: int) -> None:
    fields = [field(0, Area.BLOCK, 1, 0, 1000)]
    assert len(pack(merge(fields, most_bytes(pdu_size)), pdu_size)) == expected


def test_small_gaps_are_read_and_large_ones_are_not() -> None:
    near = [field(0, Area.MARKER, 0, 0, 2), field(1, Area.MARKER, 0, 18, 2)]
    far = [field(0, Area.MARKER, 0, 0, 2), field(1, Area.MARKER, 0, 19, 2)]
    assert (len(merge(near, 222)), len(merge(far, 222))) == (1, 2)
