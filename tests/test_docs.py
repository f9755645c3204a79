"""The pages of docs/ are complete and their scripts run; checked without Sphinx."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest
from mpi4py import MPI

import fenics_contact
from scenes.processes import ROOT, command, subprocess_environment

sys.path.insert(0, str(ROOT / "docs"))

import messages

pytestmark = pytest.mark.whole
DOCS = ROOT / "docs"
SCRIPTS = sorted((DOCS / "scripts").glob("*.py"))
# Excluded are the parts of benchmarks.md, and generated files, which pages include.
PAGES = sorted(
    path
    for path in DOCS.rglob("*.md")
    if path.parent.name != "_generated"
    if path.parent.parent.name != "benchmarks"
)
# Markdown files outside of docs/, read in the repository.
OTHERS = sorted([*ROOT.glob("*.md"), *(ROOT / "packaging").glob("*.md")])
BLOCK = re.compile(r"^```\{(\S+)\} ?([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def entries(page: Path) -> list[Path]:
    """Return the pages in a page's toctrees."""
    names = []
    for kind, _, body in BLOCK.findall(page.read_text()):
        if kind == "toctree":
            lines = [line for line in body.splitlines() if line and not line.startswith(":")]
            names += [re.sub(r".*<(.*)>", r"\1", line) for line in lines]
    return [page.parent / f"{entry}.md" for entry in names]


def test_every_page_is_in_one_toctree() -> None:
    """Every page except the index is in exactly one toctree, and every entry is a page."""
    listed = [path for page in PAGES for path in entries(page)]
    assert sorted([DOCS / "index.md", *listed]) == PAGES


def test_code_on_pages_is_included_from_tested_files() -> None:
    """Included files and their first and last lines exist; pages contain no copied Python."""
    for page in PAGES:
        check_code(page)


def check_code(page: Path) -> None:
    """Assert that the code on a page is included from a tested file."""
    text = page.read_text()
    # Only finite.md has short excerpts, tested by the files that it names.
    assert page.stem == "finite" or "```python" not in text, page
    for kind, target, body in BLOCK.findall(text):
        if kind != "literalinclude":
            continue
        file = (page.parent / target).resolve()
        assert file in [ROOT / "README.md", *SCRIPTS] or file.parent == ROOT / "examples", file
        lines = file.read_text().splitlines()
        options = dict(re.findall(r'^:([\w-]+): "?(.*?)"?$', body, flags=re.MULTILINE))
        first = options.get("start-at") or options.get("start-after")
        last = options.get("end-before")
        begin = next((i for i, line in enumerate(lines) if first and first in line), None)
        assert begin is not None, f"{page}: {target} has no {first!r}"
        if last:
            assert any(last in line for line in lines[begin + 1 :]), f"{page}: {target}: {last!r}"


