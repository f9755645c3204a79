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
LAYERS = [
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
FORBIDDEN_LAYERS = {"methods": {"checks"}}
# Base modules, which belong to no layer and import from none.
BASE_MODULES = {
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


def imported_modules(source: str) -> Iterator[str]:
    """Yield modules of the package that a source imports anywhere; "" is the package itself.

    Relative imports are yielded as they are written, and so belong to no layer.
    """
    known = {name(p) for p in MODULES}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.level:
            yield "." * node.level + (node.module or "")
        elif isinstance(node, ast.ImportFrom) and is_in_package(node.module or ""):
            module = (node.module or "").removeprefix("fenics_contact").removeprefix(".")
            for alias in node.names:
                submodule = f"{module}.{alias.name}".removeprefix(".")
                yield submodule if submodule in known else module
        elif isinstance(node, ast.Import):
            for alias in node.names:
                if is_in_package(alias.name):
                    yield alias.name.removeprefix("fenics_contact").removeprefix(".")


def is_in_package(module: str) -> bool:
    """Return whether a module is the package or a part of it."""
    return module.split(".")[0] == "fenics_contact"


def forbidden_imports(layer: str, source: str) -> set[str]:
    """Return layers that a source in a layer imports from against the rules."""
    allowed = (
        {*BASE_MODULES}
        if layer in BASE_MODULES
        else {*BASE_MODULES, *LAYERS[: LAYERS.index(layer) + 1]}
    )
    allowed -= FORBIDDEN_LAYERS.get(layer, set())
    return {module.split(".")[0] or module for module in imported_modules(source)} - allowed


def circular_imports(needs: Mapping[str, set[str]]) -> set[str]:
    """Return modules that cannot be ordered so that each imports only modules before it."""
    remaining = dict(needs)
    while remaining:
        ready = {module for module, others in remaining.items() if not others & remaining.keys()}
        if not ready:
            return set(remaining)
        remaining = {module: others for module, others in remaining.items() if module not in ready}
    return set()


def test_every_module_belongs_to_a_layer():
    """Every module is in a layer or is a base module."""
    places = {name(path).split(".")[0] for path in MODULES} - {""}
    assert places == {*LAYERS, *BASE_MODULES}


def violations_by_file(
    paths: list[Path], find: Callable[[Path], Collection[str]]
) -> dict[str, list[str]]:
    """Return the violations by file, for files that have any."""
    violations = {str(path.relative_to(ROOT)): sorted(find(path)) for path in paths}
    return {path: lines for path, lines in violations.items() if lines}


def test_imports_go_to_lower_layers_only():
    """A layer imports from itself and lower ones; base modules import base modules only."""
    placed = [path for path in MODULES if name(path)]
    assert not violations_by_file(
        placed, lambda path: forbidden_imports(name(path).split(".")[0], path.read_text())
    )


def test_no_circular_imports():
    """Imports have no cycle, including imports inside of functions."""
    assert not circular_imports(
        {name(p): set(imported_modules(p.read_text())) - {name(p)} for p in MODULES}
    )


def private_name(node: ast.AST) -> str:
    """Return the private name that a node accesses, as an attribute or a string, or ""."""
    accessed = ""
    if isinstance(node, ast.Attribute):
        accessed = node.attr
    elif isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Constant):
        of = ast.unparse(node.value)
        accessed = (
            str(node.slice.value) if of.endswith("__dict__") or of.startswith("vars(") else ""
        )
    elif isinstance(node, ast.Call):
        called = ast.unparse(node.func).split(".")[-1]
        constants = [a.value for a in node.args if isinstance(a, ast.Constant)]
        if called.endswith("attr") or called in ("attrgetter", "methodcaller"):
            accessed = next((value for value in constants if isinstance(value, str)), "")
        # A test may set a constant of a module.
        accessed = accessed if accessed != accessed.upper() else ""
    return accessed if re.match("_[A-Za-z]", accessed) else ""


def private_accesses(source: str, foreign: set[str]) -> list[str]:
    """Return accesses to private members of other objects, and imports of private names."""
    tree = ast.parse(source)
    classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    allowed = {node for each in classes for node in members(each)}
    accesses = [
        f"line {node.lineno}: {ast.unparse(node)}"
        for node in ast.walk(tree)
        if private_name(node) and node not in allowed and private_name(node) not in foreign
    ]
    return accesses + [
        f"line {node.lineno}: {alias.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and is_in_package(node.module or "")
        for alias in node.names
        if re.match("_[A-Za-z]", alias.name)
    ]


def members(of: ast.ClassDef) -> Iterator[ast.AST]:
    """Yield accesses of a class to its own members, of self or of annotated arguments."""
    nodes = list(ast.walk(of))
    owned = {
        argument.arg
        for argument in nodes
        if isinstance(argument, ast.arg) and argument.annotation is not None
        if ast.unparse(argument.annotation) in (of.name, "Self")
    }
    for node in nodes:
        if isinstance(node, ast.Attribute) and private_name(node):
            whose = node.value
            is_own_class = isinstance(whose, ast.Call) and ast.unparse(whose.func) in (
                of.name,
                "super",
            )
            if is_own_class or ast.unparse(whose) in {"self", "cls", "this", of.name, *owned}:
                yield node


def test_private_members_are_used_by_their_class_only():
    """`x._y` is allowed for self, and for other instances in the body of their class."""
    allowed_names, others = OF_DOLFINX | OF_NOTEBOOKS, OF_DOLFINX | OF_NOTEBOOKS | OF_MATPLOTLIB
    assert not violations_by_file(
        MODULES, lambda path: private_accesses(path.read_text(), allowed_names)
    )
    assert not violations_by_file(OTHERS, lambda path: private_accesses(path.read_text(), others))


def changes_search_path(source: str) -> bool:
    """Return whether a source changes the module search path."""
    return bool(re.search(r"sys\.path\b|from sys import .*\bpath\b|\baddsitedir\b", source))


def imported_tests(source: str) -> list[str]:
    """Return test modules that a source imports, or imports from."""
    imports = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            imports += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            imports += [f"{node.module or ''}.{alias.name}" for alias in node.names]
    return [each for each in imports if re.search(r"(^|\.)(tests|test_\w+|conftest)(\.|$)", each)]


def test_scripts_import_installed_packages_only():
    """Only scripts of the documentation change the search path; no test imports another."""
    may = ("conf.py", "test_docs.py", "test_architecture.py")
    assert not [p for p in OTHERS if p.name not in may and changes_search_path(p.read_text())]
    assert not violations_by_file(OTHERS, lambda path: imported_tests(path.read_text()))


def annotations_as_any(source: str) -> list[str]:
    """Return arguments and attributes annotated as Any although the package has a class."""
    violations = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg):
            argument, annotation = node.arg, node.annotation
        elif isinstance(node, ast.AnnAssign):
            argument, annotation = ast.unparse(node.target).split(".")[-1], node.annotation
        else:
            continue
        kinds = (
            set() if annotation is None else set(re.split(r"[ |\[\]]+", ast.unparse(annotation)))
        )
        if argument.lstrip("_") in KNOWN and kinds <= {"Any", "typing.Any", "None", "Optional", ""}:
            violations += [f"line {node.lineno}: {argument}"] if kinds else []
    return violations


