"""Print the versions and features of this installation: ``python -m fenics_contact info``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from mpi4py import MPI

from fenics_contact.installation import information

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command of the command line and return the exit status 0. Collective."""
    parser = argparse.ArgumentParser(prog="python -m fenics_contact", description=__doc__)
    parser.add_argument(
        "command", choices=["info"], help="info: versions, solvers, missing packages"
    )
    parser.parse_args(arguments)
    entries = information()
    if MPI.COMM_WORLD.rank == 0:
        width = max(map(len, entries))
        print("\n".join(f"{name:<{width}}  {text}" for name, text in entries.items()), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
