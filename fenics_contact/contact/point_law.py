"""A contact law at the points of Γc: tractions and tangent, compiled at the first evaluation."""

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

# Negligible penetration, relative to the size of the mesh.
_CLOSURE_RATIO = 1e-8


@dataclass(frozen=True)
class PointTangent:
    """Derivatives of the traction at the points.

    Attributes:
        by_jump: By the jump, (n_points, gdim, gdim) (stress/length); of the point forces by the
            local unknowns if `Pairs.local_map` is not None.
        by_shift: By the displacement of the obstacle; None if no component is free.
        by_rotation: By a common rotation of body and obstacle, ω × the traction, (n_points, gdim)
            (stress), without the fixed direction of anisotropic friction; None if no moment rotates
            the obstacle.
    """

    by_jump: Array
    by_shift: Array | None = None
    by_rotation: Array | None = None

    def scale(self, factor: Array) -> PointTangent:
        """Return the derivatives times a factor at each point, (n_points,)."""

        def times(values: Array) -> Array:
            return values * factor.reshape(-1, *[1] * (values.ndim - 1))

        others = (
            None if part is None else times(part) for part in (self.by_shift, self.by_rotation)
        )
        return PointTangent(times(self.by_jump), *others)


class PointLaw:
    """A contact law as a function of the jump at the points, compiled at the first evaluation.

    Args:
        kinematics: Local kinematics at a jump.
        jump: Displacement of the body at the points, minus that of an opposing body.
        mask: 1 at points at which the law acts, 0 at others (UFL); None for 1.
        surface_geometry: ``geometry`` as expressions on Γc, for the derivatives by ``free_shift``.
        free_shift: Unknown components of the obstacle's displacement, `Inputs.free_shift`.

    Attributes:
        law: The law.
        geometry: Geometry and parameters of the law at the points.
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
        surface_geometry: PointGeometry,
        free_shift: Mapping[int, Any],
    ) -> None:
        self.law, self.geometry = law, geometry
        self._kinematics, self._quadrature, self._jump = kinematics, quadrature, jump
        self._mask, self._surface_geometry, self._free_shift = mask, surface_geometry, free_shift
        self._gdim = quadrature.surface.mesh.geometry.dim

    def with_law(self, law: Law, parameters: Mapping[str, Any]) -> PointLaw:
        """Return another law at the same points, with its own parameters."""
        return PointLaw(
            law,
            replace(self.geometry, parameters=parameters),
            self._kinematics,
            self._quadrature,
            self._jump,
            mask=self._mask,
            surface_geometry=self._surface_geometry,
            free_shift=self._free_shift,
        )

    # ---- as UFL ----------------------------------------------------------------------------------

    def _restrict(self, value: Any) -> Any:
        """Return a value times the mask; None stays None."""
        return value if self._mask is None or value is None else self._mask * value

    def _point_kinematics(
        self, jump: Any = None, geometry: PointGeometry | None = None
    ) -> PointKinematics:
        jump = self._jump if jump is None else jump
        return self._kinematics(jump, self.law, geometry or self.geometry)

    def _contact_traction(
        self, local: PointKinematics, geometry: PointGeometry | None = None
    ) -> ContactTraction:
        """Return the tractions of the law, zero at masked points."""
        result = self.law.contact_traction(local, (geometry or self.geometry).parameters)
        parts = {f.name: getattr(result, f.name) for f in fields(result)}
        slip = tuple(self._restrict(mode) for mode in parts.pop("slip"))
        return replace(result, **{n: self._restrict(v) for n, v in parts.items()}, slip=slip)

    def traction(self, jump: Any, geometry: PointGeometry | None = None) -> Any:
        """Return r_n n + τ on the body at a jump (UFL)."""
        geometry = geometry or self.geometry
        local = self._point_kinematics(jump, geometry)
        result = self._contact_traction(local, geometry)
        total = result.normal_traction * local.normal
        return total if result.traction is None else total + result.traction

    def potential(self, jump: Any = None) -> Any:
        """Return the potential per area at a jump (UFL)."""
        return self._restrict(
            self.law.potential(self._point_kinematics(jump), self.geometry.parameters)
        )

    # ---- as numbers ------------------------------------------------------------------------------

    def evaluate_traction(self) -> Array:
        """Evaluate r_n n + τ, (n_points, gdim) (stress). Collective."""
        return self._traction()["traction"]

    @cached_property
    def _traction(self) -> PointEvaluator:
        return self._evaluator({"traction": self.traction(self._jump)})

    def evaluate_potential(self) -> Array:
        """Evaluate the potential per area, (n_points,). Collective."""
        return self._potential()["potential"]

    @cached_property
    def _potential(self) -> PointEvaluator:
        return self._evaluator({"potential": self.potential()})

    def evaluate_tangent(self) -> PointTangent:
        """Evaluate the derivatives of the traction. Collective."""
        rows, d = self._tangent(), range(self._gdim)
        by_jump = np.stack([rows[f"jump {i}"] for i in d], axis=1)
        if not self._free_shift:
            return PointTangent(by_jump)
        columns, zeros = self._by_shift(), np.zeros(by_jump.shape[:2])
        return PointTangent(by_jump, np.stack([columns.get(str(i), zeros) for i in d], axis=2))

    @cached_property
    def _tangent(self) -> PointEvaluator:
        jump = ufl.variable(self._jump)
        rows = ufl.diff(self.traction(jump), jump)
        return self._evaluator({f"jump {i}": rows[i, :] for i in range(self._gdim)})

    @cached_property
    def _by_shift(self) -> PointEvaluator:
        """Derivatives by the free displacement of the obstacle, with its own expressions."""
        geometry = replace(self._surface_geometry, parameters=self.geometry.parameters)
        traction = self.traction(self._jump, geometry)
        columns = {str(i): ufl.diff(traction, shift) for i, shift in self._free_shift.items()}
        return PointEvaluator(self._quadrature, columns)

    def evaluate_yield(self) -> tuple[Array, Array]:
        """Evaluate the yield functions and their gradients by the traction. Collective.

        They are (n_points, n_modes) (stress) and (n_points, n_modes, gdim).
        """
        samples = self._yield()
        gradients = [samples[name] for name in samples if name != "functions"]
        return samples["functions"], np.stack(gradients, axis=1)

    @cached_property
    def _yield(self) -> PointEvaluator:
        local = self._point_kinematics()
        result, parameters = self._contact_traction(local), self.geometry.parameters
        traction = ufl.variable(result.traction)
        functions = self.law.yield_functions(local, traction, result.friction_bound, parameters)
        rows = {f"gradient {j}": ufl.diff(g, traction) for j, g in enumerate(functions)}
        return self._evaluator({"functions": ufl.as_vector(functions)} | rows)

    def prepare(self) -> None:
        """Compile the expressions of `evaluate`. Collective."""
        _ = self._all_fields

    def evaluate(self) -> dict[str, Array]:
        """Evaluate all fields of `PointValues` that the law determines, by name. Collective."""
        samples = self._all_fields()
        if self.law.has_friction:
            samples["friction_bound_ratio"] = self._friction_bound_ratio(samples)
        elif self.law.has_tangential:
            rows = [np.any(samples[f"tangential_stiffness {i}"], axis=1) for i in range(self._gdim)]
            samples["friction_bound_ratio"] = np.where(np.any(rows, axis=0), np.inf, 0.0)
        return samples

    def _friction_bound_ratio(self, samples: dict[str, Array]) -> Array:
        """Return `PointValues.friction_bound_ratio`; the fields for it are removed."""
        samples.setdefault("circumradius", np.full(len(samples["friction_bound"]), np.inf))
        if not self._bound_is_linear:
            return np.full(len(samples["friction_bound"]), np.inf)
        slope, cohesion = samples.pop("slope of the bound"), samples.pop("cohesion")
        radius = np.where(slope > 0, samples["circumradius"], 0.0)
        return np.where(cohesion > 0, np.inf, slope * radius)

    @property
    def bound_depends_on_motion(self) -> bool:
        """Whether the friction bound depends on the kinematics, besides the pressure."""
        return self._bound_dependence[0]

    @property
    def _bound_is_linear(self) -> bool:
        """Whether the friction bound is m p + c, with m and c independent of the kinematics."""
        return self._bound_dependence[1]

    @cached_property
    def _bound_dependence(self) -> tuple[bool, bool]:
        """Whether the friction bound depends on the kinematics, and whether it is linear."""
        local = self._point_kinematics()
        names = ["gap", "tangential_displacement", "tangential_increment", "multiplier"]
        given = {name: getattr(local, name) for name in names}
        variables = {n: ufl.variable(v) for n, v in given.items() if v is not None}
        pressure = ufl.variable(self.geometry.gap)  # any scalar
        local = replace(local, **variables)
        bound = self.law.friction_bound(local, pressure, self.geometry.parameters)
        if any(_depends_on(bound, variable) for variable in variables.values()):
            return True, False
        return False, not _depends_on(ufl.diff(bound, pressure), pressure)

    @cached_property
    def _all_fields(self) -> PointEvaluator:
        law, parameters, local = self.law, self.geometry.parameters, self._point_kinematics()
        result = self._contact_traction(local)
        expressions = {
            "normal_displacement": self.geometry.gap - local.gap,
            "opening": self._restrict(positive_part(local.gap)),
            "penetration": self._restrict(positive_part(-local.gap)),
            "normal_traction": result.normal_traction,
            "stored": self._restrict(law.stored(local, result, parameters)),
        }
        if law.has_own_normal:
            expressions |= self._own_normal_fields(local, result)
        if law.has_tangential:
            stiffness = law.tangential_stiffness(local, parameters)
            expressions |= {"traction": result.traction}
            expressions |= {f"tangential_stiffness {i}": stiffness[i, :] for i in range(self._gdim)}
        if law.has_friction:
            pressure = ufl.variable(-result.normal_traction)
            bound = law.friction_bound(local, pressure, parameters)
            expressions |= {
                "law_friction_bound": self._restrict(bound),
                "friction_bound_slope": self._restrict(ufl.diff(bound, pressure)),
                "increment": local.tangential_increment,
                "old_traction": local.traction,
                "friction_bound": result.friction_bound,
                "dissipated": self._restrict(law.dissipated(local, result, parameters)),
                "slip_increment": ufl.as_vector(result.slip),
            }
            circumradius = law.circumradius(parameters)
            if circumradius is not None:
                expressions["circumradius"] = circumradius
            if self._bound_is_linear:
                expressions |= {
                    "slope of the bound": ufl.diff(bound, pressure),
                    "cohesion": law.friction_bound(local, ufl.as_ufl(0.0), parameters),
                }
        if local.multiplier is not None:
            expressions |= {"multiplier": local.multiplier}
            if law.has_friction:
                assert local.traction is not None
                change = local.traction - result.traction
                expressions["elastic_slip"] = law.elastic_displacement(local, change, parameters)
        return self._evaluator(expressions)

    @cached_property
    def _closure(self) -> fem.Constant:
        """A penetration that is negligible compared with the mesh size. Collective."""
        surface = self._quadrature.surface
        comm, x = surface.mesh.comm, surface.mesh.geometry.x
        size = global_max(comm, x) - global_min(comm, x)
        return fem.Constant(surface.submesh, _CLOSURE_RATIO * size)

    def _own_normal_fields(self, local: PointKinematics, result: ContactTraction) -> dict[str, Any]:
        """Return stiffness and reaction r_n of a law's own normal potential (UFL)."""
        law, parameters = self.law, self.geometry.parameters
        gap = ufl.variable(local.gap)
        at_gap = replace(local, gap=gap)
        # The stiffness of an open point is that just after closure.
        mask = ufl.ne(result.normal_traction, 0)
        closed = replace(local, gap=ufl.conditional(mask, local.gap, -self._closure))
        return {
            "normal_reaction": ufl.diff(law.normal_potential(at_gap, parameters), gap),
            "normal_stiffness": law.normal_stiffness(closed, parameters),
        }

    def _evaluator(self, expressions: Mapping[str, Any]) -> PointEvaluator:
        for expression in expressions.values():
            self._check_terminals(expression)
        return PointEvaluator(self._quadrature, expressions, by_points=True)

    def _check_terminals(self, expression: Any) -> None:
        """Check that a law depends on its kinematics and parameters only; raise a ValueError.

        Other functions and constants are neither checked nor stored in checkpoints.
        """
        submesh = self._quadrature.surface.submesh
        for item in traverse_unique_terminals(ufl.as_ufl(expression)):
            valid = True
            if isinstance(item, fem.Constant):
                valid = item is self._closure
            elif isinstance(item, fem.Function):
                valid = item.function_space.mesh is submesh or item.function_space.mesh == submesh
            elif isinstance(item, ufl.classes.GeometricQuantity):
                valid = extract_unique_domain(item) == submesh.ufl_domain()
            if not valid:
                what = getattr(item, "name", None) or f"a {type(item).__name__}"
                raise ValueError(
                    f"{type(self.law).__name__} uses {what} in contact_traction or another method; "
                    "a law may depend on its kinematics and parameters only: make it a parameter, "
                    'a field of the class, and use parameters["..."]'
                )


def _depends_on(expression: Any, variable: Any) -> bool:
    """Whether an expression depends on a `ufl.variable`, after evaluation of derivatives."""
    lowered = apply_derivatives(apply_algebra_lowering(ufl.as_ufl(expression)))
    return variable.label() in set(traverse_unique_terminals(lowered))
