"""Where `docker/run` runs a command, and which environments it refuses with a message."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest
from mpi4py import MPI

from scenes.processes import ROOT, command, subprocess_environment

pytestmark = [
    pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts a process of its own"),
    pytest.mark.newest,
]

RUN = ROOT / "docker" / "run"

# Records its arguments.
DOCKER = """#!/bin/sh
echo "$@" >>"${0%/*}/requests"
[ "$1" != info ] || echo 99
[ "$1" != image ] || [ -z "$IMAGES_MISSING" ]
"""


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Return a function that calls docker/run with an engine that has every image, or none.

    The function returns the process, and the lines of its requests to that engine.
    """
    engine = tmp_path / "docker"
    engine.write_text(DOCKER)
    engine.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for name in ("FENICS_CONTACT_BASE", "FENICS_CONTACT_SUITE"):
        monkeypatch.delenv(name, raising=False)

    def call(**environment: str) -> tuple[subprocess.CompletedProcess[str], list[str]]:
        requests = tmp_path / "requests"
        requests.write_text("")
        command = [str(RUN), "echo", "here"]
        process = subprocess.run(
            command, env=os.environ | environment, capture_output=True, text=True, timeout=60
        )
        return process, requests.read_text().splitlines()

    return call


def test_command_runs_locally_if_dolfinx_is_installed(run) -> None:
    """Where DOLFINx is installed the command runs locally, without a request to the engine."""
    process, requests = run()
    assert (process.returncode, process.stdout, requests) == (0, "here\n", [])


def test_more_ranks_than_cores_start_without_warnings() -> None:
    """More ranks than cores start, and print nothing but their own output."""
    ranks = (os.cpu_count() or 1) + 1
    words = command(ranks, "-c", "print('here')")
    process = subprocess.run(
        words, env=subprocess_environment(), capture_output=True, text=True, timeout=60
    )
    assert (process.returncode, process.stdout, process.stderr) == (0, "here\n" * ranks, "")


@pytest.mark.whole
@pytest.mark.parametrize("suite", ["Debian 13", "../unstable", "-x"])
def test_bad_suite_is_refused(run, suite: str) -> None:
    process, requests = run(FENICS_CONTACT_SUITE=suite)
    assert process.returncode == 1 and requests == []
    assert f"FENICS_CONTACT_SUITE is '{suite}'; it must be a suite of Debian" in process.stderr


def test_suite_together_with_an_image_is_refused(run) -> None:
    process, requests = run(FENICS_CONTACT_SUITE="unstable", FENICS_CONTACT_BASE="debian:trixie")
    assert process.returncode == 1 and requests == []
    assert "both say what to start from: unset one" in process.stderr
