"""Makes small faults in a source file, one at a time. The number of lines stays the same."""

from __future__ import annotations

import ast
import copy
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_COMPARE: Final[dict[type[ast.cmpop], type[ast.cmpop]]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
_ARITHMETIC: Final[dict[type[ast.operator], type[ast.operator]]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.FloorDiv,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
_UNTOUCHED: Final = {"log", "logging", "warnings"}
"""Names of objects whose methods only log or warn. Calls on them are not changed."""

_C_SWAPS: Final = (
    (r"<=", "<"),
    (r">=", ">"),
    (r"(?<![-<])<(?![<=])", "<="),
    (r"(?<![->])>(?![>=])", ">="),
    (r"==", "!="),
    (r"!=", "=="),
    (r"&&", "||"),
    (r"\|\|", "&&"),
    (r"(?<!\+) \+ (?!\+)", " - "),
    (r"(?<!-) - (?!-)", " + "),
    (r"(?<=[\w)]) & (?=[\w(])", " | "),
    (r"\b1\b", "2"),
    (r"\b8\b", "7"),
    (r"\b0\b", "1"),
    (r"\btrue\b", "false"),
    (r"\bfalse\b", "true"),
)
_C_STATEMENT: Final = re.compile(
    r"""^(\s*) (?: (?:if\ \([^;]*\)\ )? [a-z_]+\([^;]*\); | [^=;]+\ [-+|]?=\ [^;]*; | return; | continue; | break; )
        \s*$""",
    re.X,
)
_C_DECLARATION: Final = re.compile(
    r"""^\s* (?: (?: static | const | struct | unsigned | bool | void | char )\ | u?int\d* | size_t | Py\w+\ \*? )""",
    re.X,
)


@dataclass(frozen=True)
class Mutant:
    """A source file with one fault."""

    path: Path
    line: int
    before: str
    after: str
    source: str
    """Text of the whole file with the fault."""

    @property
    def title(self) -> str:
        """The fault as people read it: where it is, and what it changes."""
        return f"{self.path}:{self.line}: {self.before}  ->  {self.after}"


def mutants(root: Path, path: Path) -> Iterator[Mutant]:
    """Yield all faults that can be made in a file."""
    text = (root / path).read_text()
    yield from (_of_python(path, text) if path.suffix == ".py" else _of_c(path, text))


# -- Python ------------------------------------------------------------------------------------------------------------


def _of_python(path: Path, text: str) -> Iterator[Mutant]:
    lines = text.encode().split(b"\n")
    starts = [0]
    for line in lines:
        starts.append(starts[-1] + len(line) + 1)
    whole = text.encode()
    for node, replacement in _faults(ast.parse(text)):
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[(node.end_lineno or node.lineno) - 1] + (node.end_col_offset or 0)
        old, new = whole[begin:end], ast.unparse(replacement).encode()
        bracketed = isinstance(replacement, ast.expr)
        filler = b"\n" * (old.count(b"\n") - new.count(b"\n"))
        made = b"(" + new + filler + b")" if bracketed else new + filler
        source = (whole[:begin] + made + whole[end:]).decode()
        yield Mutant(path, node.lineno, _short(ast.unparse(node)), _short(new.decode()), source)


def _short(code: str) -> str:
    return " ".join(code.split())


def _faults(tree: ast.Module) -> Iterator[tuple[ast.expr | ast.stmt, ast.expr | ast.stmt]]:
    todo: list[ast.AST] = [tree]
    while todo:
        node = todo.pop()
        if _is_no_behaviour(node):
            continue
        if isinstance(node, ast.stmt):
            yield from ((node, fault) for fault in _of_statement(node))
        elif isinstance(node, ast.expr):
            yield from ((node, fault) for fault in _of_expression(node))
        todo += _parts(node)


def _parts(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the parts of a node that may be changed. Annotations, decorators and messages may not."""
    skipped: list[ast.AST | None] = []
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        skipped += [node.returns, *node.decorator_list]
    elif isinstance(node, ast.ClassDef):
        skipped += [*node.bases, *node.decorator_list]
    elif isinstance(node, ast.arg | ast.AnnAssign):
        skipped.append(node.annotation)
    elif isinstance(node, ast.Raise):
        return  # the message is not behaviour; the whole statement is removed as a fault
    for part in ast.iter_child_nodes(node):
        if not any(part is other for other in skipped):
            yield part


def _is_no_behaviour(node: ast.AST) -> bool:
    if isinstance(node, ast.JoinedStr | ast.Import | ast.ImportFrom | ast.Assert):
        return True
    if isinstance(node, ast.FunctionDef) and node.name == "__repr__":
        return True
    if isinstance(node, ast.If) and ast.unparse(node.test) in {"TYPE_CHECKING", "__name__ == '__main__'"}:
        return True
    if isinstance(node, ast.Expr):
        call = node.value
        if isinstance(call, ast.Constant):
            return True  # a docstring
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute):
            return isinstance(call.func.value, ast.Name) and call.func.value.id in _UNTOUCHED
    if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(node.value, ast.Call):
        return ast.unparse(node.value.func) in {"logging.getLogger", "TypeVar", "ParamSpec"}
    return False


def _of_statement(node: ast.stmt) -> Iterator[ast.stmt]:
    match node:
        case ast.Expr(value=ast.Call() | ast.Await()) | ast.Raise() | ast.AugAssign() | ast.Delete():
            yield ast.Pass()
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            yield ast.Pass()
        case ast.Return(value=ast.expr() as value) if not (
            isinstance(value, ast.Constant) and isinstance(value.value, bool | None)
        ):
            yield ast.Return(ast.Constant(None))
        case ast.Break():
            yield ast.Continue()
        case ast.Continue():
            yield ast.Pass()
        case _:
            pass
    if isinstance(node, ast.AugAssign) and type(node.op) in _ARITHMETIC:
        fault = copy.deepcopy(node)
        fault.op = _ARITHMETIC[type(node.op)]()
        yield fault


def _of_expression(node: ast.expr) -> Iterator[ast.expr]:
    fault = copy.deepcopy(node)
    if isinstance(fault, ast.Compare) and len(fault.ops) == 1:
        fault.ops = [_COMPARE[type(fault.ops[0])]()]
        yield fault
    elif isinstance(fault, ast.BinOp) and type(fault.op) in _ARITHMETIC and not _is_text(fault):
        fault.op = _ARITHMETIC[type(fault.op)]()
        yield fault
    elif isinstance(fault, ast.BoolOp):
        fault.op = ast.And() if isinstance(fault.op, ast.Or) else ast.Or()
        yield fault
    elif isinstance(fault, ast.UnaryOp) and isinstance(fault.op, ast.Not | ast.USub):
        yield fault.operand
    elif isinstance(fault, ast.IfExp):
        fault.test = ast.UnaryOp(ast.Not(), fault.test)
        yield fault
    elif isinstance(fault, ast.Constant):
        if isinstance(fault.value, bool):
            yield ast.Constant(not fault.value)
        elif isinstance(fault.value, int | float):  # one more would hardly change a large limit, so these double
            yield ast.Constant(fault.value + 1 if abs(fault.value) <= 16 else fault.value * 2)


def _is_text(node: ast.BinOp) -> bool:
    return any(
        isinstance(part, ast.JoinedStr) or (isinstance(part, ast.Constant) and isinstance(part.value, str))
        for part in (node.left, node.right)
    )


# -- C -----------------------------------------------------------------------------------------------------------------


def _of_c(path: Path, text: str) -> Iterator[Mutant]:
    lines = text.split("\n")
    commented = False
    for number, line in enumerate(lines):
        before_comment = line.split("/*")[0] if not commented else ""
        commented = ("/*" in line or commented) and "*/" not in line
        code = re.sub(r'"[^"]*"', lambda text: "\x00" * len(text.group()), before_comment)
        if not code.strip() or code.lstrip().startswith(("#", "METHOD", "FIELD", "_Static_assert", "typedef")):
            continue
        for pattern, new in _C_SWAPS:
            for match in re.finditer(pattern, code):
                yield _c_mutant(path, lines, number, line[: match.start()] + new + line[match.end() :])
        if (call := _C_STATEMENT.match(code)) and not _C_DECLARATION.match(code):
            yield _c_mutant(path, lines, number, f"{call[1]};")


def _c_mutant(path: Path, lines: list[str], number: int, new: str) -> Mutant:
    source = "\n".join([*lines[:number], new, *lines[number + 1 :]])
    return Mutant(path, number + 1, _short(lines[number]), _short(new), source)
