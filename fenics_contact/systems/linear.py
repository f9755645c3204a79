"""How systems over all unknowns are solved: by factorisation or by multigrid, and what that takes.

A factorisation (MUMPS) solves anything, at a cost and memory that grow faster than the number of
unknowns: in three dimensions as n² and n^(4/3). Multigrid by smoothed aggregation (PETSc's GAMG),
told of the rigid motions that hardly any stiffness resists, costs and takes memory as n.

L-BFGS takes a single V-cycle for H₀: a linear map that does not change, as H₀ has to be. The pairs
learn what it leaves of the error, which a Krylov method inside would remove by more V-cycles than
L-BFGS has iterations (ball on a block, 15,000 unknowns: 65 V-cycles with Jacobi smoothing, against
95 by conjugate gradients to 1e-1 and 190 to 1e-2). Newton's method needs the Krylov method, to a
tolerance that follows the residual (Eisenstat and Walker).
"""

from __future__ import annotations

import functools
import logging
import os
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from fenics_contact.parallel import broadcast_from_root, global_max, global_min, global_sum
from fenics_contact.systems.modes import rigid_motions

__all__ = [
    "KINDS",
    "cube_size",
    "factor_bytes",
    "forget_failure",
    "memory",
    "near_nullspace",
    "newton_options",
    "options",
    "quasi_newton_options",
    "quicker",
    "refused_memory",
    "too_large",
    "warn_of_slow_blas",
]

logger = logging.getLogger("fenics_contact")

KINDS = ("direct", "multigrid")

# Bytes of MUMPS' Cholesky factor, measured from 12,000 to 463,000 unknowns on cubes and squares,
# P1 and P2: 230 n^(4/3) in three dimensions and 75 n log₂ n in two; an LU factor has 1.8 of it.
_FACTOR = {2: 75.0, 3: 230.0}
_LU = 1.8
# A factor, with all else that is kept, may take this share of the memory.
_SHARE = 0.5
# From this many unknowns of a cube on multigrid is quicker, in three dimensions; in two MUMPS
# always is.
_MANY = 30_000
# One factorisation for a whole load history pays longer: condensed onto Γc, it takes as long as two
# increments by multigrid at 108,000 unknowns, and as long as four at 200,000.
_MANY_PER_INCREMENT = 50_000

# MUMPS' errors INFOG(1) for workspace that is too small, or memory that was not to be had.
_NO_MEMORY = (-5, -7, -8, -9, -11, -13, -14, -15, -17, -18, -19, -20)

_MULTIGRID: dict[str, Any] = {
    "pc_type": "gamg",
    # Dirichlet rows and what they cut off are no neighbours to be aggregated with.
    "pc_gamg_threshold": 0.0,
    "mg_levels_pc_type": "sor",
    # For those who name `-pc_type hypre`: quicker to set up, slower on slender bodies.
    "pc_hypre_boomeramg_strong_threshold": 0.7,
}
# A set-up costs as much as ten V-cycles, and contact changes few rows: one serves four iterations.
_NEWTON: dict[str, Any] = {
    "snes_ksp_ew": True,
    "snes_ksp_ew_rtol0": 1e-2,
    "snes_ksp_ew_rtolmax": 1e-2,
    "snes_lag_preconditioner": 4,
}
# SNES leaves it to `Hierarchy`, after the first time.
_QUASI_NEWTON: dict[str, Any] = {"snes_lag_preconditioner": -2}


def options(kind: str, *, symmetric: bool, accurate: bool) -> dict[str, Any]:
    """Options of a linear solver.

    Args:
        kind: One of `KINDS`.
        symmetric: Whether the matrix is.
        accurate: Whether it is to solve systems, or to be the fixed map H₀ of L-BFGS.
    """
    if kind == "direct":
        return {
            "ksp_type": "preonly",
            "pc_type": "cholesky" if symmetric else "lu",
            "pc_factor_mat_solver_type": "mumps",
            # On several ranks MUMPS distributes work as it goes, and may want more than it thought.
            "mat_mumps_icntl_14": 100,
        }
    if not accurate:
        return {"ksp_type": "preonly"} | _MULTIGRID
    found = {"ksp_rtol": 1e-6, "ksp_max_it": 500, "ksp_norm_type": "unpreconditioned"} | _MULTIGRID
    if symmetric:
        return found | {"ksp_type": "cg"}
    return found | {"ksp_type": "gmres", "ksp_pc_side": "right", "ksp_gmres_restart": 60}


def quasi_newton_options(kind: str) -> dict[str, Any]:
    """Options of L-BFGS: when SNES sets up H₀."""
    return dict(_QUASI_NEWTON) if kind == "multigrid" else {}


def newton_options(kind: str) -> dict[str, Any]:
    """Options of Newton's method: how well its linear systems are solved."""
    return dict(_NEWTON) if kind == "multigrid" else {}


def factor_bytes(n: int, dimension: int, *, symmetric: bool) -> float:
    """Memory that MUMPS needs for a factor of a stiffness over n unknowns, estimated (bytes)."""
    growth = n ** (4 / 3) if dimension == 3 else n * np.log2(max(n, 2))
    return float(_FACTOR[dimension] * growth * (1.0 if symmetric else _LU))


def memory(comm: MPI.Comm) -> float:
    """Memory of the machines that the ranks run on, or what they may use of it. Collective."""
    size = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for name in ("memory.max", "memory/memory.limit_in_bytes"):  # of a container, cgroups v2, v1
        try:
            size = min(size, float((Path("/sys/fs/cgroup") / name).read_text()))
        except (OSError, ValueError):
            continue  # there is none, or it is "max"
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    share = size / node.size
    node.Free()
    return float(comm.allreduce(share))


