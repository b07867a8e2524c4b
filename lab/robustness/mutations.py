"""Small faults that a source file could have: which there are, by rule, and the source with one of them.

Left out are what no test should hold: messages (f-strings, what is raised), annotations, decorators, docstrings, and
values of a module's constants, of which each has its reason beside it and any other value is another tuning.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator
from dataclasses import dataclass

OPERATORS: dict[type[ast.AST], tuple[type[ast.AST], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
    ast.And: (ast.Or,),
    ast.Or: (ast.And,),
    ast.Add: (ast.Sub,),
    ast.Sub: (ast.Add,),
    ast.Mult: (ast.Div,),
    ast.BitAnd: (ast.BitOr,),
    ast.BitOr: (ast.BitAnd,),
    ast.LShift: (ast.RShift,),
    ast.RShift: (ast.LShift,),
    **dict.fromkeys((ast.Div, ast.FloorDiv, ast.Mod, ast.Pow), (ast.Mult,)),
}
"""What an operator is taken for."""

_PAIRS = """min max, amin amax, argmin argmax, minimum maximum, clamp_min clamp_max, any all, sum mean, zeros ones,
zeros_like ones_like, sin cos, floor ceil, exp expm1, log log1p"""
NAMES = {a: b for pair in _PAIRS.split(",") for a, b in (pair.split(), pair.split()[::-1])}
"""Functions and methods that are taken for one another."""

DROPPED = {*"clamp clamp_min clamp_max abs sqrt square log exp detach flip cumsum round".split()}
"""Methods of a tensor that a mutant leaves out."""

_NOT_MUTATED = (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom, ast.arg)

Node = ast.expr | ast.stmt


@dataclass(frozen=True)
class Mutation:
    """One fault: the bytes from ``start`` to ``stop`` of a source become ``after``."""

    line: int
    column: int
    """From 1, in bytes."""
    start: int
    stop: int
    before: str
    after: str

    def __str__(self) -> str:
        return f"{self.line}:{self.column}: {' '.join(self.before.split())} -> {' '.join(self.after.split())}"

    def applied(self, source: str) -> str:
        """The source with the fault."""
        text = source.encode()
        return (text[: self.start] + self.after.encode() + text[self.stop :]).decode()


def mutations(source: str) -> list[Mutation]:
    """All faults of a Python source, in its order."""
    starts = [0]
    for line in source.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    found = []
    for node in _nodes(ast.parse(source), inside=False):
        for changed in _changes(node):
            before = ast.get_source_segment(source, node)
            assert before is not None and node.end_lineno is not None and node.end_col_offset is not None
            after = ast.unparse(changed)
            after = f"({after})" if isinstance(changed, ast.expr) and not isinstance(changed, ast.Constant) else after
            start, stop = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
            found.append(Mutation(node.lineno, node.col_offset + 1, start, stop, before, after))
    return sorted(found, key=lambda mutation: (mutation.start, mutation.stop, mutation.after))


def _nodes(node: ast.AST, inside: bool) -> Iterator[Node]:
    """What is computed in functions: no annotations, decorators, docstrings and messages."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            is_text = isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant)
            if not isinstance(child, ast.AST) or isinstance(child, _NOT_MUTATED) or is_text:
                continue
            within = inside or isinstance(child, (ast.FunctionDef, ast.Lambda))
            if within and isinstance(child, Node):
                yield child
            yield from _nodes(child, within)


def _changes(node: Node) -> Iterator[Node]:
    """What a node could be by mistake."""
    if isinstance(node, ast.AugAssign) or (isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)):
        yield ast.Pass()
    if isinstance(node, (ast.AugAssign, ast.BinOp, ast.BoolOp)):
        yield from (_with(node, op=other()) for other in OPERATORS.get(type(node.op), ()))
    elif isinstance(node, ast.Compare):
        for place, op in enumerate(node.ops):
            for other in OPERATORS[type(op)]:
                yield _with(node, ops=[*node.ops[:place], other(), *node.ops[place + 1 :]])
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.Not, ast.USub, ast.Invert)):
        yield node.operand
    elif isinstance(node, ast.IfExp):
        yield _with(node, body=node.orelse, orelse=node.body)
    elif isinstance(node, ast.Constant):
        yield from (ast.Constant(value) for value in _values(node.value))
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in NAMES:
        yield _with(node, func=ast.Name(NAMES[node.func.id], ast.Load()))
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        of, name = node.func.value, node.func.attr
        if name in NAMES:
            yield _with(node, func=_with(node.func, attr=NAMES[name]))
        if name in DROPPED and not (isinstance(of, ast.Name) and of.id in ("torch", "math")):
            yield of


def _values(value: object) -> list[bool | int | float]:
    """Other values of a constant: the other of two, the next and none of whole numbers, twice and none of others."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, int):
        return [value + 1, 0] if value else [1]
    if isinstance(value, float):
        return [2 * value, 0.0] if value else [1.0]
    return []


def _with(node: Node, **fields: object) -> Node:
    changed = copy.copy(node)
    for name, value in fields.items():
        setattr(changed, name, value)
    return changed
