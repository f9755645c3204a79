"""Solvers for systems over all unknowns: factorisation or multigrid, their memory and cost.

A factorisation by MUMPS is robust; in three dimensions its cost grows as n² and its memory as
n^(4/3). Both grow as n for smoothed aggregation (PETSc's GAMG) with the rigid-body modes as near
nullspace.

L-BFGS takes one V-cycle as its fixed H₀. The error that it leaves is reduced by the pairs; a Krylov
method inside would cost more V-cycles (ball on a block, 15,000 unknowns: 65 V-cycles, against 95 by
conjugate gradients to 1e-1 and 190 to 1e-2). Newton's method needs the Krylov method, with a
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
    "describe_memory_excess",
    "factor_bytes",
    "find_available_memory",
    "is_multigrid_faster",
    "is_out_of_memory",
    "near_nullspace",
    "newton_options",
    "options",
    "quasi_newton_options",
    "reset_failed_factorisation",
    "warn_of_slow_blas",
]

logger = logging.getLogger("fenics_contact")

KINDS = ("direct", "multigrid")

# Bytes of MUMPS' Cholesky factor over n^(4/3) in three dimensions and n log₂ n in two, measured
# from 12,000 to 463,000 unknowns on cubes and squares, P1 and P2; ratio of an LU factor to it.
_FACTOR_BYTES = {2: 75.0, 3: 230.0}
_LU_RATIO = 1.8
# Largest estimated factor relative to the memory.
_MAX_MEMORY_RATIO = 0.5
# `cube_size` from which multigrid is faster in three dimensions; in two MUMPS always is.
_MULTIGRID_SIZE = 12_000
# The same per increment if one factorisation condenses for all. Time of multigrid for an increment
# by that of condensing a block under a ball: 1.4 for 41,000 unknowns of equal cells, 0.8 for
# 108,000; 0.5 for 29,000 of gmsh cells graded 1:6, whose `cube_size` is 42,000.
_SIZE_PER_INCREMENT = 40_000
# Half the thickness of the layer in which `cube_size` counts cells, by the standard deviation of
# the nodes.
_LAYER_RATIO = 0.2

# MUMPS' errors INFOG(1) for insufficient workspace or memory.
_MEMORY_ERRORS = (-5, -7, -8, -9, -11, -13, -14, -15, -17, -18, -19, -20)

_GAMG_OPTIONS: dict[str, Any] = {
    "pc_type": "gamg",
    # Do not aggregate across Dirichlet rows.
    "pc_gamg_threshold": 0.0,
    "mg_levels_pc_type": "sor",
    # For `-pc_type hypre`: faster to set up, slower on slender bodies.
    "pc_hypre_boomeramg_strong_threshold": 0.7,
}
# A set-up costs ten V-cycles, and contact changes few rows: one serves four iterations.
_NEWTON_OPTIONS: dict[str, Any] = {
    "snes_ksp_ew": True,
    "snes_ksp_ew_rtol0": 1e-2,
    "snes_ksp_ew_rtolmax": 1e-2,
    "snes_lag_preconditioner": 4,
}
# After the first set-up `Hierarchy` updates the preconditioner.
_LBFGS_OPTIONS: dict[str, Any] = {"snes_lag_preconditioner": -2}


def options(kind: str, *, symmetric: bool, accurate: bool) -> dict[str, Any]:
    """Return the options of a linear solver.

    Args:
        kind: One of `KINDS`.
        symmetric: Whether the matrix is symmetric.
        accurate: Whether to solve systems accurately; otherwise it is the fixed map H₀ of L-BFGS.
    """
    if kind == "direct":
        return {
            "ksp_type": "preonly",
            "pc_type": "cholesky" if symmetric else "lu",
            "pc_factor_mat_solver_type": "mumps",
            # MUMPS underestimates its workspace on several ranks.
            "mat_mumps_icntl_14": 100,
        }
    if not accurate:
        return {"ksp_type": "preonly"} | _GAMG_OPTIONS
    base = {
        "ksp_rtol": 1e-6,
        "ksp_max_it": 500,
        "ksp_norm_type": "unpreconditioned",
    } | _GAMG_OPTIONS
    if symmetric:
        return base | {"ksp_type": "cg"}
    return base | {"ksp_type": "gmres", "ksp_pc_side": "right", "ksp_gmres_restart": 60}


def quasi_newton_options(kind: str) -> dict[str, Any]:
    """Return the options of L-BFGS that control the set-up of H₀."""
    return dict(_LBFGS_OPTIONS) if kind == "multigrid" else {}


def newton_options(kind: str) -> dict[str, Any]:
    """Return the options of Newton's method that control its linear solver."""
    return dict(_NEWTON_OPTIONS) if kind == "multigrid" else {}


def factor_bytes(n: int, dimension: int, *, symmetric: bool) -> float:
    """Estimate the memory of a MUMPS factor of a stiffness over n unknowns (bytes)."""
    growth = n ** (4 / 3) if dimension == 3 else n * np.log2(max(n, 2))
    return float(_FACTOR_BYTES[dimension] * growth * (1.0 if symmetric else _LU_RATIO))


def find_available_memory(comm: MPI.Comm) -> float:
    """Return the memory available to all ranks (bytes). Collective."""
    size = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    for name in ("memory.max", "memory/memory.limit_in_bytes"):  # cgroups v2, v1
        try:
            size = min(size, float((Path("/sys/fs/cgroup") / name).read_text()))
        except (OSError, ValueError):
            continue  # no such file, or "max"
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    available = size / node.size
    node.Free()
    return float(comm.allreduce(available))


