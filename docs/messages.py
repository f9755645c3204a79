"""Collect the texts of all errors, failures and warnings from the sources of the package.

    python docs/messages.py             # print the tables of the pages

Sources are parsed, not imported. Values known only at run time are shown as …; strings in a
constant or a variable of the function are filled in where they can be determined.
"""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "fenics_contact"
HOLE = "…"
# A hole with more alternatives than this is not filled.
_MOST = 4
# Functions whose strings are parts of a verdict, and of the description of an attempt.
_VERDICT = {"hidden_by_round_off", "limit_point", "round_off_in_words"}
_ATTEMPT = {"describe_chattering", "describe"}


@dataclass(frozen=True)
class Message:
    """A text of the package.

    Attributes:
        module: Dotted name of its module, without the name of the package.
        line: Line in the module.
        kind: Class of the error, "warning", "log", "verdict" (a violated condition) or
            "attempt" (the outcome of a method).
        text: The text.
    """

    module: str
    line: int
    kind: str
    text: str

    @property
    def says(self) -> bool:
        """Whether the text has words; otherwise it only passes on another text."""
        return re.search("[a-z]{2}", self.text) is not None


class _Module:
    """A parsed module, from which messages are extracted."""

    def __init__(self, path: Path, package: Path) -> None:
        self.path = path
        self.package = package
        self.tree = ast.parse(path.read_text(encoding="utf-8"))
        self.name = ".".join(path.relative_to(package).with_suffix("").parts)
        self.functions = {
            node.name: node for node in ast.walk(self.tree) if isinstance(node, ast.FunctionDef)
        }
        self.around: dict[ast.AST, ast.FunctionDef] = {}
        for function in self.functions.values():  # the innermost is seen last
            for node in ast.walk(function):
                self.around[node] = function

    # ---- texts -----------------------------------------------------------------------------------

    def texts(self, node: ast.AST, within: ast.AST | None, depth: int = 0) -> list[str]:
        """Return all texts that an expression may have."""
        if depth > 4:
            return [HOLE]
        if isinstance(node, ast.Constant):
            return [node.value if isinstance(node.value, str) else str(node.value)]
        if isinstance(node, ast.JoinedStr):
            return self._joined([self.texts(part, within, depth) for part in node.values])
        if isinstance(node, ast.FormattedValue):
            plain = node.format_spec is None and node.conversion == -1
            plain = plain and isinstance(node.value, ast.Name | ast.IfExp | ast.Call)
            return self.texts(node.value, within, depth + 1) if plain else [HOLE]
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
            return self._joined(
                [self.texts(part, within, depth) for part in (node.left, node.right)]
            )
        if isinstance(node, ast.IfExp):
            return self.texts(node.body, within, depth) + self.texts(node.orelse, within, depth)
        if isinstance(node, ast.Name):
            return self._named(node.id, within, depth)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            function = self.functions.get(node.func.id)
            if function is not None:
                made = [
                    n.value for n in ast.walk(function) if isinstance(n, ast.Return) and n.value
                ]
                return self._some([t for n in made for t in self.texts(n, function, depth + 1)])
        return [HOLE]

    def _joined(self, parts: list[list[str]]) -> list[str]:
        known = [part or [HOLE] for part in parts]  # too many texts count as none
        return self._some(["".join(each) for each in itertools.product(*known)]) or [
            "".join(part[0] if len(part) == 1 else HOLE for part in known)
        ]

    @staticmethod
    def _some(texts: list[str]) -> list[str]:
        """Return the distinct texts, or none if there are more than `_MOST`."""
        texts = list(dict.fromkeys(texts))
        return texts if len(texts) <= _MOST else []

    def _named(self, name: str, within: ast.AST | None, depth: int) -> list[str]:
        """Return the texts of a variable of the function, or of a constant of a module."""
        for scope in (within, self.tree):
            body = ast.walk(scope) if scope is within and scope is not None else self.tree.body
            found = [
                node.value
                for node in body
                if isinstance(node, ast.Assign)
                for target in node.targets
                if isinstance(target, ast.Name) and target.id == name
            ]
            texts = [t for n in found for t in self.texts(n, within, depth + 1)]
            if texts and all(re.search("[a-z]{2}", t) for t in texts):
                return self._some(texts) or [HOLE]
            if found:
                return [HOLE]
        for node in self.tree.body:
            if isinstance(node, ast.ImportFrom) and any(alias.name == name for alias in node.names):
                path = self.package.parent.joinpath(*str(node.module).split("."))
                path = path.with_suffix(".py")
                if path.is_file():
                    return _Module(path, self.package)._named(name, None, depth + 1)
        return [HOLE]

    # ---- messages --------------------------------------------------------------------------------

    def messages(self) -> Iterator[Message]:
        """Yield all messages of the module in the order of `ast.walk`."""
        for node in ast.walk(self.tree):
            within = self.around.get(node)
            for kind, expression in self._said(node, within):
                for text in self.texts(expression, within) or [HOLE]:
                    text = re.sub(r"%[-+.\d]*[a-z]", HOLE, text) if kind in _LOGGED else text
                    text = re.sub(f"{HOLE}+", HOLE, re.sub(r"\s+", " ", text)).strip()
                    yield Message(self.name, node.lineno, kind, text)

    def _said(
        self, node: ast.AST, within: ast.FunctionDef | None
    ) -> Iterator[tuple[str, ast.expr]]:
        """Yield kind and text expression of the messages that begin at a node."""
        name = within.name if within is not None else ""
        told = dict.fromkeys(_VERDICT, "verdict")
        if self.name.startswith("methods."):
            told |= dict.fromkeys(_ATTEMPT, "attempt")
        if isinstance(node, ast.Return) and isinstance(node.value, ast.JoinedStr) and name in told:
            yield told[name], node.value
        if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(node.value, ast.Dict):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(t, ast.Name) and t.id == "_OUTCOMES" for t in targets):
                yield from (("attempt", value) for value in node.value.values)
        if name == "conditions" and isinstance(node, ast.Assign):
            if isinstance(node.value, ast.JoinedStr | ast.Constant):
                yield "verdict", node.value
        if not isinstance(node, ast.Call) or not node.args:
            return
        function, first = node.func, node.args[0]
        if isinstance(function, ast.Name):
            if re.fullmatch(r"\w+Error", function.id):
                yield function.id, first
            elif function.id == "warn":
                yield "warning", node.args[-1]
            elif function.id == "Condition" and isinstance(node.args[-1], ast.JoinedStr):
                yield "verdict", node.args[-1]
        elif isinstance(function, ast.Attribute):
            base = ast.unparse(function.value)
            if base == "warnings" and function.attr == "warn":
                yield "warning", first
            elif base == "logger" and function.attr in ("warning", "critical"):
                yield "warning", first
            elif base == "logger" and function.attr == "info":
                yield "log", first
            elif base == "super()" and function.attr == "__init__" and self._of_error(node):
                yield self._of_error(node), first
            elif function.attr == "condition":
                yield "verdict", node.args[1]
            elif function.attr == "append" and name in told:
                yield told[name], first

    def _of_error(self, call: ast.Call) -> str:
        """Return the name of the error class that contains a call, or an empty string."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.ClassDef) and any(n is call for n in ast.walk(node)):
                if any(ast.unparse(base).endswith("Error") for base in node.bases):
                    return node.name
        return ""


_LOGGED = {"warning", "log"}
# Kinds with a separate table; all others are errors.
KINDS = ("NotConverged", "verdict", "attempt", "warning", "log")


def read(package: Path = PACKAGE) -> list[Message]:
    """Return all messages that have words, sorted by module and line."""
    found = {
        message
        for path in sorted(package.rglob("*.py"))
        for message in _Module(path, package).messages()
        if message.says
    }
    return sorted(found, key=lambda m: (m.module, m.line, m.text))


# ---- pages ---------------------------------------------------------------------------------------


def _cell(text: str) -> str:
    """Escape a text for a table in Markdown."""
    return re.sub(r"([\\`*_\[\]<>|#$~{}])", r"\\\1", text)


def _table(rows: list[tuple[str, ...]]) -> str:
    lines = ["| " + " | ".join(cells) + " |" for cells in rows]
    return "\n".join([lines[0], "| --- " * len(rows[0]) + "|", *lines[1:]]) + "\n"


def pages(found: list[Message]) -> dict[str, str]:
    """Return the tables by name of the included file, with errors by folder of the package."""
    made = {}
    for kind in KINDS:
        rows = list(dict.fromkeys((_cell(m.text),) for m in found if m.kind == kind))
        made[f"{kind}.md"] = _table([("text",), *rows])
    folders: dict[str, list[tuple[str, ...]]] = {}
    for m in found:
        if m.kind not in KINDS:
            row = (_cell(m.text), f"`{m.kind}`")
            folders.setdefault(m.module.rpartition(".")[0], []).append(row)
    parts = [
        f"### {folder or 'meshes, problem and arguments'}\n\n"
        + _table([("text", "error"), *dict.fromkeys(rows)])
        for folder, rows in folders.items()
    ]
    return made | {"errors.md": "\n".join(parts)}


def write(folder: Path) -> None:
    """Write the tables whose files are missing or differ."""
    folder.mkdir(exist_ok=True)
    for name, text in pages(read()).items():
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    for text in pages(read()).values():
        print(text)
