"""Young's modulus over cell height at Γc, the scale of the contact stiffness."""

from __future__ import annotations

from typing import Any

import basix
import dolfinx.fem.petsc
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from fenics_contact import compat
from fenics_contact.compiling import compile_by_quadrature_rule, compile_form
from fenics_contact.parallel import global_max, global_min
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.facets import facet_cells
from fenics_contact.surface.mass import assemble_values, create_mass_solver
from fenics_contact.surface.surface import ContactSurface
from fenics_contact.types import Array, Indices

__all__ = ["cell_modulus", "modulus_over_height"]

# Smoothing length of E/h relative to the facet size.
_SMOOTHING_LENGTH_RATIO = 4.0


def cell_modulus(
    bulk_tangent: ufl.Form, displacement: Displacement, weight: ufl.core.expr.Expr
) -> fem.Function:
    """Measure Young's modulus of every cell by the bulk form. Collective.

    The form is evaluated for two uniform gradients: simple shear u = (0, x, 0) gives G, stretch
    u = (0, y, 0) gives M = λ + 2G, and E = G (3M - 4G)/(M - G). The result is exact for isotropic
    solids in plane strain and 3D, and within some per cent in plane stress. For anisotropic solids
    it is the stiffness along y; in mixed forms 3G, the modulus of an incompressible solid.

    Only terms in ∇u and ∇v count. Terms in u or v (inertia, foundation, viscous drag), second
    gradients and u_r/r of axisymmetric forms are excluded; strain-rate damping is included.

    Args:
        bulk_tangent: Bilinear form of the bulk in all unknowns, its derivatives expanded.
        displacement: Displacement at which a nonlinear bulk is linearised.
        weight: Factor of the volume measure in the bulk form (thickness, 2πr).

    Returns:
        Function with one value per cell (stress).
    """
    mesh, (test, trial) = displacement.u.function_space.mesh, bulk_tangent.arguments()
    modulus = fem.Function(fem.functionspace(mesh, ("DG", 0)), name="modulus")
    vector_space = fem.functionspace(mesh, ("DG", 0, (2,)))
    q, cells = ufl.TestFunction(vector_space), ufl.Form(bulk_tangent.integrals_by_type("cell"))
    probes = ufl.Form([])
    for direction in range(2):
        gradient = np.zeros((*test.ufl_shape, mesh.geometry.dim))
        gradient[displacement.first + 1, direction] = 1.0
        uniform = ufl.as_tensor(gradient.tolist())
        strained = {ufl.grad(test): q[direction] * uniform, ufl.grad(trial): uniform}
        zeros = {argument: ufl.zero(argument.ufl_shape) for argument in (test, trial)}
        probes += ufl.replace(cells, strained | zeros)
    if probes.empty():
        return modulus
    # A separate form: the subdomain data of the bulk form exclude other measures.
    volume = assemble_values(
        compile_form(weight * ufl.TestFunction(modulus.function_space) * ufl.dx)
    )
    energies = np.sum(
        [assemble_values(part) for part in compile_by_quadrature_rule(probes)], axis=0
    )
    shear, stretch = energies.reshape(-1, 2).T / volume
    isotropic = stretch > 1.2 * shear  # λ > -0.8 G, as in all isotropic solids
    if displacement.is_mixed:
        modulus.x.array[:] = 3 * shear
        return modulus
    modulus.x.array[:] = stretch
    G, M = shear[isotropic], stretch[isotropic]
    modulus.x.array[isotropic] = G * ((3 * M - 4 * G) / (M - G))
    return modulus


