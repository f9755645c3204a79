"""Young's modulus by the height of the cells at Γc, the measure of contact's stiffness."""

from __future__ import annotations

from typing import Any

import basix
import dolfinx.fem.petsc
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from fenics_contact import compat
from fenics_contact.compiling import compile_by_rule, compile_form
from fenics_contact.parallel import global_max, global_min
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.facets import facet_cells
from fenics_contact.surface.mass import assembled, mass_solver
from fenics_contact.surface.surface import ContactSurface
from fenics_contact.types import Array, Indices

__all__ = ["cell_modulus", "modulus_over_height"]

# Length over which E/h is smoothed, in facets.
_SMOOTHING_FACETS = 4.0


def cell_modulus(
    bulk_tangent: ufl.Form, displacement: Displacement, weight: ufl.core.expr.Expr
) -> fem.Function:
    """Young's modulus of every cell as the bulk form itself has it. Collective.

    Two uniform gradients of the displacement are put into the form cell by cell: simple shear
    u = (0, x, 0) gives G, stretch u = (0, y, 0) gives M = λ + 2G; then E = G (3M - 4G)/(M - G).
    Exact for isotropic solids and plane strain; within some per cent for plane stress; the
    stiffness along y for others.

    Only what the form makes of the gradient of u and of that of its test function counts. Terms in
    u or v themselves (mass, foundation, damping by velocity) are no stiffness of the material and
    are left out, whatever their size: E of a form with inertia is that of the form without. So are
    second gradients, and u_r/r of axisymmetric forms, which both strains have none of. Damping by
    strain rates is stiffness here, as in the tangent.

    In a mixed form the stiffness of the volume is not that of displacements alone: E is 3 G, that
    of an incompressible body.

    Args:
        bulk_tangent: Bilinear form of the bulk, by (trial, test) of what is solved for, its
            derivatives expanded.
        displacement: In it, where a nonlinear bulk is linearised.
        weight: Factor of the volume measure that the bulk form carries (thickness, 2πr).

    Returns:
        A function, one value per cell (stress).
    """
    mesh, (test, trial) = displacement.u.function_space.mesh, bulk_tangent.arguments()
    modulus = fem.Function(fem.functionspace(mesh, ("DG", 0)), name="modulus")
    two = fem.functionspace(mesh, ("DG", 0, (2,)))
    q, cells = ufl.TestFunction(two), ufl.Form(bulk_tangent.integrals_by_type("cell"))
    both = ufl.Form([])
    for direction in range(2):
        gradient = np.zeros((*test.ufl_shape, mesh.geometry.dim))
        gradient[displacement.first + 1, direction] = 1.0
        uniform = ufl.as_tensor(gradient.tolist())
        strained = {ufl.grad(test): q[direction] * uniform, ufl.grad(trial): uniform}
        rest = {argument: ufl.zero(argument.ufl_shape) for argument in (test, trial)}
        both += ufl.replace(cells, strained | rest)
    if both.empty():
        return modulus
    # A form of its own: one with data of subdomains, as the user's may be, takes no other measures.
    volume = assembled(compile_form(weight * ufl.TestFunction(modulus.function_space) * ufl.dx))
    energies = np.sum([assembled(part) for part in compile_by_rule(both)], axis=0)
    shear, stretch = energies.reshape(-1, 2).T / volume
    isotropic = stretch > 1.2 * shear  # λ > -0.8 G: else no isotropic solid, and E is the stretch's
    if displacement.mixed:
        modulus.x.array[:] = 3 * shear
        return modulus
    modulus.x.array[:] = stretch
    G, M = shear[isotropic], stretch[isotropic]
    modulus.x.array[isotropic] = G * ((3 * M - 4 * G) / (M - G))
    return modulus


