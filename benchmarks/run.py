"""All benchmarks, one after another, each in a process of its own.

    OMP_NUM_THREADS=1 python benchmarks/run.py                     # everything
    OMP_NUM_THREADS=1 python benchmarks/run.py --short             # small problems
    OMP_NUM_THREADS=1 python benchmarks/run.py half_cylinder ball  # some

Every script of this folder takes ``--output``, ``--repeat`` and ``--short`` and leaves tables
(``.md``), numbers (``.csv``) and plots (``.png``) in its part of the output folder; `README.md`
there joins the tables. Forms are compiled anew, into a cache of this run, so that "first use" is
what a new user waits. The exit code is 1 if a benchmark failed.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
HELPERS = ("run", "timing", "costs")


def main() -> int:
    """Run and join."""
    names = sorted(path.stem for path in HERE.glob("*.py") if path.stem not in HELPERS)
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("names", nargs="*", help=f"of {names}; by default all")
    parser.add_argument("--output", type=Path, default=Path("output/benchmarks"))
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--short", action="store_true", help="small problems")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.names) - set(names))
    if unknown:
        parser.error(f"there is no benchmark {unknown}; there are {names}")
    threads = os.environ.get("OMP_NUM_THREADS", "not set")
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    date = time.strftime("%Y-%m-%d")
    parts = [f"# Benchmarks\n\n{machine}, OMP_NUM_THREADS {threads}, {date}.\n"]
    failed = []
    with tempfile.TemporaryDirectory() as cache:
        for name in arguments.names or names:
            folder = arguments.output / name
            command = [sys.executable, str(HERE / f"{name}.py"), "--output", str(folder)]
            command += ["--repeat", str(arguments.repeat), *["--short"] * arguments.short]
            print(f"== {name}", flush=True)
            start = time.perf_counter()
            if subprocess.run(command, env=os.environ | {"XDG_CACHE_HOME": cache}).returncode:
                failed.append(name)
                parts.append(f"## {name} failed\n")
                continue
            print(f"== {name}: {time.perf_counter() - start:.0f} s", flush=True)
            parts += [path.read_text() for path in sorted(folder.glob("*.md"))]
            pictures = sorted(folder.glob("*.png"))
            parts += [f"![]({path.relative_to(arguments.output)})\n" for path in pictures]
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "README.md").write_text("\n".join(parts))
    print(f"{arguments.output / 'README.md'}; failed: {failed or 'none'}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