def test_known_classes_are_not_annotated_as_any():
    """No argument or attribute for which the package has a class is annotated as `Any`."""
    assert not violations_by_file(MODULES, lambda path: annotations_as_any(path.read_text()))


BROKEN = {
    "a layer above": lambda: forbidden_imports(
        "laws", "from fenics_contact.contact.contact import Contact"
    ),
    "a layer above, by name": lambda: forbidden_imports(
        "surface", "from fenics_contact import problem"
    ),
    "a layer above, in a function": lambda: forbidden_imports(
        "checks", "def f():\n    import fenics_contact.methods.solver"
    ),
    "a forbidden layer": lambda: forbidden_imports(
        "methods", "from fenics_contact.checks import verifier"
    ),
    "a layer from a base module": lambda: forbidden_imports(
        "compat", "import fenics_contact.laws.base"
    ),
    "the whole package": lambda: forbidden_imports("problem", "import fenics_contact as fc"),
    "a name of the whole package": lambda: forbidden_imports(
        "histories", "from fenics_contact import Law"
    ),
    "a relative import": lambda: forbidden_imports("methods", "from ..problem import x"),
    "a circular import": lambda: circular_imports({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": set()}),
    "a private member": lambda: private_accesses(
        "class A:\n    def f(self, b):\n        b._c", set()
    ),
    "one that the class has, too": lambda: private_accesses(
        "class A:\n    def f(self, b: B):\n        self._c = b._c", set()
    ),
    "one of a member": lambda: private_accesses(
        "class A:\n    def f(self):\n        self.b._c", set()
    ),
    "one by its name": lambda: private_accesses("getattr(a, '_b')", set()),
    "one of its dictionary": lambda: private_accesses("vars(a)['_b'] = 1", set()),
    "a private function": lambda: private_accesses(
        "from fenics_contact.laws.base import _f", set()
    ),
    "a path": lambda: changes_search_path("import sys\nsys.path.insert(0, '.')"),
    "a path by another name": lambda: changes_search_path("from sys import argv, path"),
    "a test": lambda: imported_tests("from test_solver import scene"),
    "a test as a module": lambda: imported_tests("import test_solver"),
    "a test of the folder": lambda: imported_tests("from tests import test_solver"),
    "a name of a test": lambda: imported_tests("from tests.test_solver import scene"),
    "an argument": lambda: annotations_as_any("def f(problem: Any): ..."),
    "an argument or none": lambda: annotations_as_any("def f(*, contact: Any | None = None): ..."),
    "an attribute": lambda: annotations_as_any("class A:\n    system: Any"),
    "a private attribute": lambda: annotations_as_any("self._problem: Optional[Any] = None"),
}


def test_violations_of_the_rules_are_detected():
    """Every violation in ``BROKEN`` is detected."""
    assert not [rule for rule, is_detected in BROKEN.items() if not is_detected()]


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
def exported_names(path: Path) -> set[str]:
    """Return the names in ``__all__`` of a module."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return set(ast.literal_eval(node.value))
    return set()


def unexported_names(path: Path) -> list[str]:
    """Return imported names that are not in ``__all__``, and private names in its own."""
    exported = {name(p): exported_names(p) for p in MODULES}
    tree, modules, unexported = ast.parse(path.read_text()), {}, []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fenics_contact"):
            module = (node.module or "").removeprefix("fenics_contact").removeprefix(".")
            for alias in node.names:
                module_name = f"{module}.{alias.name}".removeprefix(".")
                if module_name in exported:
                    modules[alias.asname or alias.name] = module_name
                elif alias.name not in exported[module]:
                    unexported.append(module_name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = modules.get(node.value.id)
            if module is not None and node.attr not in exported[module]:
                unexported.append(f"{module}.{node.attr}")
    return unexported + [n for n in exported[name(path)] if re.match("_[a-z]", n)]


def test_imported_names_are_in_all():
    """Names imported, or accessed by module, are in ``__all__``, which has no private names."""
    assert not violations_by_file(MODULES, unexported_names)


def constructor_attributes(of: ast.ClassDef, known: dict[str, ast.ClassDef]) -> set[str]:
    """Return attributes that a class or its bases in the package define on construction."""
    attributes = set()
    for part in of.body:
        if isinstance(part, ast.FunctionDef) and part.name == "__init__":
            attributes |= set(attributes_set_on_self(part))
        if isinstance(part, ast.FunctionDef) and part.decorator_list:
            attributes.add(part.name)  # a property
        if isinstance(part, ast.AnnAssign) and any(
            "dataclass" in ast.unparse(decorator) for decorator in of.decorator_list
        ):
            attributes.add(ast.unparse(part.target))
    for base in of.bases:
        if ast.unparse(base) in known:
            attributes |= constructor_attributes(known[ast.unparse(base)], known)
    return attributes


def attributes_set_on_self(function: ast.FunctionDef) -> Iterator[str]:
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
    defined_later = {
        f"{one.name}.{attribute}, in {part.name}"
        for one in classes
        for part in one.body
        if isinstance(part, ast.FunctionDef)
        for attribute in set(attributes_set_on_self(part)) - constructor_attributes(one, known)
    }
    assert not defined_later
