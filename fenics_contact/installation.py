"""Versions and features of this installation: packages, MPI, solvers, compiler, cache."""

from __future__ import annotations

import importlib
import os
import platform
import shlex
import subprocess
import sysconfig
from importlib import metadata
from pathlib import Path

import dolfinx
import numpy as np
from dolfinx import jit
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact._version import __version__

__all__ = ["information"]

# Optional packages, and the consequence if one is missing.
_OPTIONAL = {
    "gmsh": "fc.model_to_mesh and the demos on meshes of gmsh do not run",
    "matplotlib": "no pictures: fc.plotting and the demos do not run",
    "tqdm": "the demos do not run, nor increments(progress=True)",
}
# Orderings of MUMPS by the value of ICNTL(7).
_ORDERINGS = {0: "AMD", 2: "AMF", 3: "SCOTCH", 4: "PORD", 5: "METIS", 6: "QAMD"}


def information(comm: MPI.Comm = MPI.COMM_WORLD) -> dict[str, str]:
    """Return versions and features by name, as determined in this process. Collective."""
    entries = {"fenics_contact": __version__, "Python": platform.python_version()}
    for name in ("ufl", "basix", "ffcx", "numpy", "scipy", "mpi4py", "petsc4py"):
        entries[name] = _version(name)
    entries["DOLFINx"] = dolfinx.__version__
    entries["PETSc"] = ".".join(map(str, PETSc.Sys.getVersion()))
    entries["scalars"] = np.dtype(PETSc.ScalarType).name
    entries["indices"] = np.dtype(PETSc.IntType).name
    hosts = len(set(comm.allgather(MPI.Get_processor_name())))
    library = MPI.Get_library_version().splitlines()[0].split(",")[0].rstrip("\0")
    entries["MPI"] = f"{' '.join(library.split())}; {comm.size} rank(s) on {hosts} machine(s)"
    entries["threads"] = "OMP_NUM_THREADS " + os.environ.get("OMP_NUM_THREADS", "is not set")
    entries["direct solver"] = _direct_solver()
    entries["BLAS"] = _blas()
    for name, effect in _OPTIONAL.items():
        entries[name] = _version(name, effect)
    entries["C compiler"] = comm.bcast(_compiler() if comm.rank == 0 else "")
    entries["compiled forms"] = _cache(Path(jit.get_options()["cache_dir"]))
    return entries


def _version(name: str, effect: str = "") -> str:
    """Return the version of a module, or why it cannot be imported."""
    try:
        module = importlib.import_module(name)
    except (ImportError, OSError) as error:  # OSError: gmsh without a system library
        return f"missing ({error}){': ' if effect else ''}{effect}"
    version = getattr(module, "__version__", None)
    if version is None:
        try:
            version = metadata.version({"ufl": "fenics-ufl", "ffcx": "fenics-ffcx"}.get(name, name))
        except metadata.PackageNotFoundError:
            version = "installed, of unknown version"
    return str(version)


def _direct_solver() -> str:
    """Return whether PETSc has MUMPS, and the orderings with which MUMPS was built."""
    if not PETSc.Sys.hasExternalPackage("mumps"):
        return 'no MUMPS: no static condensation, and linear_solver="direct" fails'
    available = [name for number, name in _ORDERINGS.items() if _used_ordering(number) == number]
    missing = [name for name in _ORDERINGS.values() if name not in available]
    return f"MUMPS, orderings {', '.join(available)}" + (
        f"; built without {', '.join(missing)}" if missing else ""
    )


def _used_ordering(requested: int) -> int:
    """Return the ordering INFOG(7) that MUMPS uses for a small matrix if ICNTL(7) requests one."""
    n = 20
    laplace_1d = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    laplace_2d = np.kron(laplace_1d, np.eye(n)) + np.kron(np.eye(n), laplace_1d)
    rows, columns = np.nonzero(laplace_2d)
    offsets = np.searchsorted(rows, np.arange(n * n + 1)).astype(PETSc.IntType)
    csr = offsets, columns.astype(PETSc.IntType), laplace_2d[rows, columns]
    matrix = PETSc.Mat().createAIJ((n * n, n * n), csr=csr, comm=PETSc.COMM_SELF)
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    pc.setType("lu")
    pc.setOperators(matrix)
    pc.setFactorSolverType("mumps")
    pc.setFactorSetUpSolverType()
    factor = pc.getFactorMatrix()
    factor.setMumpsIcntl(28, 1)  # sequential ordering, to which ICNTL(7) applies
    factor.setMumpsIcntl(7, requested)
    pc.setUp()
    used = int(factor.getMumpsInfog(7))
    pc.destroy()
    matrix.destroy()
    return used


def _blas() -> str:
    """Return the files of the BLAS libraries that this process has loaded."""
    try:
        maps = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return "unknown: this system has no list of loaded libraries (/proc/self/maps)"
    # NumPy and other packages may include a BLAS library of their own.
    paths = {line.split()[-1] for line in maps if ".so" in line}
    names = ("libblas", "openblas", "libmkl_core", "libblis", "libflexiblas")
    loaded = sorted(p for p in paths if any(word in Path(p).name.lower() for word in names))
    if not loaded:
        return "unknown: linked statically"
    is_reference = any("/blas/libblas.so" in path for path in loaded)
    effect = "; the reference BLAS: factorisations take up to eight times longer than with OpenBLAS"
    return ", ".join(loaded) + (effect if is_reference else "")


def _compiler() -> str:
    """Return the C compiler of forms, or why it cannot compile a file that includes Python.h."""
    command = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
    include = f"-I{sysconfig.get_path('include')}"
    try:
        subprocess.run(
            [*command, include, "-x", "c", "-c", "-", "-o", os.devnull],
            input="#include <Python.h>\n",
            text=True,
            capture_output=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError) as error:
        text = getattr(error, "stderr", None) or str(error)
        return (
            f"missing ({text.strip().splitlines()[0]}): new forms cannot be compiled; install a "
            "C compiler and the headers of C and Python (Debian: gcc libc6-dev python3-dev)"
        )
    return shlex.join(command)


def _cache(folder: Path) -> str:
    """Describe DOLFINx's cache of compiled forms: path, number of libraries, size."""
    if not folder.is_dir():
        return f"{folder} (not created yet)"
    forms = list(folder.glob("*.so"))
    size = sum(file.stat().st_size for file in forms) / 1e6
    effect = "" if os.access(folder, os.W_OK) else "; not writable: new forms cannot be compiled"
    return f"{folder} ({len(forms)} libraries, {size:.0f} MB){effect}"
