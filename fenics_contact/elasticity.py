"""Elastic bodies for those who need no form of their own: plane, axisymmetric, spatial.

    body = elasticity.LinearElastic(u, E, nu, kind="plane stress", thickness=6.4)
    F = body.residual(v) + body.weight * pressure * v[1] * ds(TOP)
    contact = fc.Contact(u, surface, obstacle, law, weight=body.weight)

Nothing else of the package knows this module: any residual in UFL does as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.arguments import is_number

__all__ = ["KINDS", "LinearElastic", "NeoHookean"]

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
        _check_kind(u, kind, list(KINDS))
        mesh = _mesh(u)
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
            across = w[0] / ufl.SpatialCoordinate(_mesh(self.u))[0]
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


class NeoHookean:
    """A body of neo-Hookean rubber at strains of any size, by its residual in UFL.

    W = G/2 (I₁ - 3 - 2 ln J) + λ/4 (J² - 1 - 2 ln J) per undeformed volume, or with ``isochoric``
    W = G/2 (I₁/J^(2/3) - 3) + K/4 (J² - 1 - 2 ln J), where I₁ = F:F and J = det F. Both begin as
    the linear body with E and ν. Tensors are 3 x 3 for every kind, as in `LinearElastic`.

    A body that hardly changes its volume, or not at all (ν = 1/2), is given its ``pressure`` as a
    second unknown: p = -∂U/∂J with U the last term of W, solved for J,

        J = √(1 + (p/m)²) - p/m,    m = λ or K,

    which holds in the mean of the pressure's test functions, and is J = 1 at ν = 1/2. So the two
    forms have the same solutions, and the residual is the derivative of a potential by (u, p).

        u, p = ufl.split(w)
        v, q = ufl.TestFunctions(w.function_space)
        F = NeoHookean(u, E, 0.5, "plane strain", pressure=p).residual(v, q=q)

    Attributes:
        u: The displacement.
        pressure: p, positive where compressed (stress); None: it follows from u. With ``isochoric``
            it is that of the true stress, -tr σ/3.
        kind: "plane strain", "axisymmetric" or "3D".
        E, nu: Young's modulus (stress) and Poisson's ratio of the undeformed body (UFL).
        weight: What every integral over the body or its boundary carries: 1, or 2πr of the
            undeformed body. Multiply loads by it, and pass it on as ``Contact(weight=...)``.
        F: Deformation gradient.
        J: Change of the volume.
        energy: W(F) (stress); with a pressure without its last term, U.
        nominal: First Piola-Kirchhoff stress, ∂W/∂F, force per undeformed area.
        stress: Cauchy stress, force per deformed area.
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
        """Make the body's expressions; nothing is compiled.

        Args:
            u: Displacement, shape (gdim,), a function or the part of a mixed one that
                ``ufl.split`` gives; axisymmetric (u_r, u_z).
            E: Young's modulus (stress): a number, constant, function or UFL expression.
            nu: Poisson's ratio, likewise; near 1/2 displacements alone lock: take degree 2 and
                no more than 0.49, or a pressure, with which 0 < ν ≤ 1/2.
            kind: "plane strain", "axisymmetric" or "3D".
            isochoric: Which of the two energies.
            pressure: p, of the same mixed function (UFL): see the class. Its elements should be
                such that neither locks nor oscillates: of one degree less than u (Taylor and Hood),
                or of degree 1 beside u of degree 1 with bubbles (MINI).

        Raises:
            ValueError: An unknown kind, one for another dimension, or numbers out of range.
        """
        _check_kind(u, kind, [k for k in KINDS if k != "plane stress"])
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
            # 1/λ or 1/K, which ν = 1/2 has, too.
            soft = (1 - 2 * self.nu) / (2 * shear)
            soft *= 3 / (1 + self.nu) if isochoric else 1 / self.nu
            self._excess = self.J - (ufl.sqrt(1 + (soft * pressure) ** 2) - soft * pressure)
            self.nominal = ufl.diff(self.energy, self.F) - pressure * ufl.diff(self.J, self.F)
        self.stress = ufl.dot(self.nominal, ufl.transpose(self.F)) / self.J

    def gradient(self, w: Any) -> Any:
        """Gradient of a displacement by the undeformed body, shape (3, 3) (UFL)."""
        slope = ufl.grad(w)
        if self.kind == "3D":
            return slope
        across: Any = ufl.as_ufl(0.0)
        if self.kind == "axisymmetric":
            across = w[0] / ufl.SpatialCoordinate(_mesh(self.u))[0]
        return ufl.as_tensor(
            [[slope[0, 0], slope[0, 1], 0], [slope[1, 0], slope[1, 1], 0], [0, 0, across]]
        )

    def residual(self, v: Any, dx: ufl.Measure = ufl.dx, *, q: Any = None) -> ufl.Form:
        """Virtual work of the stresses, ∫ P:grad v weight dx; subtract that of the loads.

        With a pressure minus ∫ q (J - J(p)) weight dx, too, by which the volume follows from it.

        Args:
            v: Test function of ``u``'s space.
            dx: Measure of the undeformed body; a part of it, or a quadrature degree of one's own.
            q: Test function of the pressure's space, where there is a pressure.

        Raises:
            ValueError: One of pressure and its test function is missing.
        """
        if (q is None) != (self.pressure is None):
            given = "no" if self.pressure is None else "a"
            raise ValueError(
                f"q is {'None' if q is None else 'given'}, and the body has {given} pressure: "
                "residual(v, q=q) is that of a body NeoHookean(..., pressure=p), residual(v) that "
                "of one without"
            )
        density = ufl.inner(self.nominal, self.gradient(v))
        if q is not None:
            density -= q * self._excess
        return self.weight * density * dx


def _check_kind(u: fem.Function, kind: str, kinds: list[str]) -> None:
    """Refuse a kind that is none, or for another dimension."""
    if kind not in kinds:
        raise ValueError(f"kind is {kind!r}; use one of {kinds}")
    gdim = _mesh(u).geometry.dim
    if u.ufl_shape != (KINDS[kind],) or gdim != KINDS[kind]:
        raise ValueError(
            f"u has shape {u.ufl_shape} on a mesh in {gdim}D; a body of kind {kind!r} has "
            f"({KINDS[kind]},) in {KINDS[kind]}D"
        )


def _mesh(u: Any) -> Any:
    """Of a function, or of what `ufl.split` gives of one, or sums of that."""
    functions = ufl.algorithms.extract_coefficients(u) if isinstance(u, ufl.core.expr.Expr) else []
    meshes = [f.function_space.mesh for f in functions if isinstance(f, fem.Function)]
    if not meshes:
        raise ValueError(
            f"u is a {type(u).__name__}; it must be a Function, or a part of one as ufl.split "
            "gives it"
        )
    return meshes[0]


def _coefficient(
    mesh: Any, name: str, value: Any, low: float, high: float, *, closed: bool = False
) -> Any:
    """Numbers become constants of the mesh, so that their value is not compiled in."""
    if isinstance(value, ufl.core.expr.Expr):
        return value
    if not (is_number(value) and (low < value < high or (closed and value == high))):
        included = ", which it may be" if closed else ""
        raise ValueError(
            f"{name} is {value!r}; it must be a number between {low:g} and {high:g}{included}"
        )
    return fem.Constant(mesh, float(value))