def modulus_over_height(
    surface: ContactSurface, modulus: fem.Function, opposite: Indices | None = None
) -> fem.Function:
    """Compute E/h on Γc, with h the height of the cell over the facet, smoothed. Collective.

    Between two bodies E is bounded by the largest modulus of the opposing one. Jumps of the penalty
    between facets would cause pressure oscillations (10 % on an unstructured half-cylinder).
    Smoothing the logarithm keeps the result positive and independent of units.

    Args:
        surface: Γc.
        modulus: Young's modulus, one value per cell of the mesh (stress).
        opposite: This rank's facets of the opposing surface; None: the obstacle is rigid.

    Returns:
        A continuous function of degree 1 on the submesh of Γc (stress/length).

    Raises:
        ValueError: The modulus is not positive at a facet: the bulk form has no stiffness there.
    """
    mesh, submesh = surface.mesh, surface.submesh
    facet_cell = facet_cells(mesh, surface.parent_facets())
    area = _sizes(submesh, np.arange(facet_cell.size, dtype=np.int32))
    # The volume of a simplex is A h / d, that of a hexahedron A h.
    simplex = mesh.topology.cell_type in (
        dolfinx.mesh.CellType.triangle,
        dolfinx.mesh.CellType.tetrahedron,
    )
    height = (mesh.topology.dim if simplex else 1) * _sizes(mesh, facet_cell) / area
    values, cells = modulus.x.array, modulus.function_space.dofmap.list[:, 0]
    facet_modulus = values[cells[facet_cell]]
    if opposite is not None:
        stiffest = global_max(mesh.comm, values[cells[facet_cells(mesh, opposite)]], empty=np.inf)
        facet_modulus = np.minimum(facet_modulus, stiffest)
    ratio = facet_modulus / height
    smallest = global_min(mesh.comm, ratio, empty=1.0)
    if not smallest > 0.0:
        raise ValueError(
            f"Young's modulus at Γc is not positive (smallest E/h: {smallest:g}): check the "
            "modulus, or the bulk form from which it was measured; or give k_n and k_t in "
            "stress/length"
        )
    facets = fem.functionspace(submesh, ("DG", 0))
    logarithm, length = fem.Function(facets), fem.Function(facets)
    dofs = facets.dofmap.list[: facet_cell.size, 0]
    logarithm.x.array[dofs] = np.log(ratio)
    length.x.array[dofs] = _SMOOTHING_LENGTH_RATIO * area ** (1 / submesh.topology.dim)
    for function in (logarithm, length):
        function.x.scatter_forward()
    result = _smooth(logarithm, length)
    result.x.array[:] = np.exp(result.x.array)
    return result


def _sizes(mesh: dolfinx.mesh.Mesh, cells: npt.NDArray[np.integer[Any]]) -> Array:
    """Return areas or volumes of cells by the Jacobian at the midpoint, exact for affine ones."""
    kind = basix.CellType[mesh.topology.cell_name()]
    middle = basix.geometry(kind).mean(axis=0, keepdims=True)
    slopes = compat.geometry_element(mesh).tabulate(1, middle)[1:, 0, :, 0]
    x = mesh.geometry.x[compat.geometry_dofmap(mesh)[cells]][:, :, : mesh.geometry.dim]
    jacobian = np.einsum("kn,cnd->ckd", slopes, x)
    squared = np.linalg.det(jacobian @ jacobian.transpose(0, 2, 1))
    return np.asarray(np.sqrt(squared) * basix.cell.volume(kind), dtype=np.float64)


def _smooth(values: fem.Function, length: fem.Function) -> fem.Function:
    """Solve w - ∇·(length² ∇w) = values with natural boundary conditions. Collective."""
    mesh = values.function_space.mesh
    space = fem.functionspace(mesh, ("Lagrange", 1))
    w, v = ufl.TrialFunction(space), ufl.TestFunction(space)
    dx = ufl.dx(mesh)
    form = w * v * dx + length**2 * ufl.dot(ufl.grad(w), ufl.grad(v)) * dx
    matrix = fem.petsc.assemble_matrix(compile_form(form))
    matrix.assemble()
    result = fem.Function(space, name="modulus_over_height")
    rhs = fem.Function(space)
    assemble_values(compile_form(values * v * dx), rhs.x)
    ksp = create_mass_solver(matrix, rtol=1e-14, max_it=10_000)
    ksp.solve(rhs.x.petsc_vec, result.x.petsc_vec)
    result.x.scatter_forward()
    ksp.destroy()
    matrix.destroy()
    return result
