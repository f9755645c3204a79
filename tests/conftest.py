"""Teardown that all ranks go through together, as in DOLFINx's own tests; an end to deadlocks."""

import faulthandler
import gc
import os
import zlib
from collections import defaultdict
from collections.abc import Iterator
from math import ceil

import pytest
from mpi4py import MPI

# Assertions of the scenes tell what differs, too.
pytest.register_assert_rewrite("scenes")
# Where traces go: the error stream as it is while pytest does not capture it.
_stderr = 2
# A rank that waits for another inside C++ holds the interpreter's lock, so that no other timeout
# gets to act. Four times the longest test.
_DEADLOCK_SECONDS = 300


def pytest_configure() -> None:
    """Keep the error stream."""
    global _stderr
    _stderr = os.dup(2)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Of the cases of a test, one in six is run each time, and the rest by ``pytest -m slow``.

    Which ones is drawn from their names, so that they lie anywhere among the products of what is
    varied, and are the same on all ranks and in all runs. Two at least; all of what is marked
    ``whole``. What runs on all kinds of cells is a long study on hexahedra, whose forms take the
    longest, except where cells and facets are found, and pairs made.
    """
    kept = ("test_surface", "test_pairs", "test_two_bodies", "test_present", "test_elasticity")
    kept += ("test_joined_meshes", "test_contact_pairs")
    cases = defaultdict(list)
    for item in items:
        values = getattr(item, "callspec", None)
        if values is None or item.get_closest_marker("whole"):
            continue
        if "hexahedron" in values.id.split("-") and item.path.stem not in kept:
            item.add_marker(pytest.mark.slow)
        elif not item.get_closest_marker("slow"):
            cases[item.nodeid.partition("[")[0]].append(item)
    for those in cases.values():
        those.sort(key=lambda item: zlib.crc32(item.nodeid.encode()))
        for item in those[max(2, ceil(len(those) / 6)) :]:
            item.add_marker(pytest.mark.slow)


def pytest_exception_interact(report: pytest.TestReport) -> None:
    """In parallel, show at once what failed: the end of the run may never come."""
    if MPI.COMM_WORLD.size > 1:
        text = f"\nrank {MPI.COMM_WORLD.rank}, {report.nodeid}:\n{report.longreprtext}\n"
        os.write(_stderr, text.encode())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Iterator[None]:
    """In parallel, show where every rank hangs and end the run, instead of waiting forever."""
    if MPI.COMM_WORLD.size > 1:
        faulthandler.dump_traceback_later(_DEADLOCK_SECONDS, exit=True, file=_stderr)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Destroy objects on all ranks at once: destructors of PETSc and DOLFINx may be collective."""
    gc.collect()
    MPI.COMM_WORLD.barrier()


def pytest_sessionstart() -> None:
    """In parallel, collect garbage between tests alone: what errors keep is freed there."""
    if MPI.COMM_WORLD.size > 1:
        gc.disable()