def anchors(page: Path) -> set[str]:
    """Return the anchors of headings, of included files too, as GitHub and MyST generate them."""
    text = page.read_text()
    for kind, target, _ in BLOCK.findall(text):
        if kind == "include" and "_generated" not in target:
            text += "\n" + (page.parent / target).read_text()
    prose = re.sub(r"^ *(```+).*?^ *\1$", "", text, flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#{1,3} (.*)$", prose, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links(page: Path) -> list[str]:
    """Return the targets of a page's links and pictures."""
    return re.findall(r"\]\(([^)\s]+)\)", page.read_text())


def test_link_targets_exist() -> None:
    """Links lead to existing files and headings, on the page and in its source file.

    External addresses are checked by ``sphinx -b linkcheck`` on pages only, so that other files
    must not have addresses that are on no page.
    """
    targets = {link for page in PAGES for link in links(page)}
    dead = []
    for page, link in ((each, link) for each in [*OTHERS, *PAGES] for link in links(each)):
        path, _, anchor = link.partition("#")
        target = (page.parent / path) if path else page
        if link.startswith("https://"):
            alive = link in targets
        else:
            alive = target.exists() and (not anchor or anchor in anchors(target))
        if not alive:
            dead.append((page.name, link))
    assert dead == []


def test_named_files_exist() -> None:
    """Paths in backticks or commands that begin with a folder of the project exist."""
    folders = "benchmarks|demos|docker|docs|examples|packaging|scenes|tests|verification"
    # The changelog also names files that were removed.
    pages = [page for page in [*OTHERS, *PAGES] if page.stem != "CHANGELOG"]
    named = [
        (page.name, file)
        for page in pages
        for file in re.findall(rf"[` ]((?:{folders})/[\w./-]*\w)", page.read_text())
    ]
    assert [(page, file) for page, file in named if not (ROOT / file).exists()] == []


def test_named_tests_exist() -> None:
    """Test files and test functions that pages name exist."""
    missing = []
    text = "".join(page.read_text() for page in PAGES)
    for file, name in re.findall(r"`(?:tests/)?(test_\w+\.py)(?:::(\w+))?`", text):
        path = ROOT / "tests" / file
        if not path.exists() or (name and f"def {name}(" not in path.read_text()):
            missing.append(f"{file}::{name}")
    assert missing == []


def test_every_picture_names_its_script() -> None:
    """Every picture is on a page that names a script; whether that draws it is not tested."""
    pages = [page.read_text() for page in [*PAGES, ROOT / "README.md"]]
    for picture in DOCS.glob("*.png"):
        shown = [text for text in pages if picture.name in text]
        assert shown, picture
        for text in shown:
            assert re.search(
                r"(python (demos|benchmarks|verification)|`docs/scripts)/\w+\.py", text
            ), picture


def documented_names() -> list[str]:
    """Return the qualified names in the reference."""
    text = "".join(page.read_text() for page in PAGES if page.parent.name == "reference")
    return re.findall(r"^\.\. autoapi\w+:: (\S+)$", text, flags=re.MULTILINE)


def test_every_public_name_is_in_the_reference() -> None:
    """Public names of the package, and ``__all__`` of its public modules, are in the reference."""
    expected = []
    for public in set(fenics_contact.__all__) - {"__version__"}:
        value = getattr(fenics_contact, public)
        if isinstance(value, ModuleType):
            expected += [f"{value.__name__}.{each}" for each in value.__all__]
        else:
            expected.append(f"fenics_contact.{public}")
    assert sorted(documented_names()) == sorted(expected)
    assert "`fenics_contact.__version__`" in (DOCS / "reference" / "index.md").read_text()


# ---- texts ---------------------------------------------------------------------------------------


def raised_errors() -> dict[tuple[str, int], str]:
    """Return every ``raise`` of an error with arguments, by module and line."""
    errors = {}
    for path in messages.PACKAGE.rglob("*.py"):
        module = ".".join(path.relative_to(messages.PACKAGE).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
                errors[module, node.lineno] = ast.unparse(node.exc)
    return errors


def test_every_error_is_listed() -> None:
    """Every ``raise`` with its own text is listed; the others pass on a text from elsewhere."""
    listed = {(m.module, m.line) for m in messages.read() if m.kind not in ("warning", "log")}
    missing = [text for place, text in raised_errors().items() if place not in listed]
    assert sorted(missing) == [
        "NotConverged(number, reason, verdict, prefix=self.prefix)",
        "OSError(text)",
        "SystemExit(main())",
        "ValueError(f'{name}: {error}')",
        "self._not_converged(state, reason, verdict, increment.attempts)",
    ]
    assert len(listed) > 200


def test_every_condition_is_listed() -> None:
    """Every module with conditions has verdict texts, the known ones included."""
    verdicts = [m for m in messages.read() if m.kind == "verdict"]
    listed, texts = {m.module for m in verdicts}, [m.text for m in verdicts]
    for path in (messages.PACKAGE / "checks").glob("*.py"):
        if "Condition(" in path.read_text() and path.stem != "condition":
            assert f"checks.{path.stem}" in listed
    for words in ("residual of", "is ejected", "cells are inverted", "friction supplies energy"):
        assert any(words in text for text in texts), words
    for words in ("has crossed the obstacle", "small-displacement assumption", "a distance"):
        assert any(words in text for text in texts), words


def test_every_warning_is_listed() -> None:
    """Every module lists at least as many warnings as its source has calls that warn."""
    listed = Counter(m.module for m in messages.read() if m.kind == "warning")
    for path in messages.PACKAGE.rglob("*.py"):
        module = ".".join(path.relative_to(messages.PACKAGE).with_suffix("").parts)
        calls = re.findall(r"\b(?:logger\.(?:warning|critical)|warn)\($", path.read_text(), re.M)
        calls += re.findall(r"\blogger\.warning\((?=\S)", path.read_text())
        passed_on = 2 if module == "parallel" else 0  # `parallel.warn` itself
        assert listed[module] >= len(calls) - passed_on, module


def test_texts_are_assembled_from_the_source(tmp_path: Path) -> None:
    """Placeholders, pieces, alternatives, imported constants and log formats are resolved."""
    package = tmp_path / "package"
    package.mkdir()
    (package / "words.py").write_text('REMEDY = "remove it"\n')
    (package / "work.py").write_text(
        "from package.words import REMEDY\n"
        "def hint(x):\n    return f'is {x!r}'\n"
        "def work(x, many):\n"
        "    why = 'is small' if many else 'is large'\n"
        "    if x:\n        raise ValueError(f'{x} {why}; {REMEDY}')\n"
        "    logger.warning('%d of %s', x, many)\n"
        "    raise TypeError('it ' + hint(x))\n"
    )
    texts = [(m.line, m.kind, m.text) for m in messages.read(package)]
    assert texts == [
        (7, "ValueError", "… is large; remove it"),
        (7, "ValueError", "… is small; remove it"),
        (8, "warning", "… of …"),
        (9, "TypeError", "it is …"),
    ]


def test_tables_contain_every_text(tmp_path: Path) -> None:
    """Every message is a row of a Markdown table in a file that the page includes."""
    messages.write(tmp_path)
    page = (DOCS / "messages.md").read_text()
    pages_by_name = {file.name: file.read_text() for file in tmp_path.iterdir()}
    assert sorted(pages_by_name) == sorted(re.findall(r"\{include\} _generated/(\S+)", page))
    rows = [
        line
        for text in pages_by_name.values()
        for line in text.splitlines()
        if line.startswith("| ")
    ]
    plain = [re.sub(r"\\(.)", r"\1", row) for row in rows]
    for message in messages.read():
        assert any(row.startswith(f"| {message.text} |") for row in plain), message
    for why in ("did not converge: SNES reason …", "does not pass the verification: …"):
        assert any(why in row and "the forces have magnitude" in row for row in plain), why


@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own")
def test_documented_line_ends_all_ranks(tmp_path: Path) -> None:
    """With this line all ranks end if one raises, and its error is shown."""
    (line,) = re.findall(r"```text\n(.*?)```", (DOCS / "learn" / "parallel.md").read_text(), re.S)
    script = tmp_path / "script.py"
    script.write_text(
        f"import sys\nfrom mpi4py import MPI\n{line}"
        'if MPI.COMM_WORLD.rank == 1:\n    raise ValueError("on one rank")\n'
        "MPI.COMM_WORLD.Barrier()\n"
    )
    words = command(2, script)
    done = subprocess.run(
        words, env=subprocess_environment(), capture_output=True, text=True, timeout=60
    )
    assert done.returncode != 0 and "ValueError: on one rank" in done.stderr


# ---- scripts -------------------------------------------------------------------------------------


def _quoted(script: Path) -> list[str]:
    """Return the lines of output on the page of a script."""
    name = f"In full: `docs/scripts/{script.name}`"
    pages = [page.read_text() for page in PAGES if name in page.read_text()]
    blocks = [block for page in pages for block in re.findall(r"```text\n(.*?)```", page, re.S)]
    return [line for block in blocks for line in block.splitlines()]


def _words(line: str) -> str:
    """Return the beginning of a line of output, with its numbers replaced by #."""
    return re.sub(r"\d[\d.]*(e[-+]\d+)?", "#", re.split(r"[;(]", line)[0]).strip()


@pytest.mark.demo
@pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts processes of its own")
@pytest.mark.parametrize("path", SCRIPTS, ids=[path.stem for path in SCRIPTS])
def test_scripts_run(path: Path, tmp_path: Path) -> None:
    """Scripts exit with 0, print the lines of their page, and assert a number or write files."""
    for _ in range(2 if path.stem in ("log", "results") else 1):  # again, with existing files
        done = subprocess.run(
            [sys.executable, str(path)],
            cwd=tmp_path,
            env=subprocess_environment(),
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert done.returncode == 0, done.stdout + done.stderr
    printed = {_words(line) for line in done.stdout.splitlines()}
    assert [line for line in _quoted(path) if _words(line) not in printed] == []
    if path.stem != "results":
        assert "assert " in path.read_text()
        return
    written = {each.name for each in (tmp_path / "output").iterdir()}
    assert written >= {"body.pvd", "contact.pvd", "contact_points.pvd", "history.csv"}
    assert written >= {"pressure.png", "status.png", "deformation.png", "film.gif", "report.html"}
    assert len((tmp_path / "output" / "history.csv").read_text().splitlines()) >= 1 + 5
    assert "INFO:fenics_contact:static condensation onto" in done.stderr
    assert done.stdout.count("increment ") == 5


def test_every_method_is_described() -> None:
    """Every method is in choose.md, glance.md and the docstring of `ContactProblem`."""
    from fenics_contact.methods.solver import METHODS

    pages = [ROOT / "docs" / name for name in ("choose.md", "reference/glance.md")]
    texts = [page.read_text() for page in pages] + [fenics_contact.ContactProblem.__doc__ or ""]
    for name in METHODS:
        assert all(f'"{name}"' in text or f"`{name}`" in text for text in texts), name
