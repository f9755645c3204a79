"""How the package is built: imports run downwards, and nobody reaches into another object."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent.parent / "fenics_contact"
MODULES = sorted(PACKAGE.rglob("*.py"))
ROOT = PACKAGE.parent
FOLDERS = ("demos", "examples", "scenes", "tests", "benchmarks", "verification", "docs")
OTHERS = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
# From below upwards; a room may import from itself and from those before it.
ROOMS = [
    "laws",
    "obstacles",
    "surface",
    "contact",
    "systems",
    "checks",
    "state",
    "methods",
    "step",
    "failure",
    "increment",
    "problem",
    "results",
    "estimates",
    "histories",
    "__main__",
]
# A method is not to know by what its solution is verified.
APART = {"methods": {"checks"}}
# Modules that stand in no room and know none of them.
GROUND = {
    *("compat", "parallel", "types", "meshes", "joining", "arguments", "elasticity", "markup"),
    *("_version", "compiling", "installation", "tolerances", "wording"),
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
KNOWN = {
    *("problem", "contact", "system", "solver", "operator", "unknowns", "verdict", "law", "bulk"),
    *("equations", "method", "surface", "quadrature", "verifier", "motions", "obstacle"),
    "contact_kinematics",
}


def name(path: Path) -> str:
    """Of a module, with dots, without the package's."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def imported(source: str) -> Iterator[str]:
    """Modules of the package that a source imports, wherever in it; "" is the package as a whole.

    Without names before the dot a module would stand in no room: it is said as it is written.
    """
    known = {name(p) for p in MODULES}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.level:
            yield "." * node.level + (node.module or "")
        elif isinstance(node, ast.ImportFrom) and within(node.module or ""):
            module = (node.module or "").removeprefix("fenics_contact").removeprefix(".")
            for alias in node.names:
                whole = f"{module}.{alias.name}".removeprefix(".")
                yield whole if whole in known else module
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if within(alias.name):
                    yield alias.name.removeprefix("fenics_contact").removeprefix(".")


def within(module: str) -> bool:
    """Whether a module is the package, or of it."""
    return module.split(".")[0] == "fenics_contact"


def upwards(room: str, source: str) -> set[str]:
    """Rooms that a source in a room imports from and may not."""
    allowed = {*GROUND} if room in GROUND else {*GROUND, *ROOMS[: ROOMS.index(room) + 1]}
    allowed -= APART.get(room, set())
    return {module.split(".")[0] or module for module in imported(source)} - allowed


def circle(needs: Mapping[str, set[str]]) -> set[str]:
    """Modules that cannot be put in an order in which each imports those before it alone."""
    left = dict(needs)
    while left:
        ready = {module for module, others in left.items() if not others & left.keys()}
        if not ready:
            return set(left)
        left = {module: others for module, others in left.items() if module not in ready}
    return set()


def test_every_module_stands_somewhere():
    """In a room, or on the ground that all stand on."""
    places = {name(path).split(".")[0] for path in MODULES} - {""}
    assert places == {*ROOMS, *GROUND}


def offences(paths: list[Path], find: Callable[[Path], Collection[str]]) -> dict[str, list[str]]:
    """What is found in files, of those where something is."""
    found = {str(path.relative_to(ROOT)): sorted(find(path)) for path in paths}
    return {path: what for path, what in found.items() if what}


def test_imports_run_downwards():
    """From a room to itself or to one below, never up; the ground imports ground alone."""
    placed = [path for path in MODULES if name(path)]
    assert not offences(placed, lambda path: upwards(name(path).split(".")[0], path.read_text()))


def test_no_circle():
    """Nor one of imports that are made when they are needed."""
    assert not circle({name(p): set(imported(p.read_text())) - {name(p)} for p in MODULES})


def private(node: ast.AST) -> str:
    """The private name by which something is asked for, as an attribute or in words; or none."""
    asked = ""
    if isinstance(node, ast.Attribute):
        asked = node.attr
    elif isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
        of = ast.unparse(node.value)
        asked = str(node.slice.value) if of.endswith("__dict__") or of.startswith("vars(") else ""
    elif isinstance(node, ast.Call):
        called = ast.unparse(node.func).split(".")[-1]
        given = [a.value for a in node.args if isinstance(a, ast.Constant)]
        if called.endswith("attr") or called in ("attrgetter", "methodcaller"):
            asked = next((value for value in given if isinstance(value, str)), "")
        asked = asked if asked != asked.upper() else ""  # a test may set a module's threshold
    return asked if re.match("_[A-Za-z]", asked) else ""


def touched(source: str, foreign: set[str]) -> list[str]:
    """Private members of other objects that a source touches, and private names it imports."""
    tree = ast.parse(source)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    allowed = {node for each in classes for node in members(each)}
    asked = [
        f"line {node.lineno}: {ast.unparse(node)}"
        for node in ast.walk(tree)
        if private(node) and node not in allowed and private(node) not in foreign
    ]
    return asked + [
        f"line {node.lineno}: {alias.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and within(node.module or "")
        for alias in node.names
        if re.match("_[A-Za-z]", alias.name)
    ]


