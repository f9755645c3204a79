"""The metadata of the packages agree with those of the project."""

from __future__ import annotations

import re

import pytest

import fenics_contact
from scenes.processes import ROOT

tomllib = pytest.importorskip("tomllib", reason="of Python 3.11 and later")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
RECIPE = (ROOT / "packaging" / "conda" / "recipe.yaml").read_text()
SPACK = ROOT / "packaging" / "spack_repo" / "fenics_contact" / "packages" / "py_fenics_contact"


def name_and_bound(requirement: str) -> tuple[str, str]:
    """Return a and 1 for the requirements ``a>=1``, ``a >=1`` and ``a@1:+variant``."""
    name, bound = re.fullmatch(r"([a-z0-9-]+)\s*(?:(?:>=|@)([\d.]+))?.*", requirement).groups()
    return name, bound or ""


DEPENDENCIES = sorted(map(name_and_bound, PROJECT["dependencies"]))
PYTHON = PROJECT["requires-python"].removeprefix(">=")


def test_version_is_the_same_everywhere() -> None:
    """Package, citation and recipe have one version; it is the last in the changelog, if any."""
    version = fenics_contact.__version__
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"^version: (\S+)$", citation, re.MULTILINE) == [version]
    assert re.findall(r'^  version: "(\S+)"$', RECIPE, re.MULTILINE) == [version]
    released = re.findall(r"^## \[([\d.]+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released[:1] in ([], [version])


def test_linter_version_is_the_same_everywhere() -> None:
    """Checks, pre-commit and the extra "dev" have one linter version; sdists lack some files."""
    files = [ROOT / ".ci" / "run", ROOT / ".pre-commit-config.yaml", ROOT / "pyproject.toml"]
    text = "".join(file.read_text() for file in files if file.exists())
    assert len(set(re.findall(r"\"ruff(==.*?)\"", text))) == 1


def test_recipe_has_the_dependencies_of_the_package() -> None:
    """The recipe has the dependencies of the package, by the same names, and a real PETSc."""
    run = re.search(r"\n  run:\n(.*?)\n\n", RECIPE, re.DOTALL).group(1)
    listed = re.findall(r"^    - (.*)$", run, re.MULTILINE)
    assert listed[0] == "python >=${{ python_min }}" and listed[-1] == "petsc * real_*"
    assert sorted(map(name_and_bound, listed[1:-1])) == DEPENDENCIES
    assert f'python_min: "{PYTHON}"' in RECIPE
