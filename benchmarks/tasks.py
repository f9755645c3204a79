"""Measure the CPU time of five scripts of the documentation, each run in an empty folder.

Each script is run in a new process, first with empty caches (compiled forms, fonts of Matplotlib),
then again. CPU times include imports, compilers, meshing and figures, but not the start of a
container. Wall times on an idle machine are up to 50 % longer. All scripts but that of the README,
which has a test, end with an assertion of their result.

    python benchmarks/tasks.py            # three minutes
    python benchmarks/tasks.py --short    # the script of the README only
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
# Tasks, and the files of their scripts.
TASKS = {
    "first script of the README": "README.md",
    "bracket meshed with Gmsh under a ball, plots in 3D": "docs/scripts/bracket.py",
    "cyclic sliding with hysteresis loop": "docs/scripts/sliding.py",
    "rubber seal": "docs/scripts/seal.py",
    "user-defined law": "examples/own_law.py",
}


def copy_script(place: str, folder: Path) -> Path:
    """Copy the script of a task, or the code block of the README, into a folder."""
    source, made = ROOT / place, folder / "script.py"
    if source.suffix == ".md":
        (text,) = re.findall(r"```python\n(.*?)```", source.read_text(), flags=re.DOTALL)
        made.write_text(text)
    else:
        shutil.copy(source, made)
    return made


def processor_time() -> float:
    """Return the CPU time of terminated child processes so far (s)."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def run(place: str, repeat: int) -> timing.Row:
    """Return the seconds of the first run and of later ones (median), and the number of figures.

    Raises:
        RuntimeError: The script fails.
    """
    seconds = []
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryDirectory() as cache:
        folder = Path(name)
        command = [sys.executable, str(copy_script(place, folder))]
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        changed = {"XDG_CACHE_HOME": cache, "MPLCONFIGDIR": cache, "PYTHONPATH": path}
        for _ in range(1 + repeat):
            start = processor_time()
            done = subprocess.run(
                command, cwd=folder, env=os.environ | changed, capture_output=True, text=True
            )
            seconds.append(processor_time() - start)
            if done.returncode:
                raise RuntimeError(f"{place} ended with {done.returncode}: {done.stderr[-2000:]}")
        figures = len(list(folder.rglob("*.png")))
    return {
        "first run [s]": seconds[0],
        "later runs [s]": statistics.median(seconds[1:]),
        "figures": figures,
    }


def main() -> None:
    """Run the benchmark and write its results."""
    parser = timing.parser(__doc__, "tasks")
    arguments = parser.parse_args()
    tasks = dict(list(TASKS.items())[:1]) if arguments.short else TASKS
    rows = [
        {"task": task, "script": f"`{place}`"} | run(place, arguments.repeat)
        for task, place in tasks.items()
    ]
    title = "CPU time of five first scripts"
    timing.write(arguments.output, "tasks", title, rows)
    # Included by docs/expect.md.
    lines = [f"## {title}", "", *timing.table(rows)]
    (arguments.output / "tasks.md").write_text("\n".join(lines).rstrip() + "\n")


if __name__ == "__main__":
    main()
