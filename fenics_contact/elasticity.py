"""Elastic bodies as UFL residuals: plane strain, plane stress, axisymmetric, three-dimensional.

    body = elasticity.LinearElastic(u, E, nu, kind="plane stress", thickness=6.4)
    F = body.residual(v) + body.weight * pressure * v[1] * ds(TOP)
    contact = fc.Contact(u, surface, obstacle, law, weight=body.weight)

The rest of the package is independent of this module: any UFL residual may be used.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.arguments import check_bool, is_number

__all__ = ["KINDS", "LinearElastic", "NeoHookean"]

# Space dimension of every kind.
KINDS = {"plane strain": 2, "plane stress": 2, "axisymmetric": 2, "3D": 3}


class LinearElastic:
    """The residual of an isotropic, linearly elastic body at small strains, in UFL.

    Strain and stress are 3 × 3 for every kind; the third axis is normal to the plane, and for
    axisymmetric bodies (coordinates r, z) the circumferential one. Nothing is compiled.

    Args:
        u: Displacement, shape (gdim,); for axisymmetric bodies (u_r, u_z).
        E: Young's modulus (stress): a number, constant, function or UFL expression.
        nu: Poisson's ratio, given like E.
        kind: "plane strain", "plane stress", "axisymmetric" or "3D".
        thickness: Thickness of a plane body (length), 1 by default.

    Attributes:
        u: The displacement.
        kind: The kind of body.
        E, nu: Young's modulus (stress) and Poisson's ratio (UFL).
        weight: Factor of all integrals over the body and its boundary: the thickness, or 2πr.
            Multiply loads by it, and pass it to ``Contact(weight=...)``.
        stress: Stress σ(u), shape (3, 3) (UFL).

    Raises:
        ValueError: The kind is unknown or for another dimension, or numbers are out of range.
    """

    def __init__(
        self, u: fem.Function, E: Any, nu: Any, kind: str, *, thickness: Any = None
    ) -> None:
        _check_kind(u, kind, list(KINDS))
        mesh = _mesh(u)
        if thickness is not None and not kind.startswith("plane"):
            raise ValueError(f"thickness is {thickness!r}; omit it for a body of kind {kind!r}")
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
        """Return the strain ε(w) of a displacement w, shape (3, 3) (UFL)."""
        epsilon = ufl.sym(ufl.grad(w))
        if self.kind == "3D":
            return epsilon
        out_of_plane: Any = ufl.as_ufl(0.0)
        if self.kind == "plane stress":
            out_of_plane = -self.nu / (1 - self.nu) * ufl.tr(epsilon)
        elif self.kind == "axisymmetric":
            out_of_plane = w[0] / ufl.SpatialCoordinate(_mesh(self.u))[0]
        return _embed(epsilon, out_of_plane)

    def stress_of(self, w: Any) -> Any:
        """Return the stress σ(w) of a displacement w, shape (3, 3) (UFL)."""
        epsilon, shear = self.strain(w), self.E / (2 * (1 + self.nu))
        in_plane = epsilon[0, 0] + epsilon[1, 1]
        if self.kind == "plane stress":
            # The factor 1 - 2ν cancels: ν = 1/2 is admissible.
            mean = 2 * shear * self.nu / (1 - self.nu) * in_plane
            plane = ufl.as_tensor([[1, 0, 0], [0, 1, 0], [0, 0, 0]])
            return 2 * shear * ufl.dot(plane, epsilon) + mean * plane
        lame = 2 * shear * self.nu / (1 - 2 * self.nu)
        return 2 * shear * epsilon + lame * ufl.tr(epsilon) * ufl.Identity(3)

    def residual(self, v: Any, dx: ufl.Measure = ufl.dx) -> ufl.Form:
        """Return the virtual work of the stresses, ∫ σ(u):ε(v) weight dx.

        Args:
            v: Test function of ``u``'s space.
            dx: Measure of the body, possibly of a part of the mesh or with a quadrature degree.
        """
        return self.weight * ufl.inner(self.stress, self.strain(v)) * dx


class NeoHookean:
    """The residual of a compressible or incompressible neo-Hookean body at finite strains, in UFL.

    The strain energy per undeformed volume is W = G/2 (I₁ - 3 - 2 ln J) + λ/4 (J² - 1 - 2 ln J), or
    with ``isochoric`` W = G/2 (I₁/J^(2/3) - 3) + K/4 (J² - 1 - 2 ln J), where I₁ = F:F and
    J = det F. Both agree with the linear body with E and ν at small strains. Tensors are 3 × 3 for
    every kind, as in `LinearElastic`. Nothing is compiled.

    A nearly or fully incompressible body (ν up to 1/2) needs its ``pressure`` as a second unknown,
    p = -∂U/∂J with U the last term of W, solved for J,

        J = √(1 + (p/m)²) - p/m,    m = λ or K,

    in the weak sense with the pressure's test functions; J = 1 at ν = 1/2. The residual is the
    derivative of a potential with respect to (u, p).

        u, p = ufl.split(w)
        v, q = ufl.TestFunctions(w.function_space)
        F = NeoHookean(u, E, 0.5, "plane strain", pressure=p).residual(v, q=q)

    Args:
        u: Displacement, shape (gdim,), a function or the part of a mixed one that ``ufl.split``
            gives; for axisymmetric bodies (u_r, u_z).
        E: Young's modulus (stress): a number, constant, function or UFL expression.
        nu: Poisson's ratio, given like E: below 1/2, or with a pressure 0 < ν ≤ 1/2. Without a
            pressure, use degree 2 and at most 0.49 to avoid locking.
        kind: "plane strain", "axisymmetric" or "3D".
        isochoric: Whether the second energy is used.
        pressure: Pressure p of the same mixed function (UFL), in a stable pair of elements: one
            degree less than u (Taylor and Hood), or degree 1 with u of degree 1 and bubbles (MINI).

    Attributes:
        u: The displacement.
        pressure: p, positive in compression (stress), or None. With ``isochoric`` it is the mean
            Cauchy pressure, -tr σ/3.
        kind: The kind of body.
        E, nu: Young's modulus (stress) and Poisson's ratio at small strains (UFL).
        weight: Factor of all integrals over the body and its boundary: 1, or 2πr of the undeformed
            body. Multiply loads by it, and pass it to ``Contact(weight=...)``.
        F: Deformation gradient.
        J: Volume ratio det F.
        energy: W(F) (stress), with a pressure without its last term U.
        nominal: First Piola-Kirchhoff stress ∂W/∂F, force per undeformed area.
        stress: Cauchy stress, force per deformed area.

    Raises:
        ValueError: The kind is unknown or for another dimension, or numbers are out of range.
    """

    def __init__(
        self,
        u: Any,
        E: Any,
        nu: Any,
        kind: str,
        *,
        isochoric: bool = False,
        pressure: Any = None,
    ) -> None:
        _check_kind(u, kind, [k for k in KINDS if k != "plane stress"])
        check_bool("isochoric", isochoric)
        mesh = _mesh(u)
        self.u, self.kind, self.pressure = u, kind, pressure
        self.E = _coefficient(mesh, "E", E, 0.0, np.inf)
        mixed = pressure is not None
        if mixed and ufl.as_ufl(pressure).ufl_shape != ():
            raise ValueError(f"pressure has shape {pressure.ufl_shape}; it must be a scalar")
        self.nu = _coefficient(mesh, "nu", nu, 0.0 if mixed else -1.0, 0.5, closed=mixed)
        axisymmetric = kind == "axisymmetric"
        self.weight = 2 * ufl.pi * ufl.SpatialCoordinate(mesh)[0] if axisymmetric else 1.0
        gradient = ufl.variable(ufl.Identity(3) + self.gradient(u))
        self.F, self.J = gradient, ufl.det(gradient)
        shear = self.E / (2 * (1 + self.nu))
        lame = 2 * shear * self.nu / (1 - 2 * self.nu)
        square, volume = ufl.inner(self.F, self.F), self.J**2 - 1 - 2 * ufl.ln(self.J)
        if isochoric:
            modulus = lame + 2 * shear / 3
            self.energy = shear / 2 * (self.J ** (-2 / 3) * square - 3)
        else:
            modulus = lame
            self.energy = shear / 2 * (square - 3 - 2 * ufl.ln(self.J))
        self._excess: Any = None
        if pressure is None:
            self.energy += modulus / 4 * volume
            self.nominal = ufl.diff(self.energy, self.F)
        else:
            # κ = 1/λ or 1/K is finite at ν = 1/2.
            kappa = (1 - 2 * self.nu) / (2 * shear)
            kappa *= 3 / (1 + self.nu) if isochoric else 1 / self.nu
            self._excess = self.J - (ufl.sqrt(1 + (kappa * pressure) ** 2) - kappa * pressure)
            self.nominal = ufl.diff(self.energy, self.F) - pressure * ufl.diff(self.J, self.F)
        self.stress = ufl.dot(self.nominal, ufl.transpose(self.F)) / self.J

    def gradient(self, w: Any) -> Any:
        """Return the material gradient of a displacement w, shape (3, 3) (UFL)."""
        grad_w = ufl.grad(w)
        if self.kind == "3D":
            return grad_w
        out_of_plane: Any = ufl.as_ufl(0.0)
        if self.kind == "axisymmetric":
            out_of_plane = w[0] / ufl.SpatialCoordinate(_mesh(self.u))[0]
        return _embed(grad_w, out_of_plane)

    def residual(self, v: Any, dx: ufl.Measure = ufl.dx, *, q: Any = None) -> ufl.Form:
        """Return the virtual work of the stresses, ∫ P:grad v weight dx.

        With a pressure the residual has the additional term -∫ q (J - J(p)) weight dx.

        Args:
            v: Test function of ``u``'s space.
            dx: Measure of the undeformed body, possibly of a part of it or with a quadrature
                degree.
            q: Test function of the pressure's space; None without a pressure.

        Raises:
            ValueError: Either the pressure or its test function is missing.
        """
        if (q is None) != (self.pressure is None):
            given = "no" if self.pressure is None else "a"
            raise ValueError(
                f"q is {'None' if q is None else 'given'}, but the body has {given} pressure: use "
                "residual(v, q=q) with NeoHookean(..., pressure=p), residual(v) without a pressure"
            )
        density = ufl.inner(self.nominal, self.gradient(v))
        if q is not None:
            density -= q * self._excess
        return self.weight * density * dx


def _check_kind(u: fem.Function, kind: str, kinds: list[str]) -> None:
    """Raise ValueError for an unknown kind, or one of another dimension."""
    if kind not in kinds:
        raise ValueError(f"kind is {kind!r}; use one of {kinds}")
    gdim = _mesh(u).geometry.dim
    if u.ufl_shape != (KINDS[kind],) or gdim != KINDS[kind]:
        raise ValueError(
            f"u has shape {u.ufl_shape} on a mesh in {gdim}D; a body of kind {kind!r} has "
            f"({KINDS[kind]},) in {KINDS[kind]}D"
        )


def _embed(plane: Any, out_of_plane: Any) -> Any:
    """Extend a tensor (2, 2) to (3, 3), with its out-of-plane normal component."""
    return ufl.as_tensor(
        [[plane[0, 0], plane[0, 1], 0], [plane[1, 0], plane[1, 1], 0], [0, 0, out_of_plane]]
    )


def _mesh(u: Any) -> Any:
    """Return the mesh of a function, or of an expression of functions, as from `ufl.split`."""
    functions = ufl.algorithms.extract_coefficients(u) if isinstance(u, ufl.core.expr.Expr) else []
    meshes = [f.function_space.mesh for f in functions if isinstance(f, fem.Function)]
    if not meshes:
        raise ValueError(
            f"u is a {type(u).__name__}; it must be a Function, or a part of one given by ufl.split"
        )
    return meshes[0]


def _coefficient(
    mesh: Any, name: str, value: Any, low: float, high: float, *, closed: bool = False
) -> Any:
    """Return a number as a fem.Constant, so that its value is not compiled in; or an expression."""
    if isinstance(value, ufl.core.expr.Expr):
        return value
    if not (is_number(value) and (low < value < high or (closed and value == high))):
        included = " (included)" if closed else ""
        raise ValueError(
            f"{name} is {value!r}; it must be a number between {low:g} and {high:g}{included}"
        )
    return fem.Constant(mesh, float(value))
