"""Run the benchmarks one after another, each in a new process, and write their page.

    OMP_NUM_THREADS=1 python benchmarks/run.py                     # all: 50 minutes
    OMP_NUM_THREADS=1 python benchmarks/run.py --short             # small problems
    OMP_NUM_THREADS=1 python benchmarks/run.py half_cylinder ball  # some; other results remain
    OMP_NUM_THREADS=1 python benchmarks/run.py --docs              # writes docs/benchmarks.md
    python benchmarks/run.py --page                                # page of stored results

Every script of this folder takes ``--output``, ``--repeat`` and ``--short``, and writes its CSV
files into its subfolder of the output folder. ``page.py`` writes the page there, README.md, with
the figures and the table of targets, from the results of this run and earlier ones. Forms are
compiled into a new cache, so that first runs include the compilation. The exit code is 1 if a
benchmark failed. ``methods.py``, ``nonlinear.py`` (five minutes each) and ``trade.py`` (ten
minutes) have their tables on other pages of docs/, and run by name only, as do
``bolted_joint.py``, which takes longer than ten minutes, ``random_scenes.py`` and ``selection.py``
(hours).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import page

HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"
HELPERS = ("__init__", "run", "page", "timing", "costs", "targets", "trade_page", "trade_scenes")
# Long, or described on another page of docs/.
BY_NAME_ONLY = ("bolted_joint", "methods", "nonlinear", "random_scenes", "selection", "trade")


def machine() -> str:
    """Return the name of the processor and the number of cores."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores"


def main() -> int:
    """Run the benchmarks and write the page."""
    names = sorted(path.stem for path in HERE.glob("*.py") if path.stem not in HELPERS)
    usual = [name for name in names if name not in BY_NAME_ONLY]
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("names", nargs="*", help=f"of {names}; default: all but {BY_NAME_ONLY}")
    parser.add_argument("--output", type=Path, default=Path("output/benchmarks"))
    parser.add_argument("--docs", action="store_true", help="output to docs/, page benchmarks.md")
    parser.add_argument("--page", action="store_true", help="only write docs/benchmarks.md")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--short", action="store_true", help="small problems")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.names) - set(names))
    if unknown:
        parser.error(f"unknown benchmarks {unknown}; known are {names}")
    output, target = arguments.output, arguments.output / "README.md"
    if arguments.docs or arguments.page:
        output, target = DOCS / "benchmarks", DOCS / "benchmarks.md"
    if arguments.page:
        page.write(output, target)
        return 0
    failed = []
    with tempfile.TemporaryDirectory() as cache:
        for name in arguments.names or usual:
            folder = output / name
            folder.mkdir(parents=True, exist_ok=True)
            for old in folder.iterdir():
                if old.suffix in (".md", ".png") or old.name == page.STAMP:
                    old.unlink()
            command = [sys.executable, str(HERE / f"{name}.py"), "--output", str(folder)]
            command += ["--repeat", str(arguments.repeat), *["--short"] * arguments.short]
            print(f"== {name}", flush=True)
            start, load = time.perf_counter(), os.getloadavg()[0]
            code = subprocess.run(command, env=os.environ | {"XDG_CACHE_HOME": cache}).returncode
            stamp = {
                "machine": machine(),
                "threads": os.environ.get("OMP_NUM_THREADS", "not set"),
                "date": time.strftime("%Y-%m-%d"),
                "seconds": round(time.perf_counter() - start),
                "load": load,
                "failed": code,
            }
            (folder / page.STAMP).write_text(json.dumps(stamp) + "\n")
            print(f"== {name}: {stamp['seconds']} s", flush=True)
            if code:
                failed.append(name)
            page.write(output, target)
    print(f"{target}; failed: {failed or 'none'}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