def members(of: ast.ClassDef) -> Iterator[ast.AST]:
    """Where a class asks for members of its own: by name, or by annotation."""
    nodes = list(ast.walk(of))
    given = {
        argument.arg
        for argument in nodes
        if isinstance(argument, ast.arg) and argument.annotation is not None
        if ast.unparse(argument.annotation) in (of.name, "Self")
    }
    for node in nodes:
        if isinstance(node, ast.Attribute) and private(node):
            whose = node.value
            made = isinstance(whose, ast.Call) and ast.unparse(whose.func) in (of.name, "super")
            if made or ast.unparse(whose) in {"self", "cls", "this", of.name, *given}:
                yield node


def test_nobody_touches_private_members_of_another():
    """`x._y` is for self, and for another instance in the body of the class that has it."""
    own, others = OF_DOLFINX | OF_NOTEBOOKS, OF_DOLFINX | OF_NOTEBOOKS | OF_MATPLOTLIB
    assert not offences(MODULES, lambda path: touched(path.read_text(), own))
    assert not offences(OTHERS, lambda path: touched(path.read_text(), others))


def made_findable(source: str) -> bool:
    """Whether a source changes where modules are looked for."""
    return bool(re.search(r"sys\.path\b|from sys import .*\bpath\b|\baddsitedir\b", source))


def imported_tests(source: str) -> list[str]:
    """Tests that a source imports, or takes something from."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found += [f"{node.module or ''}.{alias.name}" for alias in node.names]
    return [each for each in found if re.search(r"(^|\.)(tests|test_\w+|conftest)(\.|$)", each)]


def test_scripts_stand_on_packages():
    """None makes others findable but the pages' own, and no test is taken from another."""
    may = ("conf.py", "test_docs.py", "test_architecture.py")
    assert not [p for p in OTHERS if p.name not in may and made_findable(p.read_text())]
    assert not offences(OTHERS, lambda path: imported_tests(path.read_text()))


def anything(source: str) -> list[str]:
    """Arguments and attributes, of what the package has classes for, that may be anything."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg):
            what, annotation = node.arg, node.annotation
        elif isinstance(node, ast.AnnAssign):
            what, annotation = ast.unparse(node.target).split(".")[-1], node.annotation
        else:
            continue
        kinds = (
            set() if annotation is None else set(re.split(r"[ |\[\]]+", ast.unparse(annotation)))
        )
        if what.lstrip("_") in KNOWN and kinds <= {"Any", "typing.Any", "None", "Optional", ""}:
            found += [f"line {node.lineno}: {what}"] if kinds else []
    return found


def test_nothing_may_be_anything_that_is_known():
    """Of what the package has classes for none is passed on, or kept, as `Any`."""
    assert not offences(MODULES, lambda path: anything(path.read_text()))


BROKEN = {
    "a room above": lambda: upwards("laws", "from fenics_contact.contact.contact import Contact"),
    "a room above, by name": lambda: upwards("surface", "from fenics_contact import problem"),
    "a room above, late": lambda: upwards(
        "checks", "def f():\n    import fenics_contact.methods.solver"
    ),
    "a room apart": lambda: upwards("methods", "from fenics_contact.checks import verifier"),
    "a room from the ground": lambda: upwards("compat", "import fenics_contact.laws.base"),
    "the whole package": lambda: upwards("problem", "import fenics_contact as fc"),
    "a name of the whole package": lambda: upwards("histories", "from fenics_contact import Law"),
    "a neighbour without its room": lambda: upwards("methods", "from ..problem import x"),
    "a circle": lambda: circle({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": set()}),
    "a private member": lambda: touched("class A:\n    def f(self, b):\n        b._c", set()),
    "one that the class has, too": lambda: touched(
        "class A:\n    def f(self, b: B):\n        self._c = b._c", set()
    ),
    "one of a member": lambda: touched("class A:\n    def f(self):\n        self.b._c", set()),
    "one by its name": lambda: touched("getattr(a, '_b')", set()),
    "one of its dictionary": lambda: touched("vars(a)['_b'] = 1", set()),
    "a private function": lambda: touched("from fenics_contact.laws.base import _f", set()),
    "a path": lambda: made_findable("import sys\nsys.path.insert(0, '.')"),
    "a path by another name": lambda: made_findable("from sys import argv, path"),
    "a test": lambda: imported_tests("from test_solver import scene"),
    "a test as a module": lambda: imported_tests("import test_solver"),
    "a test of the folder": lambda: imported_tests("from tests import test_solver"),
    "a name of a test": lambda: imported_tests("from tests.test_solver import scene"),
    "an argument": lambda: anything("def f(problem: Any): ..."),
    "an argument or none": lambda: anything("def f(*, contact: Any | None = None): ..."),
    "an attribute": lambda: anything("class A:\n    system: Any"),
    "a private attribute": lambda: anything("self._problem: Optional[Any] = None"),
}


def test_what_breaks_a_rule_is_seen():
    """Each of these would be found in a module; what the rules allow is in all modules."""
    assert not [how for how, found in BROKEN.items() if not found()]


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


def not_exported(path: Path) -> list[str]:
    """What a module takes of another that is not in its ``__all__``, and secrets in its own."""
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
    return unsaid + [n for n in said[name(path)] if re.match("_[a-z]", n)]


def test_what_others_import_is_in_all():
    """Whether by its name, or as an attribute of the module; and what is there has no secrets."""
    assert not offences(MODULES, not_exported)


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
