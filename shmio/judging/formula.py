"""Turns formulas into networks of operators. Equal parts of several formulas share their nodes."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from fractions import Fraction
from functools import lru_cache, partial
from typing import Any, Final

import numpy as np

from shmio.errors import ConfigError, PathError
from shmio.injection.exact import Exact, is_exact
from shmio.injection.language import TEMPORAL, Constant, Operation, Reference, Tree, nodes
from shmio.injection.program import number_register
from shmio.judging.operators import (
    COMPARISONS,
    NUMBERS,
    OF_INTEGERS,
    Arithmetic,
    Constantly,
    Difference,
    Digit,
    Edge,
    Extremum,
    History,
    Moment,
    Node,
    Not,
    Truth,
    Tube,
    Until,
    Window,
    from_bool,
    from_number,
    tube,
)
from shmio.judging.pieces import Piece
from shmio.judging.source import Signal
from shmio.judging.verdict import All, Opposite, TopLevel, TopLevelExtremum, TopLevelInitial, UntilEnd
from shmio.layout.glob import choose
from shmio.layout.model import Layout, Register

MAX_HORIZON_S: Final = 1_000_000
"""Maximum time in s by which a formula may look ahead or back; the bounds of nested operators add up."""
MAX_CHANGES: Final = 64
"""Maximum factor by which nested temporal operators may multiply the changes of a signal."""
ASPECTS: Final = ("quality", "age", "raw")
_LOGIC: Final = frozenset({"and", "or", "not", "implies"})
_EDGES: Final = frozenset({"rise", "fall", "rising", "falling", "changed"})
_TRUTH: Final = _LOGIC | _EDGES | TEMPORAL | COMPARISONS.keys()
_NS: Final = 1_000_000_000


class Registers:
    """Finds the registers that formulas read."""

    def __init__(self, layouts: Mapping[str, Layout]) -> None:
        self._layouts = layouts
        self.found: dict[Signal, Register] = {}
        """The register of each signal."""
        self._signals: dict[tuple[str, str], Signal] = {}  # by path and aspect

    def signal(self, reference: Reference, aspect: str = "value") -> Signal:
        """Return the signal of a register.

        Args:
            reference: The register, as the formula names it.
            aspect: How the formula reads the register; see :class:`Signal`.

        Raises:
            ConfigError: There is no such register, or it is neither a number nor a BOOL.

        """
        key = reference.path, aspect
        if key in self._signals:
            return self._signals[key]
        try:
            source, register = number_register(reference.path, self._layouts)
        except PathError as error:
            raise ConfigError(f"at character {reference.at}: {error}") from None
        except ConfigError as error:
            text = str(error).replace("a condition reads", "a formula reads")
            raise ConfigError(f"at character {reference.at}: {text}") from None
        signal = self._signals[key] = Signal(source, register.path, aspect)
        self.found[signal] = register
        return signal

    def several(self, text: str) -> list[Signal]:
        """Return the signals of all numbers and BOOLs that a text names: a path, a structure or a pattern.

        Raises:
            ConfigError: The text names no such register.

        """
        try:
            return [self.signal(Reference(text))]
        except ConfigError as error:
            with suppress(PathError):
                found = []
                for source, register in choose([text], self._layouts):
                    if not register.dims:
                        with suppress(ConfigError):
                            found.append(self.signal(Reference(f"{source}/{register.path}")))
                if found:
                    return found
            raise ConfigError(str(error).partition(": ")[2]) from None


@lru_cache(maxsize=1024)  # the runs of a search have the same formulas
def check(tree: Tree) -> None:
    """Check a formula for errors that the grammar allows.

    Raises:
        ConfigError: A part of the formula has no meaning, a temporal operator needs bounds, or the
            formula exceeds a limit.

    """
    for node in nodes(tree):
        if not isinstance(node, Operation):
            continue
        if node.name in _TRUTH and constant(node):
            raise ConfigError(
                f"at character {node.at}: {node.name!r} is always the same here, because it reads no register"
            )
        if node.name in ASPECTS and not isinstance(node.operands[0], Reference):
            raise ConfigError(f"at character {node.at}: {node.name}( ) takes one register, not an expression")
        if node.name in _EDGES | {"rate"} and temporal(node.operands[0]):
            raise ConfigError(
                f"at character {node.at}: {node.name}( ) compares a frame with the one before, so it takes no temporal "
                "operator"
            )
    if constant(tree):
        raise ConfigError("the formula must read a register")
    _check_bounds(tree, outer=True)
    if _changes(tree) > MAX_CHANGES:
        raise ConfigError(
            "temporal operators with bounds are nested more than 6 levels deep, where each until counts as two"
        )
    if horizon_ns(tree) > MAX_HORIZON_S * _NS:
        raise ConfigError(f"the formula's bounds add up to more than {MAX_HORIZON_S} s")


def _check_bounds(tree: Tree, *, outer: bool) -> None:
    """Refuse a temporal operator without bounds inside another one: its values would be known only at the end."""
    if not isinstance(tree, Operation):
        return
    if not outer and tree.name in ("always", "eventually", "until") and tree.bounds_ns is None:
        raise ConfigError(
            f"at character {tree.at}: {tree.name!r} within another operator needs bounds, such as {tree.name}[0, 10]"
        )
    for operand in tree.operands:
        _check_bounds(operand, outer=outer and tree.name in _LOGIC)


def _changes(tree: Tree) -> int:
    """Return the maximum number of changes of a tree's truth that one change of a register can cause."""
    if not isinstance(tree, Operation):
        return 1
    own = 1
    if tree.bounds_ns is not None:
        own = 3 if tree.name == "until" else 1 + (tree.bounds_ns[0] != tree.bounds_ns[1])
    return own * max(map(_changes, tree.operands))