def describe_memory_excess(n_bytes: float, comm: MPI.Comm) -> str | None:
    """Return why factors of this size exceed the memory; None if they fit. Collective."""
    available = find_available_memory(comm)
    if n_bytes <= _MAX_MEMORY_RATIO * available:
        return None
    return (
        f"its factorisation would take about {n_bytes / 2**30:.1f} of {available / 2**30:.1f} GiB "
        "of memory"
    )


def is_out_of_memory(pc: PETSc.PC) -> bool:
    """Return whether a factorisation ran out of memory."""
    if not pc.getFailedReason():
        return False
    if pc.getFailedReason() == PETSc.PC.FailedReason.FACTOR_OUTMEMORY:
        return True
    mumps = pc.getType() in ("lu", "cholesky") and pc.getFactorSolverType() == "mumps"
    # PETSc does not map all of MUMPS' errors.
    return mumps and pc.getFactorMatrix().getMumpsInfog(1) in _MEMORY_ERRORS


def reset_failed_factorisation(pc: PETSc.PC) -> None:
    """Reset a preconditioner whose factorisation failed. Collective.

    PETSc would otherwise apply MUMPS' failure to all later matrices and solve without factors.
    """
    if pc.getFailedReason() and pc.getType() in ("lu", "cholesky"):
        operators = pc.getOperators()
        pc.reset()
        pc.setOperators(*operators)


@functools.cache
def warn_of_slow_blas() -> None:
    """Log once if the process uses the reference BLAS, the default of Debian's packages."""
    try:
        libraries = Path("/proc/self/maps").read_text()
    except OSError:
        return  # not Linux
    if "/blas/libblas.so" in libraries:
        logger.warning(
            "the reference BLAS is in use: factorisations take up to eight times as long as with "
            "OpenBLAS; install it (Debian: apt install libopenblas0-pthread)"
        )


def is_multigrid_faster(n: float, dimension: int, *, condensed_for: int = 0) -> bool:
    """Return whether multigrid is faster than factorisations, by measured cost.

    L-BFGS assembles H₀ two or three times in an increment and applies it thirty times: there
    multigrid gains before it does in a linear solve. Time of L-BFGS with multigrid relative to that
    with MUMPS' Cholesky factors for a block under a ball, ten increments: 1.0 at a `cube_size` of
    7,500 (graded) and 9,400 (equal cells), 0.75 and 0.9 at 18,000 and 20,000 (graded, linear and
    quadratic).

    Args:
        n: Number of unknowns in the plane, their `cube_size` in space.
        dimension: Dimension of the mesh.
        condensed_for: Number of increments that one factorisation serves; 0: none alone.
    """
    return dimension == 3 and n > max(_MULTIGRID_SIZE, condensed_for * _SIZE_PER_INCREMENT)


def cube_size(space: fem.FunctionSpace, body: npt.NDArray[np.intp], degree: int) -> float:
    """Return the unknowns of a cube with as many operations per unknown to factor. Collective.

    A factorisation takes n w² operations if the least cross-section of a body has w unknowns,
    n^(2/3) in a cube with equal cells. Long bodies have less, bodies with small cells near the
    centre more. Cross-sections are counted by the cells around the centroid, along the coordinate
    axes and the principal axes, whichever are less. For several bodies w² is averaged.

    Args:
        space: Function space of the displacement.
        body: Body of each node, ghosts included.
        degree: Polynomial degree of the displacement.
    """
    mesh, dofmap = space.mesh, space.dofmap
    comm, n_owned, n = mesh.comm, dofmap.index_map.size_local, dofmap.index_map.size_global
    x = space.tabulate_dof_coordinates()
    # Relative to the mean, against cancellation far from the origin.
    x = x - global_sum(comm, x[:n_owned].sum(axis=0)) / n
    owned, label = np.insert(x[:n_owned], 0, 1.0, axis=1), body[:n_owned]
    n_bodies = 1 + int(global_max(comm, label.astype(np.float64)))
    moments = np.zeros((n_bodies, 4, 4))  # sums of the products of (1, x)
    np.add.at(moments, label, np.einsum("pi,pj->pij", owned, owned))
    nodes = dofmap.list[: mesh.topology.index_map(mesh.topology.dim).size_local]
    body_of_cell = body[nodes[:, 0]]
    work = 0.0
    for number, moment in enumerate(broadcast_from_root(comm, global_sum(comm, moments))):
        n_nodes, centre = moment[0, 0], moment[0, 1:] / moment[0, 0]
        variance = moment[1:, 1:] / n_nodes - np.outer(centre, centre)
        axes = np.hstack([np.linalg.eigh(variance)[1], np.eye(3)])
        cells = x[nodes[body_of_cell == number]] @ axes - centre @ axes
        # The mean number of cells that a plane cuts, over a layer around the centroid.
        half = _LAYER_RATIO * np.sqrt(np.einsum("ia,ij,ja->a", axes, variance, axes))
        low, high = (np.clip(end(cells, axis=1), -half, half) for end in (np.min, np.max))
        cut = np.append(np.sum(high - low, axis=0) / (2.0 * half), len(cells))
        *n_cut, n_cells = broadcast_from_root(comm, global_sum(comm, cut))
        section = min(n_cut) * n_nodes / n_cells / degree
        work += n_nodes * section**2
    return float(dofmap.bs * (work / n) ** (3 / 4))


def near_nullspace(space: fem.FunctionSpace) -> PETSc.NullSpace:
    """Return the orthonormal rigid-body modes at the nodes, for GAMG. Collective.

    Those of all bodies together suffice: within an aggregate they span the modes of each body.
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
