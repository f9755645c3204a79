"""What this installation is made of: ``python -m fenics_contact info``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from mpi4py import MPI

from fenics_contact.installation import information

__all__ = ["main"]


def main(words: Sequence[str] | None = None) -> int:
    """Print it on the first rank, as the words of the command line say. Collective.

    Returns:
        0, for the shell.
    """
    parser = argparse.ArgumentParser(prog="python -m fenics_contact", description=__doc__)
    parser.add_argument(
        "command", choices=["info"], help="info: versions, solvers, what is missing"
    )
    parser.parse_args(words)
    found = information()
    if MPI.COMM_WORLD.rank == 0:
        width = max(map(len, found))
        print("\n".join(f"{name:<{width}}  {text}" for name, text in found.items()), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
