"""Contact: binds displacement, surface, support and law; the boundary form and its results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from fenics_contact import accuracy
from fenics_contact.history import History
from fenics_contact.laws import Kinematics, Law, Scaled
from fenics_contact.parallel import gather_rows, global_max, global_min, global_sum
from fenics_contact.supports import Support
from fenics_contact.surface import ContactSurface, PointEvaluator

__all__ = ["Contact", "Resultants", "Status"]

Array = npt.NDArray[np.float64]


class Status(IntEnum):
    """State of a quadrature point of Γc."""

    OPEN = 0
    STICK = 1
    SLIP = 2


@dataclass(frozen=True)
class Resultants:
    """Integrals over Γc and counts of its points, the same on every rank.

    Attributes:
        force: Contact force on the body, ∫ (r_n n + τ), shape (gdim,) (2D: per thickness).
        normal_force: ∫ -r_n ≥ 0.
        tangential_force: ∫ |τ|.
        area: Measure of the closed part.
        open, stick, slip: Numbers of quadrature points.
        max_pressure: Largest -r_n at a point (stress).
        max_penetration: Largest δ₋ (length).
    """

    force: Array
    normal_force: float
    tangential_force: float
    area: float
    open: int
    stick: int
    slip: int
    max_pressure: float
    max_penetration: float


class Contact:
    """Frictional contact of Γc with a support, as a boundary form and a committed history.

    Attributes:
        u: The displacement, a vector-valued Lagrange function.
        surface, support, law: What was given.
        quadrature: The points of Γc.
        history: The committed state.
        parameters: Every parameter of law and support given by a number, as a ``fem.Constant``
            by name ("friction", "k_n", "displacement" …): set ``.value`` to change it.
        entity_maps: For compiling `form` in a problem of one's own.
        name: In messages and files.
    """

    def __init__(
        self,
        u: fem.Function,
        surface: ContactSurface,
        support: Support,
        law: Law,
        *,
        gap: Any = None,
        weight: Any = None,
        modulus: Any = None,
        name: str = "contact",
    ) -> None:
        """Bind the parts. Collective; compiles what evaluates the points.

        Args:
            u: Displacement; vector-valued Lagrange of any degree on the surface's mesh.
            surface: Γc.
            support: What it presses on.
            law: The reactions.
            gap: Initial gap s (length) prescribed independently of the support's geometry (paper,
                footnote 1): a number, constant or UFL. The support's motion is added to it.
            weight: Factor of the surface measure where the bulk form carries one: a thickness, or
                2πr for axisymmetric problems.
            modulus: Young's modulus near Γc (stress), a number or function with one value per
                cell, for `Scaled` stiffness. By default it is measured from the bulk form, by
                `ContactProblem`.
            name: In messages and files.

        Raises:
            ValueError: ``u`` is no displacement of this mesh, or data of support or law are wrong.
            TypeError: A parameter is of a type that cannot be a coefficient.
        """
        self.name = name
        self.u = u
        self.surface, self.support, self.law = surface, support, law
        self.entity_maps = surface.entity_maps
        self.parameters: dict[str, fem.Constant] = {}
        mesh = surface.mesh
        self._gdim = gdim = mesh.geometry.dim
        degree = _displacement_degree(u, mesh, name)
        self.quadrature = surface.quadrature(degree)

        self.weight = self._to_ufl("weight", 1.0 if weight is None else weight)
        self._scale: fem.Function | None = None  # E/h, if a stiffness is Scaled
        self._scale_known = False
        parameters = {n: self._parameter(n, v) for n, v in law.parameters().items()}
        if modulus is not None:
            self.set_modulus(modulus)

        x = ufl.SpatialCoordinate(mesh)
        shift = support.displacement
        if shift is not None:
            shift = self._to_ufl("displacement", shift)
            if shift.ufl_shape != (gdim,):
                raise ValueError(
                    f"{name}: displacement of the support has shape {shift.ufl_shape}; the mesh "
                    f"needs ({gdim},)"
                )
        placement = support.place(x, shift, lambda v: self._to_ufl("support", v))
        length = ufl.sqrt(ufl.dot(placement.direction, placement.direction))
        normal = placement.direction / length
        opening = placement.gap
        if gap is not None:
            opening = self._to_ufl("gap", gap)
            if shift is not None:
                opening = opening + ufl.dot(shift, normal)

        m = law.n_modes(gdim)
        fields = {"opening": 0, "penetration": 0, "normal_traction": 0}
        if law.has_friction:
            fields |= {"traction": gdim, "jump": gdim, "slip": m}
        self.history = History(self.quadrature, fields)

        jump = u if shift is None else u - shift
        increment = traction = None
        if law.has_friction:
            # The old traction and displacement are taken along the present normal: the support
            # may have moved on since the last commit.
            moved = jump - self.history.ufl("jump")
            increment = moved - ufl.dot(moved, normal) * normal
            traction = self.history.ufl("traction")
            traction = traction - ufl.dot(traction, normal) * normal
        kinematics = Kinematics(opening, ufl.dot(u, normal), normal, increment, traction)
        response = law.response(kinematics, parameters)
        self._kinematics, self._parameters_ufl = kinematics, parameters
        self._normal = normal
        total = response.normal_traction * normal
        if response.traction is not None:
            total = total + response.traction
        self._traction = total

        expressions = {
            "x": x,
            "normal": normal,
            "direction_length": length,
            "weight": self.weight,
            "gap": opening,
            "normal_displacement": kinematics.normal_displacement,
            "opening": response.opening,
            "penetration": response.penetration,
            "normal_traction": response.normal_traction,
        } | {f"parameter {n}": v for n, v in parameters.items()}
        if law.has_friction:
            expressions |= {
                "increment": increment,
                "old_traction": traction,
                "traction": response.traction,
                "limit": response.limit,
                "jump": jump,
                "slip_increment": ufl.as_vector(response.slip),
            }
        self._evaluator = PointEvaluator(self.quadrature, expressions)
        self._points: dict[str, Array] | None = None
        # Which share of k_n and k_t enters the approximate tangent at each point.
        self._shares = fem.Function(self.quadrature.space(2), name="shares")
        self._shares.x.array[:] = 1.0

    # ---- forms -----------------------------------------------------------------------------------

    def form(self, v: ufl.Argument) -> ufl.Form:
        """Virtual work of contact, to be **added** to a residual: -∫ (r_n v_n + τ·v_t) (46, 55).

        Args:
            v: Test function of ``u``'s space. Compile with ``entity_maps=contact.entity_maps``.

        Raises:
            ValueError: A stiffness is `Scaled` and the modulus is not known.
        """
        if self._scale is not None and not self._scale_known:
            raise ValueError(
                f"{self.name}: k_n or k_t is a multiple of E/h, and E is not known; give "
                "Contact(modulus=...), give k_n and k_t in stress/length, or use ContactProblem, "
                "which measures E in the bulk form"
            )
        return -self.weight * ufl.dot(self._traction, v) * self.quadrature.ds

    def potential(self) -> ufl.Form:
        """Energy whose derivative by ``u`` is `form` (eq. 19, 43).

        Raises:
            ValueError: The law has none (Coulomb).
        """
        density = self.law.potential(self._kinematics, self._parameters_ufl)
        return self.weight * density * self.quadrature.ds

    def tangent(self, v: ufl.Argument, du: ufl.Argument) -> ufl.Form:
        """Consistent tangent, the derivative of `form`; unsymmetric where Coulomb slips."""
        return ufl.derivative(self.form(v), self.u, du)

    def stiffness(self, v: ufl.Argument, du: ufl.Argument) -> ufl.Form:
        """Symmetric stiffness a K_n + b K_t of section 5, a and b set by `set_shares`."""
        v_n, du_n = ufl.dot(v, self._normal), ufl.dot(du, self._normal)
        integrand = 0
        if self.law.unilateral:
            integrand += self._shares[0] * self._parameters_ufl["k_n"] * v_n * du_n
        if self.law.has_friction:
            tangential = ufl.dot(v, du) - v_n * du_n
            integrand += self._shares[1] * self._parameters_ufl["k_t"] * tangential
        return self.weight * integrand * self.quadrature.ds

    def set_shares(self, normal: npt.ArrayLike, tangential: npt.ArrayLike) -> None:
        """Set the shares a, b of `stiffness`: numbers or arrays over owned points. Collective."""
        rows = self._shares.x.array.reshape(-1, 2)[: self.quadrature.n_points]
        rows[:, 0], rows[:, 1] = normal, tangential
        self._shares.x.scatter_forward()

    # ---- parameters ------------------------------------------------------------------------------

    @property
    def needs_modulus(self) -> bool:
        """Whether a stiffness is `Scaled` and still waits for `set_modulus`."""
        return self._scale is not None and not self._scale_known

    def set_modulus(self, modulus: Any) -> None:
        """Fix E for `Scaled` stiffnesses: a number or a function, one value a cell. Collective."""
        if self._scale is None:
            return
        if not isinstance(modulus, fem.Function):
            if not (np.ndim(modulus) == 0 and np.isfinite(modulus) and modulus > 0):
                raise ValueError(
                    f"{self.name}: modulus is {modulus!r}; it must be a positive number"
                )
            value = float(modulus)
            modulus = fem.Function(fem.functionspace(self.surface.mesh, ("DG", 0)))
            modulus.x.array[:] = value
        scale = accuracy.modulus_over_height(self.surface, modulus)
        self._scale.x.array[:] = scale.x.array
        self._scale_known = True

    def _parameter(self, name: str, value: Any) -> ufl.core.expr.Expr:
        if isinstance(value, Scaled):
            if self._scale is None:
                self._scale = fem.Function(fem.functionspace(self.surface.submesh, ("Lagrange", 1)))
                self._scale.x.array[:] = 1.0
            return self._to_ufl(name, value.factor) * self._scale
        positive = name.startswith("k_")
        if np.ndim(value) == 0 and isinstance(value, int | float | np.number):
            bad = not np.isfinite(value) or value < 0 or (positive and value == 0)
            if bad:
                raise ValueError(_range_error(self.name, name, float(value)))
        expression = self._to_ufl(name, value)
        if expression.ufl_shape != ():
            raise ValueError(
                f"{self.name}: {name} has shape {expression.ufl_shape}; it must be a scalar"
            )
        return expression

    def _to_ufl(self, name: str, value: Any) -> ufl.core.expr.Expr:
        """Numbers become constants of the mesh, so that their value is not compiled in."""
        if isinstance(value, ufl.core.expr.Expr):
            return value
        try:
            array = np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise TypeError(
                f"{self.name}: {name} is {value!r}; give numbers, a fem.Constant, a fem.Function "
                "or a UFL expression"
            ) from None
        constant = fem.Constant(self.surface.mesh, array)
        if name != "support":
            self.parameters[name] = constant
        return constant

    # ---- state -----------------------------------------------------------------------------------

    def evaluate(self) -> None:
        """Evaluate gap, reactions and slip at the present ``u``; the history stays. Collective."""
        self._points = self._evaluator()

    def check_input(self) -> None:
        """Refuse parameters that are out of range or not finite at some point of Γc. Collective.

        Raises:
            ValueError: On all ranks.
        """
        comm = self.surface.mesh.comm
        self.evaluate()
        points = self._values
        shortest = global_min(comm, points["direction_length"], empty=1.0)
        if not shortest > 0.0:
            raise ValueError(
                f"{self.name}: the normal of the support has length {shortest:g} at a point of Γc; "
                "it must point from the body to the support everywhere"
            )
        for key, values in points.items():
            # Only what was given: what follows from u is checked with u.
            if key.startswith("parameter ") or key in ("gap", "weight", "normal"):
                name = key.removeprefix("parameter ")
                low, high = global_min(comm, values), global_max(comm, values)
                if not (np.isfinite(low) and np.isfinite(high)):
                    raise ValueError(
                        f"{self.name}: {name} is not finite at a point of Γc (values from {low:g} "
                        f"to {high:g}); check the expression or function it was given by"
                    )
                if key.startswith("parameter ") and (low < 0 or (low == 0 and name[:2] == "k_")):
                    raise ValueError(_range_error(self.name, name, low))
        if global_min(comm, points["weight"]) < 0:
            raise ValueError(f"{self.name}: weight is negative at a point of Γc")

    def commit(self) -> None:
        """Make the state at the present ``u`` the history of the next increment. Collective."""
        self.evaluate()
        points = self._values
        values = {n: points[n] for n in ("opening", "penetration", "normal_traction")}
        if self.law.has_friction:
            values |= {
                "traction": points["traction"],
                "jump": points["jump"],
                "slip": self.history.values("slip") + points["slip_increment"],
            }
        self.history.commit(values)

    @property
    def _values(self) -> dict[str, Array]:
        if self._points is None:
            self.evaluate()
            assert self._points is not None
        return self._points

    # ---- results, at the last evaluated state ----------------------------------------------------

    @property
    def values(self) -> Mapping[str, Array]:
        """All fields of the last evaluation at this rank's points, by name; see the properties."""
        return self._values

    @property
    def points(self) -> Array:
        """Coordinates of this rank's quadrature points, shape (n_points, gdim), in length."""
        return self._values["x"]

    @property
    def gap(self) -> Array:
        """Open distance s - u_n = δ₊ - δ₋ (eq. 6), shape (n_points,), in length."""
        return self._values["opening"] - self._values["penetration"]

    @property
    def pressure(self) -> Array:
        """-r_n ≥ 0, shape (n_points,), in stress."""
        return -self._values["normal_traction"]

    @property
    def tangential_traction(self) -> Array:
        """τ on the body, shape (n_points, gdim), in stress; zeros without friction."""
        if self.law.has_friction:
            return self._values["traction"]
        return np.zeros_like(self.points)

    @property
    def traction(self) -> Array:
        """r_n n + τ on the body, shape (n_points, gdim), in stress."""
        values = self._values
        return values["normal_traction"][:, None] * values["normal"] + self.tangential_traction

    @property
    def tangential_displacement(self) -> Array:
        """u_t (eq. 21), shape (n_points, gdim), in length; zeros without friction."""
        if not self.law.has_friction:
            return np.zeros_like(self.points)
        jump, normal = self._values["jump"], self._values["normal"]
        return jump - np.sum(jump * normal, axis=1)[:, None] * normal

    @property
    def slip_increment(self) -> Array:
        """Δβ of every mode since the last commit, shape (n_points, n_modes), in length."""
        if self.law.has_friction:
            return self._values["slip_increment"]
        return np.zeros((self.quadrature.n_points, 0))

    @property
    def slip(self) -> Array:
        """Accumulated slip β of every mode, committed, shape (n_points, n_modes), in length."""
        if self.law.has_friction:
            return self.history.values("slip")
        return np.zeros((self.quadrature.n_points, 0))

    @property
    def status(self) -> npt.NDArray[np.int8]:
        """`Status` in the last evaluated increment, shape (n_points,).

        Without friction a closed point counts as slip: nothing holds it.
        """
        closed = self._values["normal_traction"] < 0
        status = np.where(closed, Status.SLIP, Status.OPEN).astype(np.int8)
        if self.law.has_friction:
            held = closed & np.all(self._values["slip_increment"] == 0, axis=1)
            status[held] = Status.STICK
        return status

    @property
    def measure(self) -> Array:
        """Area that each point stands for, the contact's weight included, shape (n_points,)."""
        return self.quadrature.weights * self._values["weight"]

    def resultants(self) -> Resultants:
        """Forces, area and counts. Collective."""
        comm = self.surface.mesh.comm
        measure, status = self.measure, self.status
        tangential = np.linalg.norm(self.tangential_traction, axis=1)
        force = global_sum(comm, measure @ self.traction)
        sums = global_sum(
            comm,
            [
                measure @ self.pressure,
                measure @ tangential,
                measure @ (status != Status.OPEN),
                *(np.count_nonzero(status == s) for s in Status),
            ],
        )
        return Resultants(
            force=force,
            normal_force=float(sums[0]),
            tangential_force=float(sums[1]),
            area=float(sums[2]),
            open=int(sums[3]),
            stick=int(sums[4]),
            slip=int(sums[5]),
            max_pressure=global_max(comm, self.pressure),
            max_penetration=global_max(comm, self._values["penetration"]),
        )

    def gather(self) -> dict[str, Array]:
        """All of Γc on every rank, for pictures and tables, ordered by coordinates. Collective.

        Returns:
            Arrays over all points: x, normal, gap, pressure, tangential_traction, slip (sum of the
            modes), status, measure.
        """
        d = self._gdim
        rows = np.column_stack(
            [
                self.points,
                self._values["normal"],
                self.tangential_traction,
                self.gap,
                self.pressure,
                self.slip.sum(axis=1),
                self.status,
                self.measure,
            ]
        )
        rows = gather_rows(self.surface.mesh.comm, rows)
        rows = rows[np.lexsort(rows[:, :d].T[::-1])]
        vectors = {"x": rows[:, :d], "normal": rows[:, d : 2 * d]}
        vectors["tangential_traction"] = rows[:, 2 * d : 3 * d]
        names = ("gap", "pressure", "slip", "status", "measure")
        return vectors | {n: rows[:, 3 * d + i] for i, n in enumerate(names)}


