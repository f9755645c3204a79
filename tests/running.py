"""Runs a demo as its user runs it, in processes of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent


def environment() -> dict[str, str]:
    """What a new process gets: what mpirun left here would make another mpirun join it."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_COMM", "PMIX"))}
    return kept | {"PYTHONPATH": str(ROOT)}


def run_demo(name: str, folder: Path, *options: str, ranks: int = 1) -> dict[str, Any]:
    """Run ``demos/NAME.py``; it must end with 0 and stay silent on stderr. Its result.json."""
    command = [sys.executable, str(ROOT / "demos" / f"{name}.py"), *options]
    command += ["--output", str(folder)]
    if ranks > 1:
        command = ["mpirun", "--oversubscribe", "-n", str(ranks), *command]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "%|" not in done.stderr, "the progress bar must be silent when not on a terminal"
    return {"stdout": done.stdout} | json.loads(next(folder.glob("*.json")).read_text())
