"""Structure of the package: imports of lower layers only, no access to private members."""

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
# Layers from the lowest to the highest; a layer may import from itself and from lower ones.
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
# Solution methods must not depend on the checks that verify their solutions.
APART = {"methods": {"checks"}}
# Base modules, which belong to no layer and import from none.
GROUND = {
    *("compat", "parallel", "types", "meshes", "joining", "arguments", "elasticity", "markup"),
    *("_version", "compiling", "installation", "tolerances", "wording"),
}
# DOLFINx's C++ objects are accessible by this private name only.
OF_DOLFINX = {"_cpp_object"}
# Matplotlib's 3D artists have their data in these private attributes only.
OF_MATPLOTLIB = {"_segments3d", "_vec", "_faces", "_segslices"}
# Notebooks call this method of an object to display it.
OF_NOTEBOOKS = {"_repr_html_"}
# Names or arguments that differ between releases of DOLFINx.
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
    """Return the dotted name of a module without that of the package."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def imported(source: str) -> Iterator[str]:
    """Yield modules of the package that a source imports anywhere; "" is the package itself.

    Relative imports are yielded as they are written, and so belong to no layer.
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
    """Return whether a module is the package or a part of it."""
    return module.split(".")[0] == "fenics_contact"


def upwards(room: str, source: str) -> set[str]:
    """Return layers that a source in a layer imports from against the rules."""
    allowed = {*GROUND} if room in GROUND else {*GROUND, *ROOMS[: ROOMS.index(room) + 1]}
    allowed -= APART.get(room, set())
    return {module.split(".")[0] or module for module in imported(source)} - allowed


def circle(needs: Mapping[str, set[str]]) -> set[str]:
    """Return modules that cannot be ordered so that each imports only modules before it."""
    left = dict(needs)
    while left:
        ready = {module for module, others in left.items() if not others & left.keys()}
        if not ready:
            return set(left)
        left = {module: others for module, others in left.items() if module not in ready}
    return set()


def test_every_module_belongs_to_a_layer():
    """Every module is in a layer or is a base module."""
    places = {name(path).split(".")[0] for path in MODULES} - {""}
    assert places == {*ROOMS, *GROUND}


def offences(paths: list[Path], find: Callable[[Path], Collection[str]]) -> dict[str, list[str]]:
    """Return the violations by file, for files that have any."""
    found = {str(path.relative_to(ROOT)): sorted(find(path)) for path in paths}
    return {path: what for path, what in found.items() if what}


def test_imports_go_to_lower_layers_only():
    """A layer imports from itself and lower ones; base modules import base modules only."""
    placed = [path for path in MODULES if name(path)]
    assert not offences(placed, lambda path: upwards(name(path).split(".")[0], path.read_text()))


def test_no_circular_imports():
    """Imports have no cycle, including imports inside of functions."""
    assert not circle({name(p): set(imported(p.read_text())) - {name(p)} for p in MODULES})


def private(node: ast.AST) -> str:
    """Return the private name that a node accesses, as an attribute or a string, or ""."""
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
        asked = asked if asked != asked.upper() else ""  # a test may set a constant of a module
    return asked if re.match("_[A-Za-z]", asked) else ""


def touched(source: str, foreign: set[str]) -> list[str]:
    """Return accesses to private members of other objects, and imports of private names."""
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
    """Yield accesses of a class to its own members, of self or of annotated arguments."""
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


def test_private_members_are_used_by_their_class_only():
    """`x._y` is allowed for self, and for other instances in the body of their class."""
    own, others = OF_DOLFINX | OF_NOTEBOOKS, OF_DOLFINX | OF_NOTEBOOKS | OF_MATPLOTLIB
    assert not offences(MODULES, lambda path: touched(path.read_text(), own))
    assert not offences(OTHERS, lambda path: touched(path.read_text(), others))


def made_findable(source: str) -> bool:
    """Return whether a source changes the module search path."""
    return bool(re.search(r"sys\.path\b|from sys import .*\bpath\b|\baddsitedir\b", source))


def imported_tests(source: str) -> list[str]:
    """Return test modules that a source imports, or imports from."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found += [f"{node.module or ''}.{alias.name}" for alias in node.names]
    return [each for each in found if re.search(r"(^|\.)(tests|test_\w+|conftest)(\.|$)", each)]


def test_scripts_import_installed_packages_only():
    """Only scripts of the documentation change the search path; no test imports another."""
    may = ("conf.py", "test_docs.py", "test_architecture.py")
    assert not [p for p in OTHERS if p.name not in may and made_findable(p.read_text())]
    assert not offences(OTHERS, lambda path: imported_tests(path.read_text()))


def anything(source: str) -> list[str]:
    """Return arguments and attributes annotated as Any although the package has a class."""
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


def test_known_classes_are_not_annotated_as_any():
    """No argument or attribute for which the package has a class is annotated as `Any`."""
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


def test_violations_of_the_rules_are_detected():
    """Every violation in ``BROKEN`` is detected."""
    assert not [how for how, found in BROKEN.items() if not found()]


def test_names_that_depend_on_the_release_come_from_compat():
    """Other modules, demos, benchmarks and verification use `compat` for these names."""
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
    """Return the names in ``__all__`` of a module."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return set(ast.literal_eval(node.value))
    return set()


def not_exported(path: Path) -> list[str]:
    """Return imported names that are not in ``__all__``, and private names in its own."""
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


def test_imported_names_are_in_all():
    """Names imported, or accessed by module, are in ``__all__``, which has no private names."""
    assert not offences(MODULES, not_exported)


def made_in_constructor(of: ast.ClassDef, known: dict[str, ast.ClassDef]) -> set[str]:
    """Return attributes that a class or its bases in the package define on construction."""
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
    """Yield attributes of self that a function assigns or declares."""
    for node in ast.walk(function):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            if ast.unparse(node.value) == "self":
                yield node.attr


def test_attributes_are_defined_in_the_constructor():
    """No method other than the constructor adds attributes to an object."""
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