def _range_error(contact: str, name: str, value: float) -> str:
    wanted = "greater than zero (stress/length)" if name[:2] == "k_" else "zero or greater"
    return f"{contact}: {name} is {value:g} at a point of Γc; it must be finite and {wanted}"


def _displacement_degree(u: fem.Function, mesh: Any, name: str) -> int:
    """Check that ``u`` is a displacement of ``mesh`` and return its element's degree."""
    if not isinstance(u, fem.Function):
        raise ValueError(f"{name}: u is a {type(u).__name__}; it must be a dolfinx fem.Function")
    gdim = mesh.geometry.dim
    if u.ufl_shape != (gdim,):
        raise ValueError(
            f"{name}: u has shape {u.ufl_shape}; a displacement on this mesh has shape ({gdim},): "
            f'make its space with functionspace(mesh, ("Lagrange", degree, ({gdim},)))'
        )
    if u.function_space.mesh is not mesh and u.function_space.mesh != mesh:
        raise ValueError(f"{name}: u lives on another mesh than the contact surface")
    element = u.function_space.ufl_element()
    if u.function_space.dofmap.bs != gdim or element.pullback != ufl.identity_pullback:
        raise ValueError(
            f"{name}: u is in {element}; it must be in a vector-valued Lagrange space, "
            f'functionspace(mesh, ("Lagrange", degree, ({gdim},)))'
        )
    if element.degree < 1:
        raise ValueError(f"{name}: u has degree {element.degree}; a displacement needs degree 1 up")
    return int(element.degree)
