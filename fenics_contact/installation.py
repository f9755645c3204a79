"""What this installation is made of: versions, MPI, solvers, and what is missing."""

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

# What is used besides the dependencies, and what does not work without it.
_OPTIONAL = {
    "gmsh": "fc.model_to_mesh and the demos on meshes of gmsh do not run",
    "matplotlib": "no pictures: fc.plotting and the demos do not run",
    "tqdm": "the demos do not run, nor increments(progress=True)",
}
# MUMPS' names of orderings, by its option ICNTL(7).
_ORDERINGS = {0: "AMD", 2: "AMF", 3: "SCOTCH", 4: "PORD", 5: "METIS", 6: "QAMD"}


def information(comm: MPI.Comm = MPI.COMM_WORLD) -> dict[str, str]:
    """What there is and what is missing, by name; measured, not looked up. Collective."""
    found = {"fenics_contact": __version__, "Python": platform.python_version()}
    for name in ("ufl", "basix", "ffcx", "numpy", "scipy", "mpi4py", "petsc4py"):
        found[name] = _version(name)
    found["DOLFINx"] = dolfinx.__version__
    found["PETSc"] = ".".join(map(str, PETSc.Sys.getVersion()))
    found["scalars"] = np.dtype(PETSc.ScalarType).name
    found["indices"] = np.dtype(PETSc.IntType).name
    hosts = len(set(comm.allgather(MPI.Get_processor_name())))
    library = MPI.Get_library_version().splitlines()[0].split(",")[0].rstrip("\0")
    found["MPI"] = f"{' '.join(library.split())}; {comm.size} rank(s) on {hosts} machine(s)"
    found["threads"] = "OMP_NUM_THREADS " + os.environ.get("OMP_NUM_THREADS", "is not set")
    found["direct solver"] = _direct_solver()
    found["BLAS"] = _blas()
    for name, cost in _OPTIONAL.items():
        found[name] = _version(name, cost)
    found["C compiler"] = comm.bcast(_compiler() if comm.rank == 0 else "")
    found["compiled forms"] = _cache(Path(jit.get_options()["cache_dir"]))
    return found


def _version(name: str, cost: str = "") -> str:
    """Of a module as it is imported, or why there is none."""
    try:
        module = importlib.import_module(name)
    except (ImportError, OSError) as error:  # gmsh: a library of the system is not there
        return f"missing ({error}){': ' if cost else ''}{cost}"
    told = getattr(module, "__version__", None)
    if told is None:
        try:
            told = metadata.version({"ufl": "fenics-ufl", "ffcx": "fenics-ffcx"}.get(name, name))
        except metadata.PackageNotFoundError:
            told = "there, of unknown version"
    return str(told)


def _direct_solver() -> str:
    """Whether MUMPS is there, and the orderings that it really uses when they are asked for."""
    if not PETSc.Sys.hasExternalPackage("mumps"):
        return 'no MUMPS: there is no condensation, and linear_solver="direct" fails'
    used = [name for number, name in _ORDERINGS.items() if _ordering(number) == number]
    lacking = [name for name in _ORDERINGS.values() if name not in used]
    return f"MUMPS, orderings {', '.join(used)}" + (
        f"; built without {', '.join(lacking)}" if lacking else ""
    )


def _ordering(wanted: int) -> int:
    """What MUMPS orders a small matrix by, INFOG(7), when ICNTL(7) asks for one."""
    n = 20
    line = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    square = np.kron(line, np.eye(n)) + np.kron(np.eye(n), line)
    rows, columns = np.nonzero(square)
    offsets = np.searchsorted(rows, np.arange(n * n + 1)).astype(PETSc.IntType)
    entries = offsets, columns.astype(PETSc.IntType), square[rows, columns]
    matrix = PETSc.Mat().createAIJ((n * n, n * n), csr=entries, comm=PETSc.COMM_SELF)
    pc = PETSc.PC().create(PETSc.COMM_SELF)
    pc.setType("lu")
    pc.setOperators(matrix)
    pc.setFactorSolverType("mumps")
    pc.setFactorSetUpSolverType()
    factor = pc.getFactorMatrix()
    factor.setMumpsIcntl(28, 1)  # in sequence: of the orderings above
    factor.setMumpsIcntl(7, wanted)
    pc.setUp()
    used = int(factor.getMumpsInfog(7))
    pc.destroy()
    matrix.destroy()
    return used


def _blas() -> str:
    """The library that this process has loaded, by its file."""
    try:
        maps = Path("/proc/self/maps").read_text().splitlines()
    except OSError:
        return "unknown: this system does not tell what is loaded"
    # NumPy and others may bring one of their own, within their packages.
    paths = {line.split()[-1] for line in maps if ".so" in line}
    names = ("libblas", "openblas", "libmkl_core", "libblis", "libflexiblas")
    loaded = sorted(p for p in paths if any(word in Path(p).name.lower() for word in names))
    if not loaded:
        return "unknown: linked statically"
    slow = any("/blas/libblas.so" in path for path in loaded)
    cost = "; the reference BLAS: factorisations take up to eight times longer than with OpenBLAS"
    return ", ".join(loaded) + (cost if slow else "")


def _compiler() -> str:
    """What forms are compiled by, tried on what they begin with: the header of Python."""
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
        told = getattr(error, "stderr", None) or str(error)
        return (
            f"missing ({told.strip().splitlines()[0]}): new forms cannot be compiled; it takes a "
            "C compiler and the headers of C and Python (Debian: gcc libc6-dev python3-dev)"
        )
    return shlex.join(command)


def _cache(folder: Path) -> str:
    """Where DOLFINx keeps compiled forms."""
    if not folder.is_dir():
        return f"{folder} (not made yet)"
    forms = list(folder.glob("*.so"))
    size = sum(file.stat().st_size for file in forms) / 1e6
    cost = "" if os.access(folder, os.W_OK) else "; not writable: new forms cannot be compiled"
    return f"{folder} ({len(forms)} libraries, {size:.0f} MB){cost}"
