"""How the package is built: imports run downwards, and nobody reaches into another object."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.whole
PACKAGE = Path(__file__).resolve().parent.parent / "fenics_contact"
MODULES = sorted(PACKAGE.rglob("*.py"))
ROOT = PACKAGE.parent
FOLDERS = ("demos", "examples", "scenes", "tests", "benchmarks", "verification", "docs")
OTHERS = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
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
    "__main__",
]
# Modules that stand in no room and know none of them.
GROUND = {
    *("compat", "parallel", "types", "meshes", "joining", "arguments", "elasticity", "markup"),
    *("_version", "compiling", "installation"),
}
# DOLFINx names its C++ objects so, and there is no other way to them.
OF_DOLFINX = {"_cpp_object"}
# What Matplotlib has drawn in space is known by these alone.
OF_MATPLOTLIB = {"_segments3d", "_vec", "_faces", "_segslices"}
# By this name notebooks ask any object how it is shown.
OF_NOTEBOOKS = {"_repr_html_"}
# What releases of DOLFINx have by different names or with different arguments.
BY_RELEASE = {
    *("cmap", "cmaps", "dofmaps", "create_submesh", "create_cell_partitioner"),
    *("interpolation_points", "model_to_mesh", "gmshio"),
}
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


def private(node: ast.AST) -> str:
    """The private name by which something is asked for, as an attribute or in words; or none."""
    asked = ""
    if isinstance(node, ast.Attribute):
        asked = node.attr
    elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1].endswith("attr"):
        given = [a.value for a in node.args if isinstance(a, ast.Constant)]
        asked = next((value for value in given if isinstance(value, str)), "")
        asked = asked if asked != asked.upper() else ""  # a test may set a module's threshold
    return asked if re.match("_[A-Za-z]", asked) else ""


@pytest.mark.parametrize("path", MODULES + OTHERS, ids=lambda path: str(path.relative_to(ROOT)))
def test_nobody_touches_private_members_of_another(path):
    """`x._y` is for self, and for another instance in the body of the class that has it."""
    tree = ast.parse(path.read_text())
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    allowed = {node for each in classes for node in ast.walk(each) if is_member(node, each)}
    foreign = OF_DOLFINX | OF_NOTEBOOKS | (OF_MATPLOTLIB if path in OTHERS else set())
    touched = [
        f"line {node.lineno}: {ast.unparse(node)}"
        for node in ast.walk(tree)
        if private(node) and node not in allowed and private(node) not in foreign
    ]
    assert not touched
    imported = [
        f"line {node.lineno}: {alias.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fenics_contact")
        for alias in node.names
        if re.match("_[A-Za-z]", alias.name)
    ]
    assert not imported


@pytest.mark.parametrize("path", OTHERS, ids=lambda path: str(path.relative_to(ROOT)))
def test_scripts_stand_on_packages(path):
    """None makes others findable but the pages' own, and no test is taken from another."""
    text = path.read_text()
    if path.name not in ("conf.py", "test_docs.py", "test_architecture.py"):
        assert "sys.path" not in text
    froms = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
    assert not [node.module for node in froms if (node.module or "").startswith("test_")]


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


def test_what_releases_differ_in_is_asked_of_compat():
    """Other modules, demos, benchmarks and verification go through it."""
    folders = ("fenics_contact", "demos", "benchmarks", "verification")
    paths = {path for folder in folders for path in (PACKAGE.parent / folder).rglob("*.py")}
    past = [
        f"{path.name}, line {node.lineno}: {ast.unparse(node)}"
        for path in paths - {PACKAGE / "compat.py"}
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) not in ("compat", "fc")
        if node.attr in BY_RELEASE or ast.unparse(node).endswith("geometry.dofmap")
    ]
    assert not past


@cache
def exported(path: Path) -> set[str]:
    """What a module says others may import."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return set(ast.literal_eval(node.value))
    return set()


@pytest.mark.parametrize("path", MODULES, ids=name)
def test_what_others_import_is_in_all(path):
    """Whether by its name, or as an attribute of the module; and what is there has no secrets."""
    said = {name(p): exported(p) for p in MODULES}
    tree, modules, unsaid = ast.parse(path.read_text()), {}, []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fenics_contact"):
            module = (node.module or "").removeprefix("fenics_contact").removeprefix(".")
            for alias in node.names:
                whole = f"{module}.{alias.name}".removeprefix(".")
                if whole in said:
                    modules[alias.asname or alias.name] = whole
                elif alias.name not in said[module]:
                    unsaid.append(whole)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = modules.get(node.value.id)
            if module is not None and node.attr not in said[module]:
                unsaid.append(f"{module}.{node.attr}")
    assert not unsaid
    assert not [n for n in said[name(path)] if re.match("_[a-z]", n)]


def made_in_constructor(of: ast.ClassDef, known: dict[str, ast.ClassDef]) -> set[str]:
    """Attributes that a class, or one of the package that it inherits from, has from the start."""
    found = set()
    for part in of.body:
        if isinstance(part, ast.FunctionDef) and part.name == "__init__":
            found |= set(set_on_self(part))
        if isinstance(part, ast.FunctionDef) and part.decorator_list:
            found.add(part.name)  # a property
        if isinstance(part, ast.AnnAssign) and any(
            "dataclass" in ast.unparse(decorator) for decorator in of.decorator_list
        ):
            found.add(ast.unparse(part.target))
    for base in of.bases:
        if ast.unparse(base) in known:
            found |= made_in_constructor(known[ast.unparse(base)], known)
    return found


def set_on_self(function: ast.FunctionDef) -> Iterator[str]:
    """Attributes that are assigned to, or declared."""
    for node in ast.walk(function):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            if ast.unparse(node.value) == "self":
                yield node.attr


def test_attributes_are_made_in_the_constructor():
    """Whoever reads it knows all that an object may have; no method makes more of it."""
    classes = [
        node
        for path in MODULES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
    ]
    known = {one.name: one for one in classes}
    late = {
        f"{one.name}.{attribute}, in {part.name}"
        for one in classes
        for part in one.body
        if isinstance(part, ast.FunctionDef)
        for attribute in set(set_on_self(part)) - made_in_constructor(one, known)
    }
    assert not late
