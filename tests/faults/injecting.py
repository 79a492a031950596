"""Runs injecting clients one after the other, and checks their injections while they run and after they end."""

from __future__ import annotations

import random
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count, cycle, product
from typing import Any, Final

from shmio.errors import CommandError, PathError, QualityError
from shmio.local.attach import Attachment
from shmio.model.injection import Injection
from shmio.model.values import OutcomeKind
from tests.faults.checker import Checker
from tests.faults.checks import Counts, Source, word_at
from tests.faults.inject_checks import QUIET_NS, SHOWN_NS, GuardCheck, LifeCheck
from tests.faults.injector import WAYS, Order
from tests.faults.local import attached
from tests.faults.plc import SHOWN_AT

PAUSE_S: Final = 0.05
BEGIN_S: Final = 20.0
"""Maximum time for a client to create its injection."""
EFFECT_NS: Final = 90 * 10**9
"""Maximum time without any effect of an injection."""
KEPT_NS: Final = 1_500_000_000
"""Time for which a kept injection is observed after its client's end."""
NUMBERS: Final = 1000
"""Number of values that are reserved for one client."""
REMEMBERED: Final = 100


class Client:
    """An injecting client in a separate process."""

    def __init__(self, order: Order) -> None:
        self.order = order
        self.stands = threading.Event()
        pipe = subprocess.PIPE
        command = [sys.executable, "-P", "-m", "tests.faults.injector", order.to_json()]
        self._popen = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self._popen.stdout is not None
        for line in self._popen.stdout:
            if line == "stands\n":
                self.stands.set()

    @property
    def over(self) -> bool:
        """True if the client has ended."""
        return self._popen.poll() is not None

    def end(self, *, kill: bool) -> int:
        """Kill the client, or let it lift its injection; return CLOCK_MONOTONIC of its end."""
        assert self._popen.stdin is not None
        if kill:
            self._popen.kill()
        self._popen.stdin.close()
        try:
            self._popen.wait(BEGIN_S)
        except subprocess.TimeoutExpired:  # it waits for a frozen endpoint
            self._popen.kill()
            self._popen.wait()
        ended_ns = time.monotonic_ns()
        self._reader.join()
        assert self._popen.stdout is not None
        self._popen.stdout.close()
        return ended_ns


class Awake:
    """Times since which processes have run without a pause, by their heartbeats."""

    def __init__(self, attachment: Attachment) -> None:
        self._attachment = attachment
        self._since_ns: dict[str, tuple[int, int]] = {}

    def look(self) -> None:
        """Read all heartbeats. Call it several times a second."""
        now_ns = time.monotonic_ns()
        for slot in self._attachment._segment.processes:
            pid, since_ns = self._since_ns.get(slot.name, (0, now_ns))
            if slot.report.pid != pid or now_ns - slot.heartbeat_ns > QUIET_NS or not slot.alive():
                since_ns = now_ns
            self._since_ns[slot.name] = slot.report.pid, since_ns

    def since_ns(self, *names: str) -> int:
        """Return CLOCK_MONOTONIC since which all of these have run without a pause."""
        return max(self._since_ns.get(name, (0, time.monotonic_ns()))[1] for name in names)


@dataclass
class Target:
    """A source, the check of its writes, and the last values written."""

    source: Source
    guard: GuardCheck
    past: deque[int]


