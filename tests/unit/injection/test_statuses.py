from __future__ import annotations

from shmio.injection.program import compile_condition
from shmio.model.statuses import BAD_NODE_ID_UNKNOWN, UNCERTAIN_LAST_USABLE_VALUE
from tests.unit.statuses import LAYOUT, SPEED, first_image


def test_a_condition_does_not_know_the_value_of_a_bad_register() -> None:
    condition = compile_condition("plant/speed > 1 and plant/count == 1", {"plant": LAYOUT})
    image = first_image()
    for code, expected in ((0, 1.5), (UNCERTAIN_LAST_USABLE_VALUE, 1.5), (BAD_NODE_ID_UNKNOWN, None)):
        image.fail(SPEED, code)
        assert [codec.decode(bytes(image)) for _, codec in condition.reads] == [expected, 1]
