"""Linear elasticity in UFL, and Dirichlet conditions for displacement components."""

from __future__ import annotations

from typing import Any

import dolfinx
import ufl
from dolfinx import fem


def displacement_space(mesh: dolfinx.mesh.Mesh, degree: int) -> fem.FunctionSpace:
    """Return the space of vector-valued Lagrange functions."""
    return fem.functionspace(mesh, ("Lagrange", degree, (mesh.geometry.dim,)))


def strain(u: Any) -> Any:
    """Return the symmetric part of the displacement gradient."""
    return ufl.sym(ufl.grad(u))


def stress(u: Any, E: Any, nu: Any) -> Any:
    """Return the stress by Hooke's law; in two dimensions plane strain."""
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    return 2 * mu * strain(u) + lam * ufl.tr(strain(u)) * ufl.Identity(len(u))


def residual(u: fem.Function, v: Any, E: Any, nu: Any) -> ufl.Form:
    """Return the virtual work of the stresses, without loads."""
    return ufl.inner(stress(u, E, nu), strain(v)) * ufl.dx(u.function_space.mesh)


def dirichlet_bc(
    u: fem.Function, tags: dolfinx.mesh.MeshTags, tag: int, component: int, value: Any = 0.0
) -> fem.DirichletBC:
    """Return the Dirichlet condition for one component on a side, by a number or a constant."""
    space = u.function_space.sub(component)
    if not isinstance(value, fem.Constant):
        value = fem.Constant(u.function_space.mesh, float(value))
    dofs = fem.locate_dofs_topological(space, tags.dim, tags.find(tag))
    return fem.dirichletbc(value, dofs, space)
