"""What packages say of the project is what the project says of itself."""

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
    """Of ``a>=1``, ``a >=1`` and ``a@1:+variant``: a and 1."""
    name, bound = re.fullmatch(r"([a-z0-9-]+)\s*(?:(?:>=|@)([\d.]+))?.*", requirement).groups()
    return name, bound or ""


DEPENDENCIES = sorted(map(name_and_bound, PROJECT["dependencies"]))
PYTHON = PROJECT["requires-python"].removeprefix(">=")


def test_the_version_is_one() -> None:
    """Of the package, the citation and the recipe; and the changelog has it, or has no release."""
    version = fenics_contact.__version__
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"^version: (\S+)$", citation, re.MULTILINE) == [version]
    assert re.findall(r'^  version: "(\S+)"$', RECIPE, re.MULTILINE) == [version]
    released = re.findall(r"^## \[([\d.]+)\]", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released[:1] in ([], [version])


def test_one_release_of_the_linter() -> None:
    """In the checks and before a commit, and in the extra "dev"; sdists are without the former."""
    files = [ROOT / ".ci" / "run", ROOT / ".pre-commit-config.yaml", ROOT / "pyproject.toml"]
    text = "".join(file.read_text() for file in files if file.exists())
    assert len(set(re.findall(r"\"ruff(==.*?)\"", text))) == 1


def test_the_recipe_requires_what_the_package_does() -> None:
    """conda-forge's names are those of PyPI; it says besides that PETSc is real."""
    run = re.search(r"\n  run:\n(.*?)\n\n", RECIPE, re.DOTALL).group(1)
    wanted = re.findall(r"^    - (.*)$", run, re.MULTILINE)
    assert wanted[0] == "python >=${{ python_min }}" and wanted[-1] == "petsc * real_*"
    assert sorted(map(name_and_bound, wanted[1:-1])) == DEPENDENCIES
    assert f'python_min: "{PYTHON}"' in RECIPE
