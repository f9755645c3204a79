"""All benchmarks, one after another, each in a process of its own, and what they are to meet.

    OMP_NUM_THREADS=1 python benchmarks/run.py                     # everything: 50 minutes
    OMP_NUM_THREADS=1 python benchmarks/run.py --short             # small problems
    OMP_NUM_THREADS=1 python benchmarks/run.py half_cylinder ball  # some; the others' parts stay
    OMP_NUM_THREADS=1 python benchmarks/run.py --docs              # into docs/benchmarks.md

Every script of this folder takes ``--output``, ``--repeat`` and ``--short`` and leaves tables
(``.md``), numbers (``.csv``) and plots (``.png``) in its part of the output folder. The page there,
`README.md`, joins the parts of this run and of earlier ones, below the table of targets. Forms are
compiled anew, into a cache of this run, so that "first use" is what a new user waits. The exit code
is 1 if a benchmark failed. ``methods.py``, ``nonlinear.py`` (five minutes each) and ``trade.py``
(ten minutes) have their tables on other pages of docs/ and are run when they are named, or by their
own commands; so is ``bolted_joint.py``, which takes longer than ten minutes.
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

from benchmarks import targets, timing

HERE = Path(__file__).parent
DOCS = HERE.parent / "docs"
HELPERS = ("__init__", "run", "timing", "costs", "targets", "trade_page", "trade_scenes")
# Long, and all but the first with pages of their own in docs/.
BY_NAME_ONLY = ("bolted_joint", "methods", "nonlinear", "trade")
STAMP = "stamp.json"


def page(folder: Path, names: list[str], root: Path) -> str:
    """The page: targets, then what every benchmark left in its part of a folder.

    Args:
        folder: The output, a folder for each benchmark.
        names: Of the benchmarks, in order.
        root: Where the page will be, for its links.
    """
    parts = ["# Benchmarks", "", "`python benchmarks/run.py` makes this page.", ""]
    met = targets.table(folder)
    timing.save(folder / "targets.csv", met)
    parts += ["## Targets", "", *timing.table(met), ""]
    for name in names:
        here = folder / name
        if not (here / STAMP).exists():
            continue
        stamp = json.loads((here / STAMP).read_text())
        parts.append(f"## {name}\n")
        told = "{machine}, OMP_NUM_THREADS {threads}, {date}, load {load:.1f}; {seconds} s in all"
        parts.append(told.format(**stamp) + ".\n")
        if stamp["failed"]:
            parts.append(f"It failed with exit code {stamp['failed']}.\n")
            continue
        # The scripts' own headings are of the second level.
        parts += [f"#{path.read_text()}" for path in sorted(here.glob("*.md"))]
        parts += [f"![]({path.relative_to(root)})\n" for path in sorted(here.glob("*.png"))]
    return "\n".join(parts)


def machine() -> str:
    """Name of the processor, and cores."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores"


def main() -> int:
    """Run and join."""
    names = sorted(path.stem for path in HERE.glob("*.py") if path.stem not in HELPERS)
    usual = [name for name in names if name not in BY_NAME_ONLY]
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("names", nargs="*", help=f"of {names}; by default all but {BY_NAME_ONLY}")
    parser.add_argument("--output", type=Path, default=Path("output/benchmarks"))
    parser.add_argument("--docs", action="store_true", help="output to docs/, page benchmarks.md")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--short", action="store_true", help="small problems")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.names) - set(names))
    if unknown:
        parser.error(f"there is no benchmark {unknown}; there are {names}")
    output, target = arguments.output, arguments.output / "README.md"
    if arguments.docs:
        output, target = DOCS / "benchmarks", DOCS / "benchmarks.md"
    failed = []
    with tempfile.TemporaryDirectory() as cache:
        for name in arguments.names or usual:
            folder = output / name
            folder.mkdir(parents=True, exist_ok=True)
            for old in folder.iterdir():
                if old.suffix in (".md", ".png") or old.name == STAMP:
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
            (folder / STAMP).write_text(json.dumps(stamp) + "\n")
            print(f"== {name}: {stamp['seconds']} s", flush=True)
            if code:
                failed.append(name)
            # After each, so that what is done stays when the next is interrupted.
            target.write_text(page(output, names, target.parent))
    print(f"{target}; failed: {failed or 'none'}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
