"""Signals that stop commands which would otherwise run for ever."""

from __future__ import annotations

import signal

import pytest

from shmio.cli.common import stop_on_signals


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_stops_the_command(sign: signal.Signals) -> None:
    with stop_on_signals() as stopping:
        signal.raise_signal(sign)
        assert stopping.wait(20)


def test_ignored_hang_up_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signals():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
