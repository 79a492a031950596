"""What ends the commands that run until they are told to stop."""

from __future__ import annotations

import signal

import pytest

from shmio.cli.run import stop_on_signals


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_them(sign: signal.Signals) -> None:
    with stop_on_signals() as stopping:
        signal.raise_signal(sign)
        assert stopping.wait(20)


def test_under_nohup_a_closed_terminal_does_not() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_on_signals():
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
