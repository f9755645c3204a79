"""Pytest configuration: collective teardown, deadlock timeout, cached forms and slow cases."""

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

# Assertions in `scenes` report the values that differ.
pytest.register_assert_rewrite("scenes")
# File descriptor for traces: the error stream that pytest does not capture.
_stderr = 2
# A rank that waits for another one inside C++ holds the interpreter lock, so that Python timeouts
# cannot act. The value is four times the duration of the longest test.
_DEADLOCK_SECONDS = 300
_found_by_ffcx = jit.get_cached_module
_forms: dict[Path, ModuleType] = {}


def pytest_configure() -> None:
    """Duplicate the error stream before it is captured; make FFCx load compiled forms by name."""
    global _stderr
    _stderr = os.dup(2)
    jit.get_cached_module = _form


def _form(name: str, objects: list[str], folder: Path, timeout: float) -> tuple[Any, Any]:
    """Load a compiled form once by its name, without listing the cache folder.

    FFCx lists the folder for each form, which takes half of the tests' time at ten thousand files.
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

    By default the first and the last case run, which differ in all parameters. With
    ``@pytest.mark.each`` few cases run that include every value of each parameter, with
    ``@pytest.mark.whole`` all cases. On several ranks only the last case runs. Cases on hexahedra,
    whose forms take longest to compile, are slow except in modules marked ``hexahedra``.
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
            retained = those[-1:]
        elif those[0].get_closest_marker("each"):
            retained = _each(those)
        else:
            retained = [those[0], those[-1]]
        for item in those:
            if item not in retained:
                item.add_marker(pytest.mark.slow)


def _each(cases: list[pytest.Item]) -> list[pytest.Item]:
    """Return cases that include every parameter value; those with only new values come first."""
    retained: list[pytest.Item] = []
    seen: set[tuple[str, str]] = set()
    for enough in (set.isdisjoint, lambda values, seen: not values <= seen):
        for item in cases:
            values = {(name, repr(value)) for name, value in item.callspec.params.items()}  # type: ignore[attr-defined]
            if enough(values, seen):
                retained.append(item)
                seen |= values
    return retained


def pytest_exception_interact(report: pytest.TestReport) -> None:
    """In parallel, print failures at once, since the end of the run may not be reached."""
    if MPI.COMM_WORLD.size > 1:
        text = f"\nrank {MPI.COMM_WORLD.rank}, {report.nodeid}:\n{report.longreprtext}\n"
        os.write(_stderr, text.encode())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Iterator[None]:
    """In parallel, end the run after a timeout, and print the traceback of every waiting rank."""
    if MPI.COMM_WORLD.size > 1:
        faulthandler.dump_traceback_later(_DEADLOCK_SECONDS, exit=True, file=_stderr)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Collect garbage on all ranks at once: destructors of PETSc and DOLFINx may be collective."""
    if MPI.COMM_WORLD.size > 1:
        gc.collect()
        MPI.COMM_WORLD.barrier()


def pytest_sessionstart() -> None:
    """In parallel, disable automatic garbage collection; teardown frees objects kept by errors."""
    if MPI.COMM_WORLD.size > 1:
        gc.disable()
