"""Configure the build of the pages: ``python -m sphinx -W --keep-going -b html docs build/docs``.

The reference is read from the sources by sphinx-autoapi, which imports nothing. sphinx.ext.autodoc
imports the package, and stand-ins for PETSc, UFL and DOLFINx do not support what it does at import:
releases are compared, SNES reasons are converted to integers, constants are computed.
"""

from __future__ import annotations

import ast
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import messages  # noqa: E402

project = "fenics_contact"
author = "The fenics_contact developers"
copyright = author
version = release = re.search(
    r'__version__ = "(.*)"', (HERE.parent / "fenics_contact" / "_version.py").read_text()
).group(1)

extensions = ["myst_parser", "autoapi.extension", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
# Parts that other pages include.
exclude_patterns = ["benchmarks/*/*.md", "_generated"]

myst_heading_anchors = 3
myst_enable_extensions = ["colon_fence", "dollarmath"]

# Docstrings have code and names of the package in single backticks; known names become links.
default_role = "py:obj"
smartquotes = False
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Attributes", "params_style")]
# The text before the colon in Returns is a description, not a type.
napoleon_use_rtype = False
python_use_unqualified_type_names = True
autodoc_member_order = "bysource"

autoapi_dirs = ["../fenics_contact"]
autoapi_generate_api_docs = False
autoapi_options = ["members", "inherited-members"]
# Constants that are assigned together in one statement.
suppress_warnings = ["autoapi.python_import_resolution"]
autoapi_member_order = "bysource"
autoapi_python_class_content = "both"
add_module_names = False

# `-b linkcheck` requests all addresses, and again if a host is busy.
linkcheck_retries = 3
linkcheck_timeout = 30

html_theme = "pydata_sphinx_theme"
html_title = "fenics_contact"
html_show_sourcelink = False
html_theme_options: dict[str, Any] = {"navigation_with_keys": False, "show_toc_level": 2}


def escape(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Escape |x|, an absolute value that reStructuredText takes for a substitution."""
    for number, line in enumerate(lines):
        parts = re.split("(`+[^`]*`+)", line)
        parts[::2] = [part.replace("|", r"\|") for part in parts[::2]]
        lines[number] = "".join(parts)


def whole(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Restore a property's sentence, of which napoleon takes the part before a colon for a type."""
    types = [line for line in lines if line.startswith(":type: ")]
    if what.endswith("property") and types:
        lines.remove(types[0])
        lines[0] = f"{types[0].removeprefix(':type: ')}: {lines[0]}"


def fields() -> dict[str, str]:
    """Return the signatures of the generated constructors of dataclasses, by class."""
    package = HERE.parent / "fenics_contact"
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in package.rglob("*.py")}
    classes = {
        node.name: node
        for tree in trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    }
    for line in trees[package / "__init__.py"].body:  # of classes with the same name the public one
        if isinstance(line, ast.ImportFrom) and line.module != "fenics_contact":
            path = HERE.parent.joinpath(*str(line.module).split(".")).with_suffix(".py")
            for node in trees.get(path, ast.Module([], [])).body:
                if isinstance(node, ast.ClassDef) and node.name in [a.name for a in line.names]:
                    classes[node.name] = node

    def of(node: ast.ClassDef) -> dict[str, str]:
        found: dict[str, str] = {}
        for base in node.bases:
            found |= of(classes[ast.unparse(base)]) if ast.unparse(base) in classes else {}
        if any("dataclass" in ast.unparse(each) for each in node.decorator_list):
            for each in node.body:
                if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name):
                    default = ast.unparse(each.value) if each.value else ""
                    default = re.sub(r"^field\(.*\)$", "...", default)
                    found[each.target.id] = f"{each.target.id}={default}".rstrip("=")
        return found

    return {name: f"({', '.join(of(node).values())})" for name, node in classes.items() if of(node)}


def sign(
    app: Any, what: str, name: str, obj: Any, options: Any, signature: str | None, returned: Any
) -> tuple[str, None] | None:
    """Return the signature of the constructor of a dataclass, if none is written."""
    made = FIELDS.get(name.rpartition(".")[2])
    written = what.endswith("class") and signature not in (None, "", "()")
    return (made, None) if what.endswith("class") and made and not written else None


def skip(app: Any, what: str, name: str, obj: Any, skipped: bool, options: Any) -> bool | None:
    """Skip attributes without a docstring: that of their class describes them."""
    return True if what == "attribute" and not obj.docstring else None


def setup(app: Any) -> None:
    """Write the generated tables, and connect the functions of this file to Sphinx's events."""
    messages.write(HERE / "_generated")
    app.connect("autodoc-process-docstring", escape, priority=400)  # before napoleon
    app.connect("autodoc-process-docstring", whole, priority=600)
    app.connect("autodoc-process-signature", sign)
    app.connect("autoapi-skip-member", skip)


FIELDS = fields()