def modulus_over_height(
    surface: ContactSurface, modulus: fem.Function, opposite: Indices | None = None
) -> fem.Function:
    """E/h over Γc, h the height of the cell over the facet, smoothed over a few facets. Collective.

    Between two bodies E is that of the softer one, which contact is to be stiff for; by the other's
    it may be as stiff as 1e6 E/h of this one.

    The smoothing matters: where a penalty jumps from facet to facet, so does the penetration, and
    the body answers with pressure oscillations (10 % on an unstructured mesh of the half-cylinder,
    whatever the penalty). It acts on the logarithm, so that the result is positive and a change of
    units changes nothing else.

    Args:
        surface: Γc.
        modulus: Young's modulus, one value per cell of the mesh (stress).
        opposite: This rank's facets of the opposite surface, whose largest modulus bounds E; none:
            the obstacle is rigid.

    Returns:
        A continuous function of degree 1 on the submesh of Γc (stress/length).

    Raises:
        ValueError: The modulus is not positive at some facet: the bulk form has no stiffness there.
    """
    mesh, submesh = surface.mesh, surface.submesh
    behind = facet_cells(mesh, surface.parent_facets())
    area = _sizes(submesh, np.arange(behind.size, dtype=np.int32))
    # A simplex of height h over a facet of area A has the volume A h / d, a brick A h.
    simplex = mesh.topology.cell_type in (
        dolfinx.mesh.CellType.triangle,
        dolfinx.mesh.CellType.tetrahedron,
    )
    height = (mesh.topology.dim if simplex else 1) * _sizes(mesh, behind) / area
    values, cells = modulus.x.array, modulus.function_space.dofmap.list[:, 0]
    present = values[cells[behind]]
    if opposite is not None:
        stiffest = global_max(mesh.comm, values[cells[facet_cells(mesh, opposite)]], empty=np.inf)
        present = np.minimum(present, stiffest)
    ratio = present / height
    smallest = global_min(mesh.comm, ratio, empty=1.0)
    if not smallest > 0.0:
        raise ValueError(
            f"Young's modulus at Γc is not positive (smallest E/h: {smallest:g}): check the "
            "modulus, or the bulk form from which it was measured; or give k_n and k_t in "
            "stress/length"
        )
    facets = fem.functionspace(submesh, ("DG", 0))
    logarithm, length = fem.Function(facets), fem.Function(facets)
    own = facets.dofmap.list[: behind.size, 0]
    logarithm.x.array[own] = np.log(ratio)
    length.x.array[own] = _SMOOTHING_FACETS * area ** (1 / submesh.topology.dim)
    for function in (logarithm, length):
        function.x.scatter_forward()
    result = _smooth(logarithm, length)
    result.x.array[:] = np.exp(result.x.array)
    return result


def _sizes(mesh: dolfinx.mesh.Mesh, cells: npt.NDArray[np.integer[Any]]) -> Array:
    """Area or volume of cells, that of their midpoints' Jacobian: exact for straight simplices."""
    kind = basix.CellType[mesh.topology.cell_name()]
    middle = basix.geometry(kind).mean(axis=0, keepdims=True)
    slopes = compat.geometry_element(mesh).tabulate(1, middle)[1:, 0, :, 0]
    x = mesh.geometry.x[compat.geometry_dofmap(mesh)[cells]][:, :, : mesh.geometry.dim]
    jacobian = np.einsum("kn,cnd->ckd", slopes, x)
    squared = np.linalg.det(jacobian @ jacobian.transpose(0, 2, 1))
    return np.asarray(np.sqrt(squared) * basix.cell.volume(kind), dtype=np.float64)


def _smooth(values: fem.Function, length: fem.Function) -> fem.Function:
    """Solve w - ∇·(length² ∇w) = values with free edges, w continuous of degree 1. Collective."""
    mesh = values.function_space.mesh
    space = fem.functionspace(mesh, ("Lagrange", 1))
    w, v = ufl.TrialFunction(space), ufl.TestFunction(space)
    dx = ufl.dx(mesh)
    form = w * v * dx + length**2 * ufl.dot(ufl.grad(w), ufl.grad(v)) * dx
    matrix = fem.petsc.assemble_matrix(compile_form(form))
    matrix.assemble()
    result = fem.Function(space, name="modulus_over_height")
    rhs = fem.Function(space)
    assembled(compile_form(values * v * dx), rhs.x)
    ksp = mass_solver(matrix, rtol=1e-14, max_it=10_000)
    ksp.solve(rhs.x.petsc_vec, result.x.petsc_vec)
    result.x.scatter_forward()
    ksp.destroy()
    matrix.destroy()
    return result
