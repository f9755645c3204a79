"""What `docker/run` refuses before it does anything, in words."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from mpi4py import MPI

RUN = Path(__file__).parents[1] / "docker" / "run"

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="starts a process of its own")


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
