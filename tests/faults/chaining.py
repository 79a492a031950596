"""Tests a chain of injections over one word: two clients inject, and further out a declared injection.

The clients end one by one. The inner client gives multiples of 4. The outer client has a higher priority, and gives
the value that it receives plus 1. Both clients use shmio.v1, because all places for attached programs that write are
taken.
"""

from __future__ import annotations

import random
import time
from itertools import count, cycle

from shmio.errors import CommandError, PathError, QualityError
from shmio.local.attach import Attachment
from tests.faults.checker import Checker
from tests.faults.checks import Source, word_at
from tests.faults.configuration import CHAINED, PRIORITY
from tests.faults.inject_checks import INNER, OUTER, ChainCheck, LifeCheck
from tests.faults.injecting import BEGIN_S, EFFECT_NS, NUMBERS, PAUSE_S, Awake, Client, present_injections
from tests.faults.injector import Order
from tests.faults.local import attached
from tests.faults.plc import CHAINED_AT


class Chaining:
    """Runs one pair of injecting clients after the other, and checks what readers see."""

    def __init__(self, checker: Checker) -> None:
        self._checker = checker
        self._chance = random.Random(checker.description.seed)
        self._first = count(4 * NUMBERS, 4 * NUMBERS)
        self._effect_ns = time.monotonic_ns()
        self._given = {fields["name"]: fields["chained"] for fields in checker.description.sources}
        self._turns = cycle(
            [
                (source, ChainCheck(source, checker.complain, checker.counts(f"injected {source.name} chained")))
                for source in checker.sources
                if source.chained is not None
            ]
        )

    def work(self, attachment: Attachment) -> None:
        """Run pairs of clients until this instance stops."""
        self._attachment, self._awake = attachment, Awake(attachment)
        while self._goes_on:
            try:
                self._turn(*next(self._turns))
            except (CommandError, PathError, QualityError):  # the source is being restarted or replaced
                self._checker.stopping.wait(PAUSE_S)
            if time.monotonic_ns() - self._effect_ns > EFFECT_NS + self._checker.slack_ns:
                self._effect_ns = time.monotonic_ns()
                self._checker.complain(f"no chain of injections has had an effect for {EFFECT_NS / 1e9:g} s")

    @property
    def _goes_on(self) -> bool:
        return self._attachment.current and not self._checker.stopping.is_set()

    def _turn(self, source: Source, check: ChainCheck) -> None:
        """Run one pair: both start, then one ends, then the other. No injection must remain."""
        chance, description, first = self._chance, self._checker.description, next(self._first)
        section = self._attachment.block(source.name).section
        clients: dict[str, Client] = {}
        check.begin()
        try:
            for part in chance.sample((INNER, OUTER), 2):
                order = Order(
                    description.instance, description.grpc, "shmio", source.name, "out", False, f"c{first} {part}",
                    first, self._given[source.name], "chained", 4, PRIORITY // 2 if part == OUTER else 0, part == OUTER,
                )  # fmt: skip
                clients[part] = Client(order)
            until_s = time.monotonic() + BEGIN_S
            while self._goes_on and time.monotonic() < until_s and not _settled(clients):
                self._tick(source, check, clients, section)
            self._look_for(chance.uniform(0.2, 2.0), source, check, clients, section)
            for part in chance.sample((INNER, OUTER), 2):
                self._end(part, source, check, clients, section)
                self._look_for(4 * PAUSE_S, source, check, clients, section)
        finally:
            for client in clients.values():
                client.end(kill=True)

    def _end(self, part: str, source: Source, check: ChainCheck, clients: dict[str, Client], section: int) -> None:
        """End one client, and check that its injection is lifted."""
        client = clients.pop(part)
        ended_ns = client.end(kill=self._chance.random() < 0.7)
        if not client.stands.is_set():
            return
        name = client.order.name
        life = LifeCheck(f"{name} of {client.order.word}/out", False, ended_ns, self._checker.complain)
        stands = True
        while stands and self._goes_on:
            renewed = self._tick(source, check, clients, section)
            stands = any(one.name == name for one in present_injections(self._attachment, source.name, "c"))
            life.look(
                time.monotonic_ns(), stands=stands, awake_since_ns=self._awake.since_ns(source.name, "grpc"),
                slack_ns=self._checker.slack_ns, renewed=renewed,
            )  # fmt: skip
            if renewed:
                return

    def _look_for(
        self, for_s: float, source: Source, check: ChainCheck, clients: dict[str, Client], section: int
    ) -> None:
        until_s = time.monotonic() + for_s
        while self._goes_on and time.monotonic() < until_s:
            self._tick(source, check, clients, section)

    def _tick(self, source: Source, check: ChainCheck, clients: dict[str, Client], section: int) -> bool:
        """Read the newest frame, and the injections before and after it, and check them.

        Args:
            source: The source.
            check: The check of this chain.
            clients: The clients that must still be alive.
            section: The block's section when the pair started.

        Returns:
            Whether the block has been replaced since the pair started.
        """
        self._checker.stopping.wait(PAUSE_S)
        self._awake.look()
        before = self._parts(source)
        frame = self._attachment.frame(source.name).frame
        after, now_ns = self._parts(source), time.monotonic_ns()
        shown = word_at(frame.image, CHAINED_AT) - CHAINED
        if check.look(shown, frame.publish_ns, now_ns, after if before == after else None):
            check.counts.since_ns = self._effect_ns = now_ns
        block = self._attachment.block(source.name)
        renewed = block.section != section or block.retired or not self._attachment.current
        if not renewed:
            laid = {part for part, client in clients.items() if client.stands.is_set() and not client.over}
            check.stay(laid, after, now_ns, self._awake.since_ns(source.name, "grpc"))
        return renewed

    def _parts(self, source: Source) -> set[str]:
        """Return which injections of the pair are on the block."""
        return {one.name.rpartition(" ")[2] for one in present_injections(self._attachment, source.name, "c")}


def _settled(clients: dict[str, Client]) -> bool:
    """Return whether both injections are laid, or a client has ended."""
    return all(client.stands.is_set() for client in clients.values()) or any(c.over for c in clients.values())


def main() -> None:
    checker = Checker()
    chaining = Chaining(checker)
    checker.work(lambda: attached(checker, chaining.work))
    checker.run()


if __name__ == "__main__":
    main()
