"""A law at the points of Γc: what it makes of the jump there, compiled when first asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.apply_derivatives import apply_derivatives
from ufl.corealg.traversal import traverse_unique_terminals
from ufl.domain import extract_unique_domain

from fenics_contact.contact.point_geometry import LocalKinematics, PointGeometry
from fenics_contact.laws.base import ContactTraction, Law, PointKinematics
from fenics_contact.laws.return_maps import positive_part
from fenics_contact.parallel import global_max, global_min
from fenics_contact.surface.surface import PointEvaluator, SurfaceQuadrature
from fenics_contact.types import Array

__all__ = ["PointLaw", "PointTangent"]


# The size of the mesh times this is a penetration that is next to none.
_BARELY = 1e-8


@dataclass(frozen=True)
class PointTangent:
    """Derivatives of the traction at the points.

    Attributes:
        by_jump: By the displacement of the body, (n_points, gdim, gdim) (stress/length); where
            `Pairs.local_map` is one, of the forces on the local unknowns by these.
        by_shift: By that of the obstacle, likewise; None where no component of it is free.
        spun: By a turn of body and obstacle together, ω × the traction, (n_points, gdim) (stress);
            None where the obstacle is not turned by a moment. Anisotropic friction, whose direction
            stays as it is, has some more.
    """

    by_jump: Array
    by_shift: Array | None = None
    spun: Array | None = None

    def scaled(self, factor: Array) -> PointTangent:
        """The derivatives times a factor at each point, (n_points,)."""

        def times(values: Array) -> Array:
            return values * factor.reshape(-1, *[1] * (values.ndim - 1))

        rest = (None if part is None else times(part) for part in (self.by_shift, self.spun))
        return PointTangent(times(self.by_jump), *rest)


class PointLaw:
    """What a law makes of displacements at the points, compiled when first asked for.

    Args:
        kinematics: What the law sees of displacements.
        jump: Displacement of the body at the points, of that opposite taken away.
        acts: 1 at points at which it acts, 0 at others (UFL); None: it acts at all.
        given: ``geometry`` as expressions on Γc, which the derivatives by ``free`` are of.
        free: Unknown components of the obstacle's displacement in these, `Inputs.free_shift`.

    Attributes:
        law: The law.
        geometry: What it sees of the points apart from displacements.
    """

    def __init__(
        self,
        law: Law,
        geometry: PointGeometry,
        kinematics: LocalKinematics,
        quadrature: SurfaceQuadrature,
        jump: fem.Function,
        *,
        mask: Any,
        given: PointGeometry,
        free: Mapping[int, Any],
    ) -> None:
        self.law, self.geometry = law, geometry
        self._kinematics, self._quadrature, self._jump = kinematics, quadrature, jump
        self._mask, self._given, self._free = mask, given, free
        self._gdim = quadrature.surface.mesh.geometry.dim

    def with_law(self, law: Law, parameters: Mapping[str, Any]) -> PointLaw:
        """Another law at the same points, with parameters of its own."""
        return PointLaw(
            law,
            replace(self.geometry, parameters=parameters),
            self._kinematics,
            self._quadrature,
            self._jump,
            mask=self._mask,
            given=self._given,
            free=self._free,
        )

    # ---- as UFL ----------------------------------------------------------------------------------

    def _there(self, value: Any) -> Any:
        """A value at points at which the law acts, 0 at the others; None stays None."""
        return value if self._mask is None or value is None else self._mask * value

    def _point_kinematics(
        self, jump: Any = None, geometry: PointGeometry | None = None
    ) -> PointKinematics:
        jump = self._jump if jump is None else jump
        return self._kinematics(jump, self.law, geometry or self.geometry)

    def _response(
        self, felt: PointKinematics, geometry: PointGeometry | None = None
    ) -> ContactTraction:
        """What the law answers, nothing at points at which it does not act."""
        response = self.law.contact_traction(felt, (geometry or self.geometry).parameters)
        parts = {f.name: getattr(response, f.name) for f in fields(response)}
        slip = tuple(self._there(mode) for mode in parts.pop("slip"))
        return replace(response, **{n: self._there(v) for n, v in parts.items()}, slip=slip)

    def traction(self, jump: Any, geometry: PointGeometry | None = None) -> Any:
        """r_n n + τ on the body, at a displacement (UFL)."""
        geometry = geometry or self.geometry
        felt = self._point_kinematics(jump, geometry)
        response = self._response(felt, geometry)
        total = response.normal_traction * felt.normal
        return total if response.traction is None else total + response.traction

    def potential(self, jump: Any = None) -> Any:
        """Potential per area, at a displacement (UFL)."""
        return self._there(
            self.law.potential(self._point_kinematics(jump), self.geometry.parameters)
        )

    # ---- as numbers ------------------------------------------------------------------------------

    def evaluate_traction(self) -> Array:
        """r_n n + τ, (n_points, gdim) (stress). Collective."""
        return self._traction()["traction"]

    @cached_property
    def _traction(self) -> PointEvaluator:
        return self._evaluator({"traction": self.traction(self._jump)})

    def evaluate_potential(self) -> Array:
        """The potential per area, (n_points,). Collective."""
        return self._potential()["potential"]

    @cached_property
    def _potential(self) -> PointEvaluator:
        return self._evaluator({"potential": self.potential()})

    def evaluate_tangent(self) -> PointTangent:
        """Derivatives of the traction. Collective."""
        rows, d = self._tangent(), range(self._gdim)
        by_jump = np.stack([rows[f"jump {i}"] for i in d], axis=1)
        if not self._free:
            return PointTangent(by_jump)
        columns, none = self._by_shift(), np.zeros(by_jump.shape[:2])
        return PointTangent(by_jump, np.stack([columns.get(str(i), none) for i in d], axis=2))

    @cached_property
    def _tangent(self) -> PointEvaluator:
        jump = ufl.variable(self._jump)
        rows = ufl.diff(self.traction(jump), jump)
        return self._evaluator({f"jump {i}": rows[i, :] for i in range(self._gdim)})

    @cached_property
    def _by_shift(self) -> PointEvaluator:
        """By the free displacement of the obstacle, in its own expressions."""
        geometry = replace(self._given, parameters=self.geometry.parameters)
        traction = self.traction(self._jump, geometry)
        columns = {str(i): ufl.diff(traction, shift) for i, shift in self._free.items()}
        return PointEvaluator(self._quadrature, columns)

    def evaluate_yield(self) -> tuple[Array, Array]:
        """The law's yield functions and their gradients. Collective.

        Returns:
            g_j(τ, bound) (stress), (n_points, n_modes), and ∂g_j/∂τ, (n_points, n_modes, gdim).
        """
        found = self._yield()
        gradients = [found[name] for name in found if name != "functions"]
        return found["functions"], np.stack(gradients, axis=1)

    @cached_property
    def _yield(self) -> PointEvaluator:
        felt = self._point_kinematics()
        response, parameters = self._response(felt), self.geometry.parameters
        traction = ufl.variable(response.traction)
        functions = self.law.yield_functions(felt, traction, response.friction_bound, parameters)
        rows = {f"gradient {j}": ufl.diff(g, traction) for j, g in enumerate(functions)}
        return self._evaluator({"functions": ufl.as_vector(functions)} | rows)

    def prepare(self) -> None:
        """Compile what `evaluate` needs. Collective."""
        _ = self._all

    def evaluate(self) -> dict[str, Array]:
        """All that a law tells, by name; see `PointValues`. Collective."""
        found = self._all()
        if self.law.has_friction:
            found["friction_bound_ratio"] = self._ratio(found)
        elif self.law.has_tangential:
            resists = [
                np.any(found[f"tangential_stiffness {i}"], axis=1) for i in range(self._gdim)
            ]
            found["friction_bound_ratio"] = np.where(np.any(resists, axis=0), np.inf, 0.0)
        return found

    def _ratio(self, found: dict[str, Array]) -> Array:
        """`PointValues.friction_bound_ratio`; what it was made of is taken out."""
        found.setdefault("circumradius", np.full(len(found["friction_bound"]), np.inf))
        if not self._bound_is_linear:
            return np.full(len(found["friction_bound"]), np.inf)
        slope, cohesion = found.pop("slope of the bound"), found.pop("cohesion")
        radius = np.where(slope > 0, found["circumradius"], 0.0)
        return np.where(cohesion > 0, np.inf, slope * radius)

    @property
    def bound_depends_on_motion(self) -> bool:
        """Whether the friction bound is a function of the motion itself, beside the pressure."""
        return self._bound[0]

    @property
    def _bound_is_linear(self) -> bool:
        """Whether the friction bound is m p + c, with m and c from the data alone."""
        return self._bound[1]

    @cached_property
    def _bound(self) -> tuple[bool, bool]:
        """What the expression of the friction bound says of itself; see the properties."""
        felt = self._point_kinematics()
        names = ["gap", "tangential_displacement", "tangential_increment", "multiplier"]
        given = {name: getattr(felt, name) for name in names}
        motion = {n: ufl.variable(v) for n, v in given.items() if v is not None}
        pressure = ufl.variable(self.geometry.gap)  # any scalar
        bound = self.law.friction_bound(replace(felt, **motion), pressure, self.geometry.parameters)
        if any(_depends(bound, variable) for variable in motion.values()):
            return True, False
        return False, not _depends(ufl.diff(bound, pressure), pressure)

    @cached_property
    def _all(self) -> PointEvaluator:
        law, parameters, felt = self.law, self.geometry.parameters, self._point_kinematics()
        response = self._response(felt)
        told = {
            "normal_displacement": self.geometry.gap - felt.gap,
            "opening": self._there(positive_part(felt.gap)),
            "penetration": self._there(positive_part(-felt.gap)),
            "normal_traction": response.normal_traction,
            "stored": self._there(law.stored(felt, response, parameters)),
        }
        if law.has_own_normal:
            told |= self._own_normal(felt, response)
        if law.has_tangential:
            stiffness = law.tangential_stiffness(felt, parameters)
            told |= {"traction": response.traction}
            told |= {f"tangential_stiffness {i}": stiffness[i, :] for i in range(self._gdim)}
        if law.has_friction:
            pressure = ufl.variable(-response.normal_traction)
            bound = law.friction_bound(felt, pressure, parameters)
            told |= {
                "bound_of_law": self._there(bound),
                "friction_bound_slope": self._there(ufl.diff(bound, pressure)),
                "increment": felt.tangential_increment,
                "old_traction": felt.traction,
                "friction_bound": response.friction_bound,
                "dissipated": self._there(law.dissipated(felt, response, parameters)),
                "slip_increment": ufl.as_vector(response.slip),
            }
            circumradius = law.circumradius(parameters)
            if circumradius is not None:
                told["circumradius"] = circumradius
            if self._bound_is_linear:
                told |= {
                    "slope of the bound": ufl.diff(bound, pressure),
                    "cohesion": law.friction_bound(felt, ufl.as_ufl(0.0), parameters),
                }
        if felt.multiplier is not None:
            told |= {"multiplier": felt.multiplier}
            if law.has_friction:
                assert felt.traction is not None
                borne = felt.traction - response.traction
                told["elastic_slip"] = law.elastic_displacement(felt, borne, parameters)
        return self._evaluator(told)

    @cached_property
    def _barely(self) -> fem.Constant:
        """A length that is nothing beside the mesh, of laws with a normal of their own. Collective.

        It is measured where it is asked for alone.
        """
        surface = self._quadrature.surface
        comm, x = surface.mesh.comm, surface.mesh.geometry.x
        return fem.Constant(surface.submesh, _BARELY * (global_max(comm, x) - global_min(comm, x)))

    def _own_normal(self, felt: PointKinematics, response: ContactTraction) -> dict[str, Any]:
        """What is known of r_n that does not follow from k_n (UFL): stiffness, and another way."""
        law, parameters = self.law, self.geometry.parameters
        gap = ufl.variable(felt.gap)
        at_variable = replace(felt, gap=gap)
        # Where nothing acts the stiffness is that of a point that has just closed.
        mask = ufl.ne(response.normal_traction, 0)
        at_closed = replace(felt, gap=ufl.conditional(mask, felt.gap, -self._barely))
        return {
            "normal_reaction": ufl.diff(law.normal_potential(at_variable, parameters), gap),
            "normal_stiffness": law.normal_stiffness(at_closed, parameters),
        }

    def _evaluator(self, expressions: Mapping[str, Any]) -> PointEvaluator:
        for expression in expressions.values():
            self._check_own(expression)
        return PointEvaluator(self._quadrature, expressions, by_points=True)

    def _check_own(self, expression: Any) -> None:
        """Refuse a law that has functions, constants, or places not from its parameters.

        Those are checked, and told apart in checkpoints.

        Raises:
            ValueError: It says what.
        """
        submesh = self._quadrature.surface.submesh
        for item in traverse_unique_terminals(ufl.as_ufl(expression)):
            there = True
            if isinstance(item, fem.Constant):
                there = item is self._barely
            elif isinstance(item, fem.Function):
                there = item.function_space.mesh is submesh or item.function_space.mesh == submesh
            elif isinstance(item, ufl.classes.GeometricQuantity):
                there = extract_unique_domain(item) == submesh.ufl_domain()
            if not there:
                what = getattr(item, "name", None) or f"a {type(item).__name__}"
                raise ValueError(
                    f"{type(self.law).__name__} uses {what} in contact_traction or another method; "
                    "a law may depend on its kinematics and parameters only: make it a parameter, "
                    'a field of the class, and use parameters["..."]'
                )


def _depends(expression: Any, variable: Any) -> bool:
    """Whether an expression is a function of a `ufl.variable`, its derivatives evaluated."""
    plain = apply_derivatives(apply_algebra_lowering(ufl.as_ufl(expression)))
    return variable.label() in set(traverse_unique_terminals(plain))
