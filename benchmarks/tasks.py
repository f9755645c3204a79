"""Five tasks as a new user has them, each script started in an empty folder: how long it takes.

A task is run as a process of its own, first with nothing in the caches (compiled forms, fonts of
Matplotlib), then again. Times are those of the processor, for the whole process and the compilers
that it starts: imports, meshing and pictures are in them, the start of a container is not. By the
clock of an idle machine they are up to half as much longer; on a busy one they stay much as they
are. Every script ends with an assertion of its result but the README's, which a test has.

    python benchmarks/tasks.py            # three minutes
    python benchmarks/tasks.py --short    # the README's script alone
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks import timing

ROOT = Path(__file__).resolve().parent.parent
# What a user wants, and the script that the documentation gives for it.
TASKS = {
    "the README's first script": "README.md",
    "a bracket from gmsh under a ball, drawn in space": "docs/scripts/bracket.py",
    "bodies that slide to and fro, with the loop": "docs/scripts/sliding.py",
    "a rubber seal": "docs/scripts/seal.py",
    "a law of one's own": "examples/own_law.py",
}


def script(place: str, folder: Path) -> Path:
    """Put a task's script into a folder, as a user does: copied, or out of the README."""
    source, made = ROOT / place, folder / "script.py"
    if source.suffix == ".md":
        (text,) = re.findall(r"```python\n(.*?)```", source.read_text(), flags=re.DOTALL)
        made.write_text(text)
    else:
        shutil.copy(source, made)
    return made


def used() -> float:
    """Seconds of the processor that ended children have taken so far."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def run(place: str, repeat: int) -> timing.Row:
    """Seconds of the first run and of later ones (the median), and the pictures that it draws.

    Raises:
        RuntimeError: The script fails; its output is shown.
    """
    seconds = []
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryDirectory() as cache:
        folder = Path(name)
        command = [sys.executable, str(script(place, folder))]
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        changed = {"XDG_CACHE_HOME": cache, "MPLCONFIGDIR": cache, "PYTHONPATH": path}
        for _ in range(1 + repeat):
            start = used()
            done = subprocess.run(
                command, cwd=folder, env=os.environ | changed, capture_output=True, text=True
            )
            seconds.append(used() - start)
            if done.returncode:
                raise RuntimeError(f"{place} ended with {done.returncode}: {done.stderr[-2000:]}")
        pictures = len(list(folder.rglob("*.png")))
    return {
        "first run [s]": seconds[0],
        "again [s]": statistics.median(seconds[1:]),
        "pictures": pictures,
    }


def main() -> None:
    """Run them one after another."""
    parser = timing.parser(__doc__, "tasks")
    arguments = parser.parse_args()
    tasks = dict(list(TASKS.items())[:1]) if arguments.short else TASKS
    rows = [
        {"task": task, "script": f"`{place}`"} | run(place, arguments.repeat)
        for task, place in tasks.items()
    ]
    timing.write(arguments.output, "tasks", "Five first scripts, from an empty folder", rows)


if __name__ == "__main__":
    main()
