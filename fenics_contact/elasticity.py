"""Linear elastic bodies for those who need no form of their own: plane, axisymmetric, spatial.

    body = elasticity.LinearElastic(u, E, nu, kind="plane stress", thickness=6.4)
    F = body.residual(v) + body.weight * pressure * v[1] * ds(TOP)
    contact = fc.Contact(u, surface, support, law, weight=body.weight)

Nothing else of the package knows this module: any residual in UFL does as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.arguments import is_number

__all__ = ["KINDS", "LinearElastic"]

# Space dimension of every kind.
KINDS = {"plane strain": 2, "plane stress": 2, "axisymmetric": 2, "3D": 3}


class LinearElastic:
    """An isotropic, linearly elastic body at small strains, by its residual in UFL.

    Strain and stress are 3 x 3 for every kind; their third axis is the one out of the plane, of
    axisymmetric bodies (coordinates r, z) the circumferential one.

    Attributes:
        u: The displacement.
        kind: One of `KINDS`.
        E, nu: Young's modulus (stress) and Poisson's ratio (UFL).
        weight: What every integral over the body or its boundary carries: the thickness, or 2πr.
            Multiply loads by it, and pass it on as ``Contact(weight=...)``.
        stress: σ(u), shape (3, 3).
    """

    def __init__(
        self, u: fem.Function, E: Any, nu: Any, kind: str, *, thickness: Any = None
    ) -> None:
        """Make the body's expressions; nothing is compiled.

        Args:
            u: Displacement, shape (gdim,); axisymmetric (u_r, u_z).
            E: Young's modulus (stress): a number, constant, function or UFL expression.
            nu: Poisson's ratio, likewise.
            kind: "plane strain", "plane stress", "axisymmetric" or "3D".
            thickness: Length out of the plane, for the plane kinds; 1 by default.

        Raises:
            ValueError: An unknown kind, one for another dimension, or numbers out of range.
        """
        if kind not in KINDS:
            raise ValueError(f"kind is {kind!r}; use one of {list(KINDS)}")
        mesh = u.function_space.mesh
        if u.ufl_shape != (KINDS[kind],) or mesh.geometry.dim != KINDS[kind]:
            raise ValueError(
                f"u has shape {u.ufl_shape} on a mesh in {mesh.geometry.dim}D; a body of kind "
                f"{kind!r} has ({KINDS[kind]},) in {KINDS[kind]}D"
            )
        if thickness is not None and not kind.startswith("plane"):
            raise ValueError(f"thickness is {thickness!r}; a body of kind {kind!r} has none")
        self.u, self.kind = u, kind
        self.E = _coefficient(mesh, "E", E, 0.0, np.inf)
        self.nu = _coefficient(mesh, "nu", nu, -1.0, 0.5 if kind != "plane stress" else 1.0)
        if kind == "axisymmetric":
            self.weight = 2 * ufl.pi * ufl.SpatialCoordinate(mesh)[0]
        else:
            given = 1.0 if thickness is None else thickness
            self.weight = _coefficient(mesh, "thickness", given, 0.0, np.inf)
        self.stress = self.stress_of(u)

    def strain(self, w: Any) -> Any:
        """ε(w), shape (3, 3) (UFL)."""
        epsilon = ufl.sym(ufl.grad(w))
        if self.kind == "3D":
            return epsilon
        across: Any = ufl.as_ufl(0.0)
        if self.kind == "plane stress":
            across = -self.nu / (1 - self.nu) * ufl.tr(epsilon)
        elif self.kind == "axisymmetric":
            across = w[0] / ufl.SpatialCoordinate(self.u.function_space.mesh)[0]
        return ufl.as_tensor(
            [[epsilon[0, 0], epsilon[0, 1], 0], [epsilon[1, 0], epsilon[1, 1], 0], [0, 0, across]]
        )

    def stress_of(self, w: Any) -> Any:
        """σ(w), shape (3, 3) (UFL)."""
        epsilon, shear = self.strain(w), self.E / (2 * (1 + self.nu))
        in_plane = epsilon[0, 0] + epsilon[1, 1]
        if self.kind == "plane stress":
            # Without the factor 1 - 2ν, which drops out: ν = 1/2 is an ordinary value here.
            mean = 2 * shear * self.nu / (1 - self.nu) * in_plane
            plane = ufl.as_tensor([[1, 0, 0], [0, 1, 0], [0, 0, 0]])
            return 2 * shear * ufl.dot(plane, epsilon) + mean * plane
        lame = 2 * shear * self.nu / (1 - 2 * self.nu)
        return 2 * shear * epsilon + lame * ufl.tr(epsilon) * ufl.Identity(3)

    def residual(self, v: Any, dx: ufl.Measure = ufl.dx) -> ufl.Form:
        """Virtual work of the stresses, ∫ σ(u):ε(v) weight dx; subtract that of the loads.

        Args:
            v: Test function of ``u``'s space.
            dx: Measure of the body; a part of the mesh, or a quadrature degree of one's own.
        """
        return self.weight * ufl.inner(self.stress, self.strain(v)) * dx


def _coefficient(mesh: Any, name: str, value: Any, low: float, high: float) -> Any:
    """Numbers become constants of the mesh, so that their value is not compiled in."""
    if isinstance(value, ufl.core.expr.Expr):
        return value
    if not (is_number(value) and low < value < high):
        raise ValueError(f"{name} is {value!r}; it must be a number between {low:g} and {high:g}")
    return fem.Constant(mesh, float(value))