def too_large(n_bytes: float, comm: MPI.Comm) -> str | None:
    """Why factors of this size are not to be made; None if they may. Collective."""
    available = memory(comm)
    if n_bytes <= _SHARE * available:
        return None
    return (
        f"its factorisation would take about {n_bytes / 2**30:.1f} of {available / 2**30:.1f} GiB "
        "of memory"
    )


def refused_memory(pc: PETSc.PC) -> bool:
    """Whether a factorisation failed because it did not get its memory."""
    if not pc.getFailedReason():
        return False
    if pc.getFailedReason() == PETSc.PC.FailedReason.FACTOR_OUTMEMORY:
        return True
    mumps = pc.getType() in ("lu", "cholesky") and pc.getFactorSolverType() == "mumps"
    # PETSc has no reason of its own for some of MUMPS' errors.
    return mumps and pc.getFactorMatrix().getMumpsInfog(1) in _NO_MEMORY


def forget_failure(pc: PETSc.PC) -> None:
    """Let the next matrix be factored anew where a factorisation has failed. Collective.

    PETSc would take MUMPS' failure for that of all matrices to come, and solve with no factors.
    """
    if pc.getFailedReason() and pc.getType() in ("lu", "cholesky"):
        operators = pc.getOperators()
        pc.reset()
        pc.setOperators(*operators)


@functools.cache
def warn_of_slow_blas() -> None:
    """Log once if the process runs on the reference BLAS, as Debian's packages do by default."""
    try:
        libraries = Path("/proc/self/maps").read_text()
    except OSError:
        return  # no Linux: nothing to tell from
    if "/blas/libblas.so" in libraries:
        logger.warning(
            "the reference BLAS is in use: factorisations take up to eight times as long as with "
            "OpenBLAS; install it (Debian: apt install libopenblas0-pthread)"
        )


def quicker(n: float, dimension: int, *, condensed_for: int = 0) -> bool:
    """Whether multigrid is quicker than factorisations, by measured cost.

    Plates under a bolt (`scenes/bolted_joint.py`, three bodies, quadratic), one Cholesky
    factorisation by MUMPS over a solution by conjugate gradients with GAMG: 0.30 at 33,000
    unknowns, 0.41 at 55,000, 0.60 at 107,000 and 1.02 at 190,000, whose `cube_size` is 29,000.

    Args:
        n: Number of unknowns in the plane, their `cube_size` in space.
        dimension: Of the mesh.
        condensed_for: The increments that one factorisation serves; 0: it serves none alone.
    """
    return dimension == 3 and n > max(_MANY, condensed_for * _MANY_PER_INCREMENT)


def cube_size(space: fem.FunctionSpace, body: npt.NDArray[np.intp]) -> float:
    """Unknowns of a cube that takes as many operations for each of them to factor. Collective.

    A factorisation takes n w² operations if w unknowns lie in a cross-section of a body, and
    multigrid some n. In a cube w is n^(2/3). A body longer than it is wide and high, by s to the
    mean of both, has as many in its cross-sections as a cube of n / s; and of several bodies, which
    contact ties together at their sides alone, the mean of w² counts. Turning it changes nothing.

    Args:
        space: Of the displacement, in space; of its nodes s is told: 1 of a cube, a/√(b c) of a box
            a, b, c with even cells.
        body: That of each node, ghosts included.
    """
    comm, dofmap = space.mesh.comm, space.dofmap
    n_owned, n = dofmap.index_map.size_local, dofmap.index_map.size_global
    x, body = space.tabulate_dof_coordinates()[:n_owned], body[:n_owned]
    # About a place within the mesh, however far that is from the origin.
    x = x - global_sum(comm, x.sum(axis=0)) / n
    n_bodies = 1 + int(global_max(comm, body.astype(np.float64)))
    moments = np.zeros((n_bodies, 4, 4))  # of 1 and x, their products summed up
    np.add.at(moments, body, np.einsum("pi,pj->pij", *[np.insert(x, 0, 1.0, axis=1)] * 2))
    work = 0.0
    for moment in broadcast_from_root(comm, global_sum(comm, moments)):
        count, first = moment[0, 0], moment[0, 1:]
        spread = np.linalg.eigvalsh(moment[1:, 1:] - np.outer(first, first) / count)
        slender = np.sqrt(spread[2] / np.sqrt(spread[0] * spread[1]))
        work += count * (count / slender) ** (4 / 3)
    return float(dofmap.bs * (work / n) ** (3 / 4))


def near_nullspace(space: fem.FunctionSpace) -> PETSc.NullSpace:
    """The rigid motions at the nodes, orthonormal: what the coarse levels must have. Collective.

    Those of all bodies together: within an aggregate of few nodes they are the motions of each.
    """
    mesh, dofmap = space.mesh, space.dofmap
    comm, gdim = mesh.comm, mesh.geometry.dim
    x = space.tabulate_dof_coordinates()[: dofmap.index_map.size_local, :gdim]
    low = np.array([global_min(comm, column) for column in x.T])
    high = np.array([global_max(comm, column) for column in x.T])
    motions = rigid_motions(x - (low + high) / 2, float(np.linalg.norm(high - low)))
    modes = np.array([motion.ravel() for motion in motions.values()])
    factor = broadcast_from_root(comm, np.linalg.cholesky(global_sum(comm, modes @ modes.T)))
    modes = np.linalg.solve(factor, modes)
    vectors = []
    for mode in modes:
        vector = PETSc.Vec().createMPI((mode.size, None), bsize=gdim, comm=comm)
        vector.array[:] = mode
        vectors.append(vector)
    return PETSc.NullSpace().create(vectors=vectors, comm=comm)