class Injecting:
    """Runs one injecting client after the other, and checks the effects."""

    def __init__(self, checker: Checker) -> None:
        self._checker = checker
        self._chance = random.Random(checker.description.seed)
        self._numbers = count(2, 2)
        self._effect_ns = time.monotonic_ns()
        self._shown: dict[str, Counts] = {}
        targets = []
        self._given = {fields["name"]: fields["given"] for fields in checker.description.sources}
        for source in checker.sources:
            if source.given is not None:
                guard = GuardCheck(source, checker.complain, checker.counts(f"injected {source.name} in"))
                targets.append(Target(source, guard, deque(maxlen=REMEMBERED)))
                self._shown[source.name] = checker.counts(f"injected {source.name} out")
        self._turns = cycle(product(("out", "in"), targets))

    def work(self, attachment: Attachment) -> None:
        """Run clients until this instance stops."""
        self._attachment, self._awake = attachment, Awake(attachment)
        while self._goes_on:
            try:
                self._turn()
            except (CommandError, PathError, QualityError):  # the source is being restarted or replaced
                self._checker.stopping.wait(PAUSE_S)
            if time.monotonic_ns() - self._effect_ns > EFFECT_NS + self._checker.slack_ns:
                self._effect_ns = time.monotonic_ns()
                self._checker.complain(f"no injection has had an effect for {EFFECT_NS / 1e9:g} s")

    @property
    def _goes_on(self) -> bool:
        return self._attachment.current and not self._checker.stopping.is_set()

    def _turn(self) -> None:
        """Run one client, from its start until its injection is lifted."""
        chance = self._chance
        direction, target = next(self._turns)
        self._lift_rest(target)
        way = chance.choice(WAYS)
        first = next(self._numbers)
        self._numbers = count(first + NUMBERS, 2)
        source, description = target.source.name, self._checker.description
        keep = way != "v1" and chance.random() < 0.3
        order = Order(
            description.instance, description.grpc, way, source, direction, keep, f"n{first}", first,
            self._given[source], "shown" if direction == "out" else "guarded",
        )  # fmt: skip
        section = self._attachment.block(source).section
        client = Client(order)
        try:
            until_s = time.monotonic() + BEGIN_S
            while self._goes_on and not (client.stands.is_set() or client.over or time.monotonic() > until_s):
                self._tick(target, order)
            stood, until_s = client.stands.is_set(), time.monotonic() + chance.uniform(0.2, 2.0)
            while self._goes_on and stood and not client.over and time.monotonic() < until_s:
                self._tick(target, order)
        finally:
            ended_ns = client.end(kill=keep or chance.random() < 0.7)
        if stood:
            self._after(target, order, ended_ns, section)

    def _after(self, target: Target, order: Order, ended_ns: int, section: int) -> None:
        """Check that the injection ends or is kept. Lift it, and check that readers see the PLC's value."""
        life = LifeCheck(
            f"{order.name} of {order.word}/{order.direction}", order.keep, ended_ns, self._checker.complain
        )
        names = [order.source] if order.way == "local" else [order.source, "grpc"]
        stands = True
        while stands and self._goes_on:
            self._awake.look()
            block = self._attachment.block(order.source)
            now_ns = time.monotonic_ns()
            stands = bool(self._present(order.source))
            renewed = block.section != section or block.retired or not self._attachment.current
            life.look(
                now_ns, stands=stands, awake_since_ns=self._awake.since_ns(*names), slack_ns=self._checker.slack_ns,
                renewed=renewed,
            )  # fmt: skip
            if renewed or (order.keep and now_ns > ended_ns + KEPT_NS):
                break
            self._tick(target, order)
        self._lift_rest(target)
        gone_ns = time.monotonic_ns()
        while self._goes_on and time.monotonic_ns() < gone_ns + 2 * SHOWN_NS:
            frame = self._attachment.frame(order.source).frame
            if frame.publish_ns > gone_ns + SHOWN_NS and (shown := _shown(frame.image)):
                self._checker.complain(f"{order.source}: shows {shown} of {order.name}, which was lifted")
                return
            self._tick(target)

    def _lift_rest(self, target: Target) -> None:
        """Lift all remaining injections of these clients. CommandError: it is not possible."""
        for one in self._present(target.source.name):
            self._attachment.lift(target.source.name, one.number)

    def _present(self, source: str) -> list[Injection[Mapping[str, Any]]]:
        return present_injections(self._attachment, source, "n")

    def _tick(self, target: Target, order: Order | None = None) -> None:
        """Write a value under the injection, and read the injected word in the newest frame."""
        self._checker.stopping.wait(PAUSE_S)
        self._awake.look()
        self._write(target, free=order is None)
        view = self._attachment.frame(target.source.name)
        if order is not None and (shown := _shown(view.frame.image)) >= order.first:
            counts = self._shown[target.source.name]
            counts.values += 1
            counts.good += shown < order.first + NUMBERS
            counts.since_ns = self._effect_ns = time.monotonic_ns()

    def _write(self, target: Target, *, free: bool) -> None:
        name, value = target.source.name, next(self._numbers)
        before = {one.number for one in self._present(name) if one.direction == "in"}
        kind, text = OutcomeKind.REJECTED, ""
        try:
            (outcome,) = self._attachment.write({f"{name}/guarded": value}, 0.5)
            kind, text = outcome.kind, outcome.text
        except CommandError as error:
            text = str(error)
        after = {one.number for one in self._present(name) if one.direction == "in"}
        target.guard.written(value, kind, text, stood=bool(before & after), free=free and not before | after)
        if kind is OutcomeKind.TAKEN:
            target.guard.counts.since_ns = self._effect_ns = time.monotonic_ns()
        target.past.append(value)
        target.guard.look(target.past[0])


def present_injections(attachment: Attachment, source: str, initial: str) -> list[Injection[Mapping[str, Any]]]:
    """Return the injections over a source whose names begin with ``initial``.

    In SimlogAPI v1 the name is the last part of the shadow's path.
    """
    return [one for one in attachment.injections(source) if one.name.rpartition("/")[2].startswith(initial)]


def _shown(image: bytes) -> int:
    """Return the value of the word ``shown``."""
    return word_at(image, SHOWN_AT)


def main() -> None:
    checker = Checker()
    injecting = Injecting(checker)
    checker.work(lambda: attached(checker, injecting.work, writable=True))
    checker.run()


if __name__ == "__main__":
    main()
