"""Subprocesses that import this checkout and do not join the MPI ranks that start them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent


def subprocess_environment() -> dict[str, str]:
    """Return the environment of a subprocess, without the variables of a surrounding mpirun.

    Environment variables allow more ranks than cores with Open MPI 6, 5 and 4; an option of mpirun
    would be an error with MPICH.
    """
    variables = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_COMM", "PMIX"))}
    variables.setdefault("PRTE_MCA_mapby", ":oversubscribe")
    variables.setdefault("PRTE_MCA_rmaps_default_mapping_policy", ":oversubscribe")
    variables.setdefault("OMPI_MCA_rmaps_base_oversubscribe", "1")
    paths = [str(ROOT), *filter(None, [variables.get("PYTHONPATH")])]
    return variables | {"PYTHONPATH": os.pathsep.join(paths)}


def command(ranks: int, *arguments: object) -> list[str]:
    """Return the command that runs Python with these arguments on ``ranks`` ranks."""
    launch = ["mpirun", "-n", str(ranks)] if ranks > 1 else []
    return [*launch, sys.executable, *map(str, arguments)]


def run_json(ranks: int, *arguments: object, seconds: float | None = None) -> Any:
    """Run Python with these arguments on ``ranks`` ranks, and parse its last output line as JSON.

    Raises:
        subprocess.CalledProcessError: The process failed.
        subprocess.TimeoutExpired: The process took more than ``seconds`` and was terminated.
    """
    done = subprocess.run(
        command(ranks, *arguments),
        env=subprocess_environment(),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        timeout=seconds,
    )
    return json.loads(done.stdout.strip().splitlines()[-1])


def run_demo(name: str, folder: Path, *options: str, ranks: int = 1) -> dict[str, Any]:
    """Run ``demos/NAME.py``, and return its output and JSON result.

    The demo must end with 0, and must not print a progress bar to stderr.
    """
    arguments = command(ranks, ROOT / "demos" / f"{name}.py", *options, "--output", folder)
    done = subprocess.run(
        arguments, env=subprocess_environment(), capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "%|" not in done.stderr, "the progress bar must be silent when not on a terminal"
    return {"stdout": done.stdout} | json.loads(next(folder.glob("*.json")).read_text())


def reference_values(result: dict[str, Any]) -> dict[str, float]:
    """Return a demo's values of all quantities that have references."""
    return {name: entry["value"] for name, entry in result["references"].items()}
