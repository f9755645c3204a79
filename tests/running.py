"""Runs a demo as its user runs it, in processes of its own."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

from scenes.processes import ROOT, command, environment


def run_demo(name: str, folder: Path, *options: str, ranks: int = 1) -> dict[str, Any]:
    """Run ``demos/NAME.py``; it must end with 0 and stay silent on stderr. Its result.json."""
    words = command(ranks, ROOT / "demos" / f"{name}.py", *options, "--output", folder)
    done = subprocess.run(words, env=environment(), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "%|" not in done.stderr, "the progress bar must be silent when not on a terminal"
    return {"stdout": done.stdout} | json.loads(next(folder.glob("*.json")).read_text())


def values(result: dict[str, Any]) -> dict[str, float]:
    """What a demo found of all that it has references for."""
    return {name: entry["value"] for name, entry in result["references"].items()}
