"""Python dicts and JSON as editable documents: read from the syntax tree, never executed.

Supported are numbers, texts, dicts, lists, sums and products of them, names with such a value assigned earlier, and
`np.array`, `np.sqrt`, `np.pi`. The same parser reads JSON, whose numbers and texts are valid Python.
"""

import ast
import math
import operator
from collections.abc import Callable
from typing import Any

from crazyem.errors import FileFormatError
from crazyem.simulators.documents.spliced import Path, Spliced, as_number, number_text

_OPERATORS: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}  # fmt: skip
_FUNCTIONS = {"sqrt": math.sqrt, "cos": math.cos, "sin": math.sin, "deg2rad": math.radians, "radians": math.radians}
_LARGEST_POWER = 64.0


class UnknownError(ValueError):
    """An expression that is not supported."""


class LiteralDocument(Spliced):
    """A Python module or a JSON text. Raises FileFormatError if it is neither.

    Attributes:
        root: name -> node of every assignment of a dict; of JSON the one node, under "".
    """

    def __init__(self, text: str, where: str) -> None:
        super().__init__(text, where)
        lines = self._data.splitlines(keepends=True)
        self._starts = [0]
        for line in lines:
            self._starts.append(self._starts[-1] + len(line))
        self.json = text.lstrip().startswith("{")
        self._names: dict[str, Any] = {}
        self.root: dict[str, ast.Dict] = {}
        try:
            tree = ast.parse(text, mode="exec")
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            kind = "JSON" if self.json else "Python"
            raise FileFormatError(f"{where}: not valid {kind}: {getattr(error, 'msg', error)}") from None
        for statement in tree.body:
            value = getattr(statement, "value", None)
            if isinstance(statement, ast.Expr) and isinstance(value, ast.Dict):
                self.root[""] = value
            elif isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
                name = statement.targets[0].id
                if isinstance(value, ast.Dict):
                    self.root[name] = value
                    continue
                try:
                    self._names[name] = self._value(statement.value)
                except UnknownError:
                    self._names.pop(name, None)

    def keys(self, path: Path) -> list[str]:
        """Keys of the dict at a path (its first step is the name of an assignment, "" of JSON)."""
        node = self._down(path)[0]
        if not isinstance(node, ast.Dict):
            return []
        return [str(k.value) for k in node.keys if isinstance(k, ast.Constant)]

    def get(self, path: Path) -> float | None:
        """The number at a path; None if there is none, or an expression that is not supported."""
        node, rest = self._down(path)
        if node is None or isinstance(node, ast.Dict):
            return None
        try:
            found = self._value(node)
            for step in rest:
                found = found[step]
        except (UnknownError, IndexError, KeyError, TypeError):
            return None
        return as_number(found)

    def put(self, path: Path, value: float) -> None:
        """Write a number at a path, if there is such a place. A missing key is added to its dict."""
        node, rest = self._down(path)
        if isinstance(node, ast.Dict):
            if len(rest) == 1:
                self._add(node, str(rest[0]), value)
            return
        if node is None:
            return
        if not rest:
            self._place(self._span(node), number_text(value))
            return
        span = self._span(node)
        source = self._edits[span].decode() if span in self._edits else None
        try:
            listed = self._value(node if source is None else ast.parse(source, mode="eval").body)
        except UnknownError:
            return
        if not isinstance(listed, Vector) or len(rest) != 1 or rest[0] >= len(listed):
            return
        listed = [*listed]
        listed[rest[0]] = value
        self._place(span, f"np.array([{', '.join(number_text(v) for v in listed)}])")

    def _add(self, node: ast.Dict, key: str, value: float) -> None:
        if not node.keys or node.keys[-1] is None:
            return
        end = self._span(node.values[-1])[1]
        quote = chr(self._data[self._span(node.keys[-1])[0]])
        column = node.keys[-1].col_offset
        gap = "\n" + " " * column if node.keys[-1].lineno > node.lineno else " "
        self._insert(end, f",{gap}{quote}{key}{quote}: {number_text(value)}")

    def _down(self, path: Path) -> tuple[ast.expr | None, Path]:
        """The deepest node along a path, and the remaining steps."""
        node: ast.expr | None = self.root.get(path[0])
        for k, step in enumerate(path[1:], start=1):
            if isinstance(node, ast.Dict):
                found = [v for key, v in zip(node.keys, node.values) if getattr(key, "value", None) == step]
                if not found:
                    return (node, path[k:]) if k == len(path) - 1 else (None, ())
                node = found[-1]
                continue
            inner = _array(node)
            if inner is None or not isinstance(step, int) or step >= len(inner.elts):
                return node, path[k:]
            node = inner.elts[step]
        return node, ()

    def _value(self, node: ast.expr) -> Any:
        if isinstance(node, ast.Constant):
            return node.value
        if isinstance(node, ast.Name):
            if node.id in self._names:
                return self._names[node.id]
            raise UnknownError(node.id)
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            value = self._value(node.operand)
            return _each(operator.mul, -1.0 if isinstance(node.op, ast.USub) else 1.0, value)
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            left, right = self._value(node.left), self._value(node.right)
            if isinstance(node.op, ast.Pow) and (isinstance(right, Vector) or abs(right) > _LARGEST_POWER):
                raise UnknownError("power")
            return _each(_OPERATORS[type(node.op)], left, right)
        if isinstance(node, ast.Attribute) and node.attr == "pi":
            return math.pi
        inner = _array(node)
        if inner is not None:
            return Vector(self._value(e) for e in inner.elts)
        if isinstance(node, ast.Call) and len(node.args) == 1 and _name(node.func) in _FUNCTIONS:
            return _FUNCTIONS[_name(node.func)](self._value(node.args[0]))
        raise UnknownError(ast.dump(node)[:40])

    def _span(self, node: ast.expr) -> tuple[int, int]:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return (
            self._starts[node.lineno - 1] + node.col_offset,
            self._starts[node.end_lineno - 1] + node.end_col_offset,
        )


class Vector(list[Any]):
    """A list of numbers with element-wise addition and multiplication, as an array."""


def _each(do: Callable[[Any, Any], Any], left: Any, right: Any) -> Any:
    if isinstance(left, Vector) and isinstance(right, Vector):
        return Vector(_each(do, a, b) for a, b in zip(left, right))
    if isinstance(left, Vector):
        return Vector(_each(do, a, right) for a in left)
    if isinstance(right, Vector):
        return Vector(_each(do, left, b) for b in right)
    if not all(isinstance(v, int | float) for v in (left, right)):
        raise UnknownError("no number")
    try:
        return do(left, right)
    except (ArithmeticError, ValueError) as error:
        raise UnknownError(str(error)) from None


def _array(node: ast.expr | None) -> ast.List | ast.Tuple | None:
    """The list inside `[...]`, `(...)` or `np.array([...])`."""
    if isinstance(node, ast.Call) and _name(node.func) in ("array", "asarray") and node.args:
        node = node.args[0]
    return node if isinstance(node, ast.List | ast.Tuple) else None


def _name(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")