def temporal(tree: Tree, operators: Collection[str] = TEMPORAL) -> bool:
    """Return whether a tree contains one of ``operators``; by default, any temporal operator."""
    return any(isinstance(node, Operation) and node.name in operators for node in nodes(tree))


def constant(tree: Tree) -> bool:
    """Return whether a tree is constant: whether it reads no register."""
    return not any(isinstance(node, Reference) for node in nodes(tree))


def horizon_ns(tree: Tree) -> int:
    """Return how far a tree looks ahead or back, at most, in ns. Operators without bounds count as 0."""
    if not isinstance(tree, Operation):
        return 0
    own = tree.bounds_ns[1] if tree.bounds_ns else 0
    return own + max(map(horizon_ns, tree.operands))


class Network:
    """The operator nodes of several formulas. Each node comes after its operands."""

    def __init__(self, registers: Registers, input_of: Callable[[Signal], Node]) -> None:
        """Create an empty network.

        Args:
            registers: Finds registers.
            input_of: Returns the node of a signal.
        """
        self._registers = registers
        self._input_of = input_of
        self._nodes: dict[tuple[object, ...], Node] = {}

    def turn(self) -> None:
        """Let each node process what has become known of its operands."""
        for node in self._nodes.values():
            node.turn()

    def top_level(self, tree: Tree) -> TopLevel:
        """Return the outermost part of a formula. Its truth at the start of the judged time is the verdict."""
        if not isinstance(tree, Operation) or tree.name not in {*_LOGIC, "always", "eventually", "until"}:
            return TopLevelInitial(self.truth(tree))
        if tree.name == "not":
            return Opposite(self.top_level(tree.operands[0]))
        if tree.name in _LOGIC:
            if not temporal(tree):
                return TopLevelInitial(self.truth(tree))
            first, second = map(self.top_level, tree.operands)
            if tree.name == "and":
                return All((first, second))
            first = first if tree.name == "implies" else Opposite(first)
            return Opposite(All((first, Opposite(second))))
        if tree.name == "until":
            if tree.bounds_ns is not None:
                return TopLevelInitial(self.truth(tree))
            left, right = self._truths(tree)
            return UntilEnd(left, right)
        return TopLevelExtremum(_extremum(tree.name), self.truth(tree.operands[0]), tree.bounds_ns)

    def like(self, signal: Signal, golden: Piece, tolerance: float, tolerance_ns: int) -> tuple[TopLevel, Tube]:
        """Return the comparison of a signal with a golden signal, as a top-level part and as a node.

        Args:
            signal: The signal to compare.
            golden: The golden signal; times count from the start of the judged time, and the last
                value is unknown. The comparison ends with this signal.
            tolerance: Tolerance of the value.
            tolerance_ns: Tolerance in time, in both directions.
        """
        node = Tube(self._input_of(signal), *tube(golden, tolerance, tolerance_ns))
        self._nodes["like", node] = node
        return TopLevelExtremum(np.minimum, node, (0, max(int(golden.time[-1]) - 1, 0))), node

    def truth(self, tree: Tree) -> Node:
        """Return the node for the truth of a tree. A number is true if it is not 0."""
        if isinstance(tree, Operation) and tree.name in _TRUTH:
            return self._operation(tree)
        number = self.number(tree)
        assert isinstance(number, Node)  # noqa: S101  check() has refused a constant
        function = from_bool if self._boolean(tree) else from_number
        return self._shared(("truth", number), lambda: Truth(function, (number,)))

    def number(self, tree: Tree) -> Node | Exact:
        """Return the node for the number that a tree computes, or the number itself if it is constant.

        A truth counts as 1 or 0.
        """
        match tree:
            case Constant(value):
                return value if is_exact(value) else float(value)
            case Reference():
                return self._input_of(self._registers.signal(tree))
            case Operation(name, (Reference() as reference,)) if name in ASPECTS:
                return self._input_of(self._registers.signal(reference, name))
            case Operation(name) if name in _TRUTH:
                truth = self._operation(tree)
                return self._shared(("digit", truth), lambda: Digit((truth,)))
            case Operation("rate", (operand,)):
                number = self.number(operand)
                if not isinstance(number, Node):
                    return 0.0
                return self._shared(("rate", number), lambda: Difference(number, per_second=True))
            case _:
                operands = [self.number(operand) for operand in tree.operands]
                function = NUMBERS[tree.name]
                exactly = OF_INTEGERS.get(tree.name) if self._whole(tree) else None
                if not any(isinstance(operand, Node) for operand in operands):
                    return _constant(exactly or function, operands)  # type: ignore[arg-type]
                return self._shared((tree.name, *operands), lambda: Arithmetic(function, operands, exactly))

    def _whole(self, tree: Tree) -> bool:
        """Return whether the numbers of a tree are integers."""
        match tree:
            case Constant(value):
                return not isinstance(value, float)
            case Reference():
                return self._registers.found[self._registers.signal(tree)].element.base not in ("REAL", "LREAL")
            case Operation("raw", (operand,)):
                return self._whole(operand)
            case Operation("rate" | "age" | "/"):
                return False
            case _:
                return tree.name in _TRUTH | {"quality"} or all(map(self._whole, tree.operands))

    def _boolean(self, tree: Tree) -> bool:
        match tree:
            case Reference() | Operation("raw", (Reference(),)):
                reference = tree if isinstance(tree, Reference) else tree.operands[0]
                assert isinstance(reference, Reference)  # noqa: S101
                return self._registers.found[self._registers.signal(reference)].type == "BOOL"
            case _:
                return False

    def _operation(self, tree: Operation) -> Node:
        """Return the node of an operation whose result is a truth."""
        name = tree.name
        if name in COMPARISONS:
            operands = [self.number(operand) for operand in tree.operands]
            return self._shared((name, *operands), lambda: Truth(COMPARISONS[name], operands))
        if name == "changed":
            return self._changed(tree)
        if name in _EDGES:
            operand = self.truth(tree.operands[0])
            if name in ("fall", "falling"):
                operand = self._not(operand)
            edge = self._shared(("edge", name, operand), lambda: Edge(operand, first=name in ("rise", "fall")))
            return self._shared((name, operand), lambda: Moment(edge, operand))
        truths = self._truths(tree)
        if name == "not":
            return self._not(truths[0])
        if name == "implies":
            truths = [self._not(truths[0]), truths[1]]
        if name in _LOGIC:
            function = _extremum(name)
            return self._shared((function, *truths), lambda: Extremum(function, truths))
        begin_ns, end_ns = tree.bounds_ns or (0, 0)
        if name == "until":
            return self._shared(
                (name, *truths, begin_ns, end_ns), lambda: Until(truths[0], truths[1], begin_ns, end_ns)
            )
        function, (operand,) = _extremum(name), truths
        if name in ("once", "historically"):
            if tree.bounds_ns is None:
                return self._shared((name, operand), lambda: History(function, operand))
            begin_ns, end_ns = -end_ns, -begin_ns
        return self._shared((function, operand, begin_ns, end_ns), lambda: Window(function, operand, begin_ns, end_ns))

    def _truths(self, tree: Operation) -> list[Node]:
        """Return the nodes for the truths of the operands. A constant gets the times of another operand."""
        truths = {at: self.truth(operand) for at, operand in enumerate(tree.operands) if not constant(operand)}
        other = next(iter(truths.values()))
        for at, operand in enumerate(tree.operands):
            if at not in truths:
                make = partial(Constantly, np.inf if self.number(operand) else -np.inf, other)
                truths[at] = self._shared((make.func, *make.args), make)
        return [truths[at] for at in range(len(tree.operands))]

    def _changed(self, tree: Operation) -> Node:
        number = self.number(tree.operands[0])
        assert isinstance(number, Node)  # noqa: S101  check() has refused a constant
        difference = self._shared(("difference", number), lambda: Difference(number, per_second=False))
        edge = self._shared(("truth", difference), lambda: Truth(from_number, (difference,)))
        return self._shared(("changed", number), lambda: Moment(edge, number))

    def _not(self, operand: Node) -> Node:
        return self._shared(("not", operand), lambda: Not((operand,)))

    def _shared(self, key: tuple[object, ...], make: Callable[[], Node]) -> Node:
        """Return the node with this meaning. Create it if there is none yet."""
        if key not in self._nodes:
            node = make()  # before it is stored, so that its operands come first
            self._nodes[key] = node
        return self._nodes[key]


def _constant(function: Callable[..., Any], operands: Sequence[Exact]) -> Exact:
    """Return the number that a function computes from constants; see :data:`shmio.injection.exact.Exact`."""
    with np.errstate(all="ignore"):
        found = function(*(one if is_exact(one) else np.float64(one) for one in operands))
    return found if isinstance(found, (int, Fraction)) else float(found)


def _extremum(name: str) -> np.ufunc:
    return np.minimum if name in ("and", "always", "historically") else np.maximum


def signals(tree: Tree, registers: Registers) -> Iterator[Signal]:
    """Yield each signal that a tree reads, once.

    Raises:
        ConfigError: A register does not exist, or is neither a number nor a BOOL.

    """
    seen: dict[Signal, None] = {}
    inner: set[int] = set()
    for node in reversed(list(nodes(tree))):
        if isinstance(node, Operation) and node.name in ASPECTS and isinstance(node.operands[0], Reference):
            inner.add(id(node.operands[0]))
            seen[registers.signal(node.operands[0], node.name)] = None
        elif isinstance(node, Reference) and id(node) not in inner:
            seen[registers.signal(node)] = None
    yield from reversed(seen)
