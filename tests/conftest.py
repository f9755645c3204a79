"""Teardown that all ranks go through together, as in DOLFINx's own tests; an end to deadlocks."""

import faulthandler
import gc
import os
from collections import defaultdict
from collections.abc import Iterator
from importlib.machinery import EXTENSION_SUFFIXES
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from ffcx.codegeneration import jit
from mpi4py import MPI

# Assertions of the scenes tell what differs, too.
pytest.register_assert_rewrite("scenes")
# Where traces go: the error stream as it is while pytest does not capture it.
_stderr = 2
# A rank that waits for another inside C++ holds the interpreter's lock, so that no other timeout
# gets to act. Four times the longest test.
_DEADLOCK_SECONDS = 300
_found_by_ffcx = jit.get_cached_module
_forms: dict[Path, ModuleType] = {}


def pytest_configure() -> None:
    """Keep the error stream; load compiled forms by name."""
    global _stderr
    _stderr = os.dup(2)
    jit.get_cached_module = _form


def _form(name: str, objects: list[str], folder: Path, timeout: float) -> tuple[Any, Any]:
    """A compiled form, loaded once by its name, without a list of the folder of all of them.

    FFCx lists it for each form that is made: of ten thousand files that is half of the tests' time.
    """
    path = Path(folder) / f"{name}{EXTENSION_SUFFIXES[0]}"
    if path not in _forms:
        spec = spec_from_file_location(name, path)
        if not path.with_name(f"{name}.c.cached").exists() or spec is None or spec.loader is None:
            return _found_by_ffcx(name, objects, folder, timeout)
        _forms[path] = module_from_spec(spec)
        spec.loader.exec_module(_forms[path])
    return [getattr(_forms[path].lib, each) for each in objects], _forms[path]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the cases of parametrized tests that do not run by default as slow.

    The first and the last case run, which differ in all parameters; with ``@pytest.mark.each``
    every value of each parameter, in as few cases; with ``@pytest.mark.whole`` all. On several
    ranks the last case runs. What runs on all kinds of cells is slow on hexahedra, whose forms take
    longest to compile, except in modules marked ``hexahedra``.
    """
    cases = defaultdict(list)
    for item in items:
        values = getattr(item, "callspec", None)
        if values is None or (item.get_closest_marker("whole") and MPI.COMM_WORLD.size == 1):
            continue
        if "hexahedron" in values.id.split("-") and not item.get_closest_marker("hexahedra"):
            item.add_marker(pytest.mark.slow)
        elif not item.get_closest_marker("slow"):
            cases[item.nodeid.partition("[")[0]].append(item)
    for those in cases.values():
        if MPI.COMM_WORLD.size > 1:
            kept = those[-1:]
        elif those[0].get_closest_marker("each"):
            kept = _each(those)
        else:
            kept = [those[0], those[-1]]
        for item in those:
            if item not in kept:
                item.add_marker(pytest.mark.slow)


def _each(cases: list[pytest.Item]) -> list[pytest.Item]:
    """First the cases of which no value has been seen, then those of which not all have been."""
    kept: list[pytest.Item] = []
    seen: set[tuple[str, str]] = set()
    for enough in (set.isdisjoint, lambda values, seen: not values <= seen):
        for item in cases:
            values = {(name, repr(value)) for name, value in item.callspec.params.items()}  # type: ignore[attr-defined]
            if enough(values, seen):
                kept.append(item)
                seen |= values
    return kept


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
    if MPI.COMM_WORLD.size > 1:
        gc.collect()
        MPI.COMM_WORLD.barrier()


def pytest_sessionstart() -> None:
    """In parallel, collect garbage between tests alone: what errors keep is freed there."""
    if MPI.COMM_WORLD.size > 1:
        gc.disable()
