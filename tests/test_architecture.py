"""How the package is built: imports run downwards, and nobody reaches into another object."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "fenics_contact"
MODULES = sorted(PACKAGE.rglob("*.py"))
# From below upwards; a room may import from itself and from those before it.
ROOMS = [
    "laws",
    "supports",
    "surface",
    "contact",
    "systems",
    "checks",
    "methods",
    "problem",
    "results",
    "estimates",
    "histories",
]
# Modules that stand in no room and know none of them.
GROUND = {"compat", "parallel", "types", "arguments", "elasticity", "_version"}
# DOLFINx names its C++ objects so, and there is no other way to them.
OF_DOLFINX = {"_cpp_object"}
KNOWN = {"problem", "contact", "system", "solver", "operator", "unknowns", "verdict", "law"}


def name(path: Path) -> str:
    """Of a module, with dots, without the package's."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def imported(path: Path) -> Iterator[str]:
    """Modules of the package that a module imports, wherever in it."""
    known = {name(p) for p in MODULES}
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fenics_contact"):
            module = (node.module or "").removeprefix("fenics_contact").removeprefix(".")
            for alias in node.names:
                whole = f"{module}.{alias.name}".removeprefix(".")
                yield whole if whole in known else module
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if alias.name.startswith("fenics_contact."):
                    yield alias.name.removeprefix("fenics_contact.")


def test_every_module_stands_somewhere():
    """In a room, or on the ground that all stand on."""
    places = {name(path).split(".")[0] for path in MODULES} - {""}
    assert places == {*ROOMS, *GROUND}


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_imports_run_downwards(path):
    """From a room to itself or to one below, never up; the ground imports ground alone."""
    room = name(path).split(".")[0]
    if room == "":
        return
    allowed = {*GROUND} if room in GROUND else {*GROUND, *ROOMS[: ROOMS.index(room) + 1]}
    assert {module.split(".")[0] for module in imported(path)} <= allowed


def test_no_circle():
    """The modules can be put in an order in which each imports those before it alone."""
    left = {name(path): set(imported(path)) - {name(path)} for path in MODULES if name(path)}
    while left:
        ready = {module for module, needs in left.items() if not needs & left.keys()}
        assert ready, f"these import each other: {sorted(left)}"
        left = {module: needs for module, needs in left.items() if module not in ready}


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_nobody_touches_private_members_of_another(path):
    """`x._y` is for self, and for another instance in the body of the class that has it."""
    tree = ast.parse(path.read_text())
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    allowed = {node for each in classes for node in ast.walk(each) if is_member(node, each)}
    touched = [
        f"line {node.lineno}: {ast.unparse(node)}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and re.match("_[a-z]", node.attr)
        if node not in allowed and node.attr not in OF_DOLFINX
    ]
    assert not touched


def is_member(node: ast.AST, of: ast.ClassDef) -> bool:
    """Whether a private member that is asked for is one of a class."""
    if not isinstance(node, ast.Attribute):
        return False
    base = node.value
    if isinstance(base, ast.Name) and base.id in ("self", "cls", "this", of.name):
        return True
    functions = {part.name for part in of.body if isinstance(part, ast.FunctionDef)}
    return node.attr in functions | {
        part.attr
        for part in ast.walk(of)
        if isinstance(part, ast.Attribute) and ast.unparse(part.value) == "self"
    }


def test_no_argument_may_be_anything_that_is_known():
    """Of what the package has classes for none is passed on as `Any`."""
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.arg) and node.annotation is not None:
                anything = ast.unparse(node.annotation) == "Any"
                assert not (anything and node.arg in KNOWN), f"{name(path)}: {node.arg}: Any"
