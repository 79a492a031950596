from __future__ import annotations

from shmio.endpoints import wrong_tokens
from shmio.endpoints.wrong_tokens import WrongTokens


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def test_wrong_tokens_are_answered_ever_more_slowly_until_they_stop() -> None:
    clock = Clock()
    wrong = WrongTokens(clock)
    assert [wrong.count("10.0.0.1") for _ in range(16)] == [0.0] * 10 + [0.25, 0.5, 1.0, 2.0, 2.0, 2.0]
    assert wrong.count("10.0.0.2") == 0.0
    clock.now_s = wrong_tokens.PERIOD_S
    assert wrong.count("10.0.0.1") == 0.0


def test_remembered_addresses_are_bounded() -> None:
    wrong = WrongTokens(Clock())
    for number in range(3 * wrong_tokens.MAX_HOSTS):
        for _ in range(2):
            wrong.count(str(number))
    assert len(wrong._seen) == wrong_tokens.MAX_HOSTS
    assert sum(map(len, wrong._seen.values())) == 2 * wrong_tokens.MAX_HOSTS
    for _ in range(100):
        wrong.count("one")
    assert len(wrong._seen["one"]) < 20
