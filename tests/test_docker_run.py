"""Where `docker/run` runs a command, and what it refuses before it does anything, in words."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import ROOT, command, environment

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts a process of its own")

RUN = ROOT / "docker" / "run"

# Notes what it is asked for.
DOCKER = """#!/bin/sh
echo "$@" >>"${0%/*}/asked"
[ "$1" != info ] || echo 99
[ "$1" != image ] || [ -z "$IMAGES_MISSING" ]
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Call docker/run in a given environment, with an engine that has every image, or none.

    Gives the process, and what it asked that engine for, line by line.
    """
    engine = tmp_path / "docker"
    engine.write_text(DOCKER)
    engine.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("FENICS_CONTACT_BASE", "FENICS_CONTACT_SUITE"):
        monkeypatch.delenv(name, raising=False)

    def call(**environment: str) -> tuple[subprocess.CompletedProcess[str], list[str]]:
        asked = tmp_path / "asked"
        asked.write_text("")
        command = [str(RUN), "echo", "here"]
        process = subprocess.run(
            command, env=os.environ | environment, capture_output=True, text=True, timeout=60
        )
        return process, asked.read_text().splitlines()

    return call


def test_a_command_runs_here_where_dolfinx_is(run) -> None:
    """As it is where the tests run: its own output, and no engine is asked for anything."""
    process, asked = run()
    assert (process.returncode, process.stdout, asked) == (0, "here\n", [])


def test_dolfinx_under_another_name_is_found(run, tmp_path: Path) -> None:
    """Wheels by others are called otherwise; what counts then is the module itself."""
    (tmp_path / "sitecustomize.py").write_text(
        "from importlib import metadata\n"
        "found, asked = metadata.version, []\n"
        "def version(name):\n"  # DOLFINx may ask for itself after that
        "    asked.append(name)\n"
        "    others = asked == ['fenics-dolfinx']\n"
        "    return found(name + '-of-others' * others)\n"
        "metadata.version = version\n"
    )
    process, asked = run(PYTHONPATH=f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    assert (process.returncode, process.stdout, asked) == (0, "here\n", [])


def test_more_ranks_than_cores_start_without_a_word() -> None:
    """Neither refused, nor with a warning of old names: all that is printed is what they print."""
    ranks = (os.cpu_count() or 1) + 1
    words = command(ranks, "-c", "print('here')")
    process = subprocess.run(words, env=environment(), capture_output=True, text=True, timeout=60)
    assert (process.returncode, process.stdout, process.stderr) == (0, "here\n" * ranks, "")


def test_a_suite_has_a_container_and_an_image_of_its_own(run) -> None:
    """Although DOLFINx is here. The command comes last, and a script in there finds DOLFINx."""
    images = set()
    for suite in ("unstable", "forky"):
        process, asked = run(FENICS_CONTACT_SUITE=suite, FENICS_CONTACT_OTHER="1")
        assert process.returncode == 0
        words = asked[-1].split()
        assert words[0] == "run" and words[-2:] == ["echo", "here"]
        assert "--env=FENICS_CONTACT_OTHER" in words
        assert "--env=FENICS_CONTACT_SUITE" not in words
        images.add(words[-3])
    assert len(images) == 2


def test_the_image_of_a_suite_is_of_what_is_there_when_it_is_built(run) -> None:
    """The engine must not take what it remembers of an earlier day's packages."""
    process, asked = run(FENICS_CONTACT_SUITE="unstable", IMAGES_MISSING="all")
    assert process.returncode == 0, process.stderr
    build = next(line for line in asked if line.startswith("build ")).split()
    assert "--no-cache" in build
    assert "--build-arg=BASE=docker.io/library/debian:unstable-slim" in build


@pytest.mark.whole
@pytest.mark.parametrize("suite", ["Debian 13", "../unstable", "-x"])
def test_what_is_no_suite_is_refused(run, suite: str) -> None:
    process, asked = run(FENICS_CONTACT_SUITE=suite)
    assert process.returncode == 1 and asked == []
    assert f"FENICS_CONTACT_SUITE is '{suite}'; it must be a suite of Debian" in process.stderr


def test_a_suite_and_an_image_at_once_are_refused(run) -> None:
    process, asked = run(FENICS_CONTACT_SUITE="unstable", FENICS_CONTACT_BASE="debian:trixie")
    assert process.returncode == 1 and asked == []
    assert "both say what to start from: unset one" in process.stderr


def refusal(run: Path, tools: Path, **environment: str) -> str:
    """What it says where python3 has no DOLFINx, and ends with."""
    tools.mkdir()
    python = tools / "python3"
    python.write_text("#!/bin/sh\nexit 1\n")
    python.chmod(0o755)
    path = f"{tools}:{os.environ['PATH']}"
    given = os.environ | {"PATH": path} | environment
    done = subprocess.run(
        ["bash", str(run), "true"], env=given, cwd=tools, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 1 and done.stdout == ""
    assert done.stderr.count("\n") == 1
    return done.stderr


def test_a_cache_that_is_no_absolute_path(tmp_path: Path) -> None:
    """A relative one would be another folder in every folder that it is called from."""
    said = refusal(RUN, tmp_path / "tools", XDG_CACHE_HOME="cache")
    assert "XDG_CACHE_HOME is 'cache'; it must be an absolute path" in said
    assert not (tmp_path / "tools" / "cache").exists()


@pytest.mark.parametrize("place", ["checkout", "cache"])
def test_a_colon_in_a_path(place: str, tmp_path: Path) -> None:
    """The engines would take what follows it for another folder."""
    folder = tmp_path / "a:b"
    run = RUN
    cache = tmp_path if place == "checkout" else folder
    if place == "checkout":
        shutil.copytree(RUN.parent, folder / "docker")
        run = folder / "docker" / "run"
    said = refusal(run, tmp_path / "tools", XDG_CACHE_HOME=str(cache))
    assert f"there is a colon in '{folder}" in said
