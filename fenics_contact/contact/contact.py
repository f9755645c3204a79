"""Contact: binds displacement, surface, support and law; the boundary form and its results."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from typing import Any

import basix
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, la
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.arguments import check_instance, is_number
from fenics_contact.contact.accuracy import DEFAULT_FACTOR, Accuracy
from fenics_contact.contact.multipliers import Multipliers, TraceProjection
from fenics_contact.contact.point_data import PointData
from fenics_contact.laws.base import Kinematics, Law, Response
from fenics_contact.laws.stiffness import Scaled, Springs
from fenics_contact.parallel import (
    collective_errors,
    gather_rows,
    global_max,
    global_min,
    global_sum,
    warn,
)
from fenics_contact.supports.base import Motion, Placement, Support, nonzero_vector
from fenics_contact.supports.deformable import DeformableBody
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.modulus import modulus_over_height
from fenics_contact.surface.pairing import REASONS, LookBack, Pairing
from fenics_contact.surface.surface import ContactSurface, PointEvaluator, VertexAreas

__all__ = [
    "Contact",
    "Found",
    "PointTangent",
    "Resultants",
    "Status",
    "displacement_degree",
    "passing",
]

Array = npt.NDArray[np.float64]

logger = logging.getLogger("fenics_contact")

_ENFORCEMENTS = ("penalty", "augmented")
# Of augmented enforcement, where nothing is said.
_TOLERANCE = 1e-5
# A direction with no more than this share across the normal counts as parallel to it.
_PARALLEL = 1e-6
# Deviation of a gap's slope along the normal from -1 with which it is no distance.
_NO_DISTANCE = 0.5
# Share of the approach of two bodies that is no penetration between the points yet.
_UNSEEN = 0.01
# The size of the mesh times this is a penetration that is next to none, or one that no mesh has.
_BARELY, _DEEP = 1e-8, 0.1


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
        normal_force: ∫ -r_n, tension counted negative.
        tangential_force: ∫ |τ|.
        area: Measure of the closed part; all that has a support where the law bears tension.
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


@dataclass(frozen=True)
class PointTangent:
    """Derivatives of the traction at the points, (n_points, gdim, gdim) each (stress/length).

    Attributes:
        by_jump: By the displacement of the body.
        by_shift: By that of the support; None where no component of it is free.
    """

    by_jump: Array
    by_shift: Array | None = None


@dataclass(frozen=True)
class Found:
    """A solved state of a contact, which a commit makes its history.

    Attributes:
        points: All fields at this rank's points, by name.
        history: Those of them that become history, as it has them.
    """

    points: Mapping[str, Array]
    history: Mapping[str, Array]


class Contact:
    """Frictional contact of Γc with a support, as a boundary form and a committed history.

    Attributes:
        u: The displacement, a vector-valued Lagrange function.
        surface, support, law: What was given.
        quadrature: The points of Γc.
        history: The committed state.
        multipliers: λ_n and λ_t of augmented enforcement, None under penalty.
        accuracy: What was chosen for the accuracy wanted, None if none was said.
        tolerance: What `enforcement_error` must come below, with multipliers.
        parameters: Every parameter of law and support given by a number, as a ``fem.Constant``
            by name ("friction", "k_n", "displacement" …): set ``.value`` to change it.
        entity_maps: For compiling `form` in a problem of one's own.
        name: In messages and files.
        free_motion: Components of the support's displacement that follow from the force on it, as
            scalar constants by number of the component: their values are results (length).
        applied_force: The forces on it, likewise (force).
        stiffness_factor: Factor of k_n and k_t, 1 but for the while in which stiffness is led up
            to it.
        gap_prescribed: Whether the gap was given apart from the geometry.
        paired: Which of this rank's points have an opposite, (n_points,); all of them on a rigid
            support. The others bear nothing and are open.
        n_unpaired: Points without, on all ranks.
        jump_map: Sparse map from ``u`` to its jump at the points, (n_points gdim, n_dofs); over the
            unknowns of a problem it is a `ContactOperator`.
        pairings: How often opposites were found: the map changes with each.
        committed_jump: Displacement relative to the support at the last commit, (n_points, gdim),
            between the places that are opposite each other from then on.
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
        accuracy: str | float | None = None,
        enforcement: str | None = None,
        tolerance: float | None = None,
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
            accuracy: "draft", "standard", "fine", or the relative error wanted in contact force and
                pressure: sets enforcement, tolerance and stiffness where they are not given, the
                solver's tolerance and the number of increments; see `Accuracy`.
            enforcement: By default "penalty": k_n and k_t alone hold the body, which penetrates by
                p/k_n and creeps by τ/k_t before it slips. "augmented": multipliers take the forces
                over from these springs, round by round, until neither is left (`augmented`); k_n
                and k_t set how fast.
            tolerance: Of augmented enforcement, by default 1e-5: how much of the largest traction
                the springs may still bear, between 0 and 1, see `enforcement_error`. To the
                functions of the multipliers the penetration is that share of the penalty's.
            name: In messages and files.

        Raises:
            ValueError: ``u`` is no displacement of this mesh, or data of support or law are wrong.
            TypeError: A parameter is of a type that cannot be a coefficient.
        """
        check_instance("name", name, str)
        order = "the order is Contact(u, surface, support, law)"
        for what, value, kind in (
            ("u", u, fem.Function),
            ("surface", surface, ContactSurface),
            ("support", support, Support),
            ("law", law, Law),
        ):
            check_instance(f"{name}: {what}", value, kind, order)
        self.name = name
        self.u = u
        self.surface, self.support, self.law = surface, support, law
        self.entity_maps = surface.entity_maps
        self.parameters: dict[str, fem.Constant] = {}
        mesh = surface.mesh
        self._gdim = gdim = mesh.geometry.dim
        degree = displacement_degree(u, mesh, name)
        try:
            law.check_complete()
            law.check_dimension(gdim)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        self._projection: TraceProjection | None = None
        self.accuracy = None if accuracy is None else Accuracy.of(accuracy)
        chosen = self.accuracy
        if enforcement is None:
            enforcement = chosen.enforcement if chosen and self._may_augment() else "penalty"
        if tolerance is None:
            tolerance = chosen.tolerance if chosen else _TOLERANCE
        self.tolerance = tolerance
        augments = self._augments(enforcement)
        # Linear elements hold a curved gap at their nodes alone (docs/enforcement.md). But between
        # two meshes, and on quadrilaterals of any shape, nodes carry no uniform pressure over.
        nodal = augments and degree == 1 and not isinstance(support, DeformableBody)
        nodal = nodal and surface.submesh.topology.cell_name() != "quadrilateral"
        self.quadrature = surface.quadrature(degree, nodal=nodal)
        self.multipliers: Multipliers | None = None
        if augments:
            self.multipliers = Multipliers(self.quadrature, degree, law)
        self.weight = self._scalar("weight", 1.0 if weight is None else weight)
        self._scale: fem.Function | None = None  # E/h, if a stiffness is Scaled
        self._scale_known = False
        self._tributary: VertexAreas | None = None  # if a stiffness is that of Springs
        parameters = {n: self._parameter(n, v) for n, v in law.parameters().items()}
        self.stiffness_factor = fem.Constant(mesh, 1.0)
        for n in {"k_n", "k_t"} & set(parameters):
            parameters[n] = self.stiffness_factor * parameters[n]
        if modulus is not None:
            self.set_modulus(modulus)

        shift = support.displacement
        self.free_motion: dict[int, fem.Constant] = {}
        self.applied_force: dict[int, Any] = {}
        self._free_shift: dict[int, ufl.core.expr.Expr] = {}
        if isinstance(shift, Motion):
            shift = self._moving(shift)
        elif shift is not None:
            shift = self._to_ufl("displacement", shift)
        if shift is not None:
            if shift.ufl_shape != (gdim,):
                raise ValueError(
                    f"{name}: displacement of the support has shape {shift.ufl_shape}; the mesh "
                    f"needs ({gdim},)"
                )
        x = ufl.SpatialCoordinate(mesh)
        self._pairing: Pairing | None = None
        self.paired = np.ones(self.quadrature.n_points, dtype=np.bool_)
        if isinstance(support, DeformableBody):
            self._pairing = Pairing(support, self.quadrature, u.function_space)
            self._distance = fem.Function(self.quadrature.space(), name="distance")
            self._acts = fem.Function(self.quadrature.space(), name="paired")
            placement = Placement(self._distance, ufl.FacetNormal(mesh))
        else:
            placement = support.place(x, shift, lambda v: self._to_ufl("support", v))
        length = ufl.sqrt(ufl.dot(placement.direction, placement.direction))
        normal = placement.direction / length
        self._placement = placement
        self._evaluate_placement: PointEvaluator | None = None
        self.gap_prescribed = gap is not None
        open_gap = placement.gap
        if gap is not None:
            open_gap = self._scalar("gap", gap)
            if shift is not None:
                open_gap = open_gap + ufl.dot(shift, normal)
        # As expressions for the form on Γc, and sampled at the points for all else.
        self._given = _Seen(open_gap, normal, shift, parameters)

        fields = {"opening": 0, "penetration": 0, "normal_traction": 0}
        if law.has_friction:
            fields |= {"traction": gdim, "jump": gdim, "slip": law.n_modes(gdim)}
        if self.multipliers is not None:
            fields |= {"multiplier": 0}
        self.history = PointFields(self.quadrature, fields)

        # All of contact is a sparse map from u to the jump at the points, and the law there.
        self._own_map = self.quadrature.interpolation_matrix(u.function_space)
        self.jump_map: PETSc.Mat = self._own_map
        self._jump = fem.Function(self.quadrature.space(gdim), name="jump")
        expressions = {
            "x": x,
            "normal": normal,
            "direction_length": length,
            "facing": ufl.dot(normal, ufl.FacetNormal(mesh)),
            "weight": self.weight,
            "gap": open_gap,
            "shift": self._prescribed_shift(),
        } | {f"parameter {n}": v for n, v in parameters.items()}
        seen = ["gap", "normal", *(f"parameter {n}" for n in parameters)]
        if shift is not None:
            expressions["support"] = shift
            seen.append("support")
        for i, free in self._free_shift.items():
            expressions |= {f"gap by {i}": ufl.diff(open_gap, free)}
            expressions |= {f"normal by {i}": ufl.diff(normal, free)}
        self._data = PointData(self.quadrature, expressions, seen)
        sampled = {n: self._data.ufl(f"parameter {n}") for n in parameters}
        self._sampled = _Seen(
            self._data.ufl("gap"),
            self._data.ufl("normal"),
            None if shift is None else self._data.ufl("support"),
            sampled,
        )
        parameters = sampled
        kinematics = self._kinematics(self._jump)
        response = self._response(law, kinematics, parameters)
        expressions = {
            "normal_displacement": kinematics.normal_displacement,
            "opening": response.opening,
            "penetration": response.penetration,
            "normal_traction": response.normal_traction,
            "jump": self._sampled.relative(self._jump),
            "stored": self._acting_there(law.stored(kinematics, response, parameters)),
        }
        if law.has_own_normal:
            expressions |= self._own_normal(kinematics, response)
        if law.has_tangential:
            stiffness = law.tangential_stiffness(kinematics, parameters)
            expressions |= {
                "traction": response.traction,
                "grip": law.grip(parameters),
            } | {f"tangential_stiffness {i}": stiffness[i, :] for i in range(gdim)}
        if law.has_friction:
            expressions |= {
                "increment": kinematics.tangential_increment,
                "old_traction": kinematics.traction,
                "limit": response.limit,
                "dissipated": self._acting_there(law.dissipated(kinematics, response, parameters)),
                "slip_increment": ufl.as_vector(response.slip),
            }
        if self.multipliers is not None:
            expressions |= {"multiplier": kinematics.multiplier}
            if law.has_friction:
                assert kinematics.traction is not None
                borne = kinematics.traction - response.traction
                stretched = law.elastic_displacement(kinematics, borne, parameters)
                expressions |= {"elastic_slip": stretched}
        self._evaluate_law = PointEvaluator(self.quadrature, expressions, by_points=True)
        self._acting = self._whole = _Reactions(self, law, self._sampled)
        self._frozen: _Reactions | None = None
        self._evaluate_yield: PointEvaluator | None = None
        self._own_form: Any = None
        self._points: dict[str, Array] | None = None
        # Slip, and the values that it is of.
        self._slip: tuple[Mapping[str, Array], Array] = {}, np.zeros((0, gdim))
        self._paired_at: fem.Function | None = None
        self._looking_back: LookBack | None = None
        self.n_unpaired = 0
        self.pairings = 0
        if self._pairing is not None:
            self.pair()

    def _augments(self, enforcement: str) -> bool:
        """Whether there are multipliers.

        Raises:
            ValueError: The law has no use for them, or the tolerance is none.
        """
        if enforcement not in _ENFORCEMENTS:
            raise ValueError(
                f"{self.name}: enforcement is {enforcement!r}; use one of {_ENFORCEMENTS}"
            )
        if not (is_number(self.tolerance) and 0.0 < self.tolerance < 1.0):
            raise ValueError(
                f"{self.name}: tolerance is {self.tolerance!r}; it must be a number between 0 and 1"
            )
        if enforcement == "penalty":
            return False
        if not self._may_augment():
            springs = [n for n, v in self.law.parameters().items() if isinstance(v, Springs)]
            what = f"{springs[0]} by Springs" if springs else type(self.law).__name__
            raise ValueError(
                f"{self.name}: {what} has the stiffness of something that is there; multipliers "
                'would take it away; use enforcement="penalty", or a law and stiffness that stand '
                "for rigid contact"
            )
        return True

    def _may_augment(self) -> bool:
        """Whether the stiffness stands for none at all."""
        springs = (isinstance(v, Springs) for v in self.law.parameters().values())
        return not self.law.is_physical and not any(springs)

    def _prescribed_shift(self) -> Any:
        """Displacement of the support without its free components (UFL)."""
        shift = self._given.shift
        if shift is None:
            return ufl.as_vector([0.0] * self._gdim)
        return ufl.replace(shift, {c: ufl.as_ufl(0.0) for c in self.free_motion.values()})

    def _kinematics(
        self, jump: Any, law: Law | None = None, seen: _Seen | None = None
    ) -> Kinematics:
        """What a law, by default the contact's, sees of a displacement of the body (UFL)."""
        law, seen = law or self.law, seen or self._sampled
        normal = seen.normal
        total = increment = traction = multiplier = None
        old_traction = self.history
        if self.multipliers is not None:
            old_traction = self.multipliers.fields
            multiplier = old_traction.ufl("pressure")

        def tangential(vector: Any) -> Any:
            return vector - ufl.dot(vector, normal) * normal

        if law.has_tangential:
            total = tangential(seen.relative(jump))
        if law.has_friction:
            # The old traction and displacement are taken along the present normal: the support
            # may have moved on since the last commit.
            increment = tangential(seen.relative(jump) - self.history.ufl("jump"))
            traction = tangential(old_traction.ufl("traction"))
        u_n = ufl.dot(jump, normal)
        return Kinematics(seen.gap, u_n, normal, total, increment, traction, multiplier)

    def _acting_there(self, value: Any) -> Any:
        """A value at points with an opposite, 0 at the others (UFL)."""
        return value if self._pairing is None else self._acts * value

    def _response(
        self, law: Law, kinematics: Kinematics, parameters: Mapping[str, Any]
    ) -> Response:
        """What a law makes of the kinematics, nothing at points without an opposite (UFL)."""
        response = law.response(kinematics, parameters)
        if self._pairing is None:
            return response
        there = self._acting_there
        return replace(
            response,
            normal_traction=there(response.normal_traction),
            opening=there(response.opening),
            penetration=there(response.penetration),
            traction=None if response.traction is None else there(response.traction),
            limit=None if response.limit is None else there(response.limit),
            slip=tuple(there(mode) for mode in response.slip),
        )

    def _own_normal(self, kinematics: Kinematics, response: Response) -> dict[str, Any]:
        """What is known of r_n that does not follow from k_n (UFL): stiffness, and another way."""
        law, parameters, comm = self.law, self._sampled.parameters, self.surface.mesh.comm
        u_n = ufl.variable(kinematics.normal_displacement)
        at_variable = replace(kinematics, normal_displacement=u_n)
        x = self.surface.mesh.geometry.x
        barely = fem.Constant(
            self.surface.submesh, _BARELY * (global_max(comm, x) - global_min(comm, x))
        )
        # Where nothing acts the stiffness is that of a point that has just closed.
        acts = ufl.ne(response.normal_traction, 0)
        closed = ufl.conditional(acts, kinematics.normal_displacement, kinematics.gap + barely)
        at_closed = replace(kinematics, normal_displacement=closed)
        return {
            "normal_reaction": -ufl.diff(law.normal_potential(at_variable, parameters), u_n),
            "normal_stiffness": law.normal_stiffness(at_closed, parameters),
        }

    # ---- forms -----------------------------------------------------------------------------------

    def form(self, v: ufl.Argument) -> ufl.Form:
        """Virtual work of contact, to be **added** to a residual: -∫ (r_n v_n + τ·v_t) (46, 55).

        Args:
            v: Test function of ``u``'s space. Compile with ``entity_maps=contact.entity_maps``.

        Raises:
            ValueError: A stiffness is `Scaled` and the modulus is not known.
        """
        if self.free_motion:
            raise ValueError(
                f"{self.name}: the form on Γc cannot hold the unknown motion of the support; use "
                "ContactProblem, or prescribe the displacement"
            )
        if not self.rigid:
            raise ValueError(
                f"{self.name}: the form on Γc cannot reach the opposite body's unknowns; use "
                "ContactProblem, or a ContactOperator"
            )
        if self.needs_modulus:
            raise ValueError(
                f"{self.name}: k_n or k_t is a multiple of E/h, and E is not known; give "
                "Contact(modulus=...), give k_n and k_t in stress/length, or use ContactProblem, "
                "which measures E in the bulk form"
            )
        return self._form_at(self.u, v)

    def _form_at(self, displacement: Any, v: ufl.Argument) -> ufl.Form:
        """`form` at a displacement relative to the support."""
        traction = _Reactions(self, self.law, self._given).traction(displacement)
        return -self.weight * ufl.dot(traction, v) * self.quadrature.ds

    def potential(self) -> ufl.Form:
        """Energy whose derivative by ``u`` is `form` (eq. 19, 43).

        Raises:
            ValueError: The law has none (Coulomb; a foundation with k_t and without tension).
        """
        kinematics = self._kinematics(self.u, seen=self._given)
        density = self._acting_there(self.law.potential(kinematics, self._given.parameters))
        return self.weight * density * self.quadrature.ds

    def tangent(self, v: ufl.Argument, du: ufl.Argument) -> ufl.Form:
        """Consistent tangent, the derivative of `form`; unsymmetric where Coulomb slips."""
        return ufl.derivative(self.form(v), self.u, du)

    # ---- the same, point by point: see `ContactOperator` -----------------------------------------

    @property
    def area(self) -> Array:
        """Area that each point stands for, the weight as it was sampled last, (n_points,)."""
        return self.quadrature.weights * self._data.values["weight"]

    def acting_traction(self) -> Array:
        """r_n n + τ of the acting law at the present ``u``, (n_points, gdim) (stress). Collective.

        Results stay those of the last evaluation.
        """
        self._update_points()
        return self._acting.evaluate_traction()["traction"]

    def acting_tangent(self) -> PointTangent:
        """Derivatives of `acting_traction` at the present ``u``. Collective."""
        self._update_points()
        rows, d = self._acting.evaluate_tangent(), self._gdim
        by_jump = np.stack([rows[f"jump {i}"] for i in range(d)], axis=1)
        if not self.free_motion:
            return PointTangent(by_jump)
        by_normal = np.stack([rows[f"normal {i}"] for i in range(d)], axis=1)
        by_support = np.stack([rows[f"support {i}"] for i in range(d)], axis=1)
        by_shift = np.zeros_like(by_jump)
        for i in self.free_motion:
            turns = self._data.values[f"normal by {i}"]
            by_shift[:, :, i] = by_support[:, :, i]
            by_shift[:, :, i] += rows["gap"] * self._data.values[f"gap by {i}"][:, None]
            by_shift[:, :, i] += np.einsum("qij,qj->qi", by_normal, turns)
        return PointTangent(by_jump, by_shift)

    def own_forces(self) -> tuple[Array, Array]:
        """Nodal forces on the body with Γc at the present ``u``, by two routes. Collective.

        Returns:
            (n_owned_dofs,) each (force): as `add_force` has them, by sums over the points; and as
            DOLFINx assembles the boundary form (46, 55), in which ``u`` itself stands where the
            support is rigid and no motion of it is unknown, and the jump at the points otherwise.
        """
        mesh, space = self.surface.mesh, self.u.function_space
        self._update_points()
        vector, forces = self._own_map.createVecs()
        forces.array[:] = (self.area[:, None] * self._whole.evaluate_traction()["traction"]).ravel()
        self._own_map.multTranspose(forces, vector)
        by_points = vector.array_r.copy()
        for item in (vector, forces):
            item.destroy()
        if self._own_form is None:
            displacement = self.u if self.rigid and not self.free_motion else self._jump
            form = self._form_at(displacement, ufl.TestFunction(space))
            self._own_form = compat.compile_form(-form, self.entity_maps)
        with collective_errors(mesh.comm):
            assembled = fem.assemble_vector(self._own_form)
        assembled.scatter_reverse(la.InsertMode.add)
        return by_points, assembled.array[: by_points.size].copy()

    def energy(self) -> float:
        """`potential` at the present ``u``, this rank's points only. Collective.

        Raises:
            ValueError: The law has none.
        """
        self._update_points()
        return float(self.area @ self._acting.evaluate_potential()["potential"])

    def freeze(self, pressure: Array) -> None:
        """Let `Law.at_pressure` act. Collective.

        `acting_traction`, `acting_tangent` and `energy` are those of it; results are not.

        Args:
            pressure: ≥ 0, shape (n_points,) (stress).
        """
        if self.law.has_potential:
            return
        if self._frozen is None:
            self._pressure = fem.Function(self.quadrature.space(), name="pressure")
            law = self.law.at_pressure(self._pressure)
            parameters = {**self._sampled.parameters, "pressure": self._pressure}
            self._frozen = _Reactions(self, law, replace(self._sampled, parameters=parameters))
        self._pressure.x.array[: self.quadrature.n_points] = pressure
        self._pressure.x.scatter_forward()
        self._acting = self._frozen

    def thaw(self) -> None:
        """Let the law itself act again."""
        self._acting = self._whole

    def springs(self, normal: npt.ArrayLike, tangential: npt.ArrayLike) -> Array:
        """Symmetric stiffness a K_n + b K_t of section 5 at the points as evaluated.

        Args:
            normal: a, a number or one per owned point.
            tangential: b, likewise.

        Returns:
            (n_points, gdim, gdim) (stress/length).
        """
        values, d = self._values, self._gdim
        n = self.quadrature.n_points
        along = np.einsum("qi,qj->qij", values["normal"], values["normal"])
        blocks = np.zeros((n, d, d))
        if self.law.has_normal_stiffness:
            blocks += (np.asarray(normal) * self.normal_stiffness)[:, None, None] * along
        if self.law.has_tangential:
            share = np.broadcast_to(np.asarray(tangential), (n,))
            blocks += share[:, None, None] * self.tangential_stiffness
        return blocks

    def _update_points(self) -> None:
        """Let the points be at the present ``u`` and data. Collective."""
        self.jump_map.mult(self.u.x.petsc_vec, self._jump.x.petsc_vec)
        self._jump.x.scatter_forward()
        self._data.update()

    def _evaluate_points(self) -> dict[str, Array]:
        """Everything at the points, with the jump as it was updated last. Collective."""
        self._data.update()
        return {**self._data.values, **self._evaluate_law()}

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
            if not (is_number(modulus) and np.isfinite(modulus) and modulus > 0):
                raise ValueError(
                    f"{self.name}: modulus is {modulus!r}; it must be a positive number, or a "
                    "fem.Function with one value per cell"
                )
            value = float(modulus)
            modulus = fem.Function(fem.functionspace(self.surface.mesh, ("DG", 0)))
            modulus.x.array[:] = value
        scale = modulus_over_height(self.surface, modulus)
        self._scale.x.array[:] = scale.x.array
        self._scale_known = True

    def _parameter(self, name: str, value: Any) -> ufl.core.expr.Expr:
        if name == "direction":
            return self._to_ufl(
                name, nonzero_vector(f"{self.name}: direction of friction", value, self._gdim)
            )
        if isinstance(value, Springs):
            if self._tributary is None:
                self._tributary = VertexAreas(self.quadrature, self.weight, self.name)
            return self._to_ufl(name, value.k) / self._tributary.area
        if isinstance(value, Scaled):
            if self._scale is None:
                self._scale = fem.Function(fem.functionspace(self.surface.submesh, ("Lagrange", 1)))
                self._scale.x.array[:] = 1.0
            factor = self.accuracy.factor if self.accuracy else DEFAULT_FACTOR
            return self._to_ufl(name, value.factor or factor) * self._scale
        positive = name in self.law.positive
        if is_number(value):
            bad = not np.isfinite(value) or value < 0 or (positive and value == 0)
            if bad:
                raise ValueError(_range_error(self.name, name, float(value), positive))
        return self._scalar(name, value)

    def _scalar(self, name: str, value: Any) -> ufl.core.expr.Expr:
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
            array = np.asarray(value)
        except ValueError:  # a ragged list
            array = np.asarray(None)
        if array.dtype.kind not in "iuf":
            raise TypeError(
                f"{self.name}: {name} is {value!r}; give numbers, a fem.Constant, a fem.Function "
                "or a UFL expression"
            )
        constant = fem.Constant(self.surface.mesh, array.astype(np.float64))
        if name != "support":
            self.parameters[name] = constant
        return constant

    def _moving(self, motion: Motion) -> ufl.core.expr.Expr:
        """The displacement of a support some components of which are unknown (UFL)."""
        forces, given = motion.components(self._gdim)
        shift: list[Any] = [None] * self._gdim
        for i, value in given.items():
            shift[i] = self._scalar(f"displacement {i}", value)
        for i, value in forces.items():
            if not (is_number(value) or (isinstance(value, fem.Constant) and not value.ufl_shape)):
                raise TypeError(
                    f"{self.name}: force {i} of the Motion is {value!r}; give a number or a scalar "
                    "fem.Constant"
                )
            self.applied_force[i] = value
            self.free_motion[i] = fem.Constant(self.surface.mesh, 0.0)
            shift[i] = self._free_shift[i] = ufl.variable(self.free_motion[i])
        return ufl.as_vector(shift)

    # ---- pairs -----------------------------------------------------------------------------------

    @property
    def pairs_anew(self) -> bool:
        """Whether opposites are found anew, on the deformed bodies, at every commit."""
        return isinstance(self.support, DeformableBody) and self.support.update == "increment"

    @property
    def rigid(self) -> bool:
        """Whether the support is rigid: its reactions are then external to the mesh."""
        return self._pairing is None

    @property
    def regularised(self) -> bool:
        """Whether the stiffness stands for none at all, and is not that of physical springs."""
        return self._may_augment()

    def borne_by_springs(self) -> Array:
        """What of the traction the springs bear in place of rigid contact: (n_points, gdim).

        As far as displacements of Γc can answer it, see `augmented`: (stress). Zero where the
        stiffness is physical. Collective.
        """
        values = self._values
        if not self.regularised:
            return np.zeros_like(values["x"])
        project = self._traces()
        pressure = np.zeros(self.quadrature.n_points)
        if self.law.has_normal_stiffness:
            pressure = project(self.pressure)
        side = project(self.tangential_traction)
        if self.multipliers is not None:
            pressure = pressure - self.multipliers.fields.values("pressure")
            if self.law.has_friction:
                side = side - self.multipliers.fields.values("traction")
        return side - pressure[:, None] * values["normal"]

    @property
    def couples(self) -> bool:
        """Whether contact ties unknowns together that the bulk does not."""
        return not self.rigid or bool(self.free_motion)

    def pair(self, u: fem.Function | None = None) -> None:
        """Find the opposites of all points. Collective.

        Args:
            u: Displacement of the bodies in which to find them; none: the undeformed bodies.

        Points that find none are open, whatever they do, and counted in ``n_unpaired``. A warning
        says why, if they are more than half of all.
        """
        assert self._pairing is not None
        mesh, d = self.surface.mesh, self._gdim
        points = self._evaluate_points()
        n = self.quadrature.n_points
        penetration = np.zeros(n) if u is None else self._geometric_penetration(points)
        opposite, distance, why = self._pairing.pair(points["x"], points["normal"], u, penetration)
        self._forget_look_back()
        self._paired_at = None if u is None else u.copy()
        self.paired = ~np.isnan(distance)
        for function, values in (
            (self._distance, np.nan_to_num(distance)),
            (self._acts, self.paired),
        ):
            function.x.array[:n] = values
            function.x.scatter_forward()
        relative = self._own_map.copy()
        mask = relative.createVecLeft()
        mask.array[:] = np.repeat(self.paired, d)
        relative.diagonalScale(mask, None)
        relative.axpy(-1.0, opposite, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        opposite.destroy()
        mask.destroy()
        self.jump_map = relative
        self.forget()
        self.pairings += 1
        lost = [np.count_nonzero(~self.paired & (why == reason)) for reason in REASONS]
        *counts, total = (int(number) for number in global_sum(mesh.comm, [*lost, n]))
        self.n_unpaired = sum(counts)
        if 2 * self.n_unpaired > total:
            told = [f"{k}: {text}" for k, text in zip(counts, REASONS.values(), strict=True) if k]
            warn(
                mesh.comm,
                f"{self.name}: {self.n_unpaired} of the {total} points of Γc have no opposite and "
                f"bear nothing ({'; '.join(told)}). Check the tags of Γc and of the opposite "
                "surface, search_distance and release of the DeformableBody",
            )

    def _geometric_penetration(self, points: Mapping[str, Array]) -> Array:
        """Depth of evaluated points in the opposite, whatever gap is prescribed: (n_points,)."""
        depth = points["normal_displacement"] - self._distance.x.array[: self.quadrature.n_points]
        return np.where(self.paired, np.maximum(depth, 0.0), 0.0)

    def own_displacement(self) -> Array:
        """Of the body that has Γc, at the points, (n_points, gdim) (length). Collective."""
        product = self._own_map.createVecLeft()
        self._own_map.mult(self.u.x.petsc_vec, product)
        values = product.array_r.reshape(-1, self._gdim).copy()
        product.destroy()
        return values

    def relative_slide(self) -> Array:
        """Tangential displacement since pairs were found, (n_points, gdim) (length)."""
        jump, normal = self._values["jump"], self._values["normal"]
        if self._paired_at is not None:
            jump = jump - self.committed_jump
        return jump - np.sum(jump * normal, axis=1)[:, None] * normal

    def true_placement(self) -> tuple[Array, Array]:
        """Gap and normal where the body has moved to: at X + u instead of X. Collective.

        Returns:
            Gap, (n_points,) (length): NaN where there is no opposite, and infinite where an
            `Obstacle` says no distance that could be told at other places; and unit normals from
            body to support, (n_points, gdim).
        """
        if not self.rigid:
            return self.true_gap()
        if self._evaluate_placement is None:
            x = ufl.SpatialCoordinate(self.surface.mesh)
            moved = ufl.variable(x + self._jump)
            gap, direction = (
                ufl.replace(e, {x: moved}) for e in (self._placement.gap, self._placement.direction)
            )
            normal = direction / ufl.sqrt(ufl.dot(direction, direction))
            slope = ufl.dot(ufl.diff(gap, moved), normal)
            self._evaluate_placement = PointEvaluator(
                self.quadrature, {"gap": gap, "normal": normal, "slope": slope}
            )
        self._update_points()
        found = self._evaluate_placement()
        # A distance falls along the normal as fast as one moves.
        told = np.abs(found["slope"] + 1) < _NO_DISTANCE
        return np.where(told, found["gap"], np.inf), found["normal"]

    def gap_deviation(self) -> tuple[Array, Array]:
        """True gap minus the linearised one, and the true normals: at X + u, not X. Collective.

        Returns:
            (n_points,) (length), NaN where there is no opposite in truth, and 0 where an `Obstacle`
            says no distance that could be told elsewhere; unit normals, (n_points, gdim).
        """
        gap, normal = self.true_placement()
        if self._pairing is None:
            return np.where(np.isinf(gap), 0.0, gap - self.gap), normal
        points = self._values
        linear = self._pairing.linear_gap(
            points["x"],
            points["normal"],
            self._paired_at,
            self._geometric_penetration(points),
            self.u,
            self.own_displacement(),
        )
        # Between facets that do not match it jumps from point to point; what is answered to is a
        # function on Γc.
        change = gap - linear
        smooth = self._traces()(np.nan_to_num(change))
        return np.where(np.isnan(change), np.nan, smooth), normal

    def _traces(self) -> TraceProjection:
        """The projection on functions on Γc that displacements can answer to. Collective."""
        if self._projection is None:
            degree = self.u.function_space.ufl_element().degree
            self._projection = TraceProjection(self.quadrature, degree)
        return self._projection

    def true_gap(self) -> tuple[Array, Array]:
        """Distances to the opposite in the bodies as they are displaced now, by a search anew.

        To compare with the linearised ones, `gap`. The pairs stay as they are. Collective.

        Returns:
            Distance along the true normal of the displaced Γc, (n_points,) (length), NaN where
            there is no opposite; and these unit normals, (n_points, gdim).

        Raises:
            ValueError: The support is rigid.
        """
        if self._pairing is None:
            raise ValueError(f"{self.name}: the support is no DeformableBody; see `gap`")
        points = self._values
        depth = self._geometric_penetration(points)
        return self._pairing.true_gap(points["x"], points["normal"], self.u, depth)

    def _forget_look_back(self) -> None:
        if self._looking_back is not None:
            self._looking_back.approach.destroy()
        self._looking_back = None

    def unseen_penetration(self, others: Sequence[Contact] = ()) -> tuple[float, Array]:
        """How deep the opposite passes through Γc between the points of Γc. Collective.

        Corners and middles of the opposite's facets are followed back to Γc, with the pairs as they
        are and at the last evaluated state. Where one lies deeper than any point of the contacts,
        while no point of the facet that it passes through nor of its neighbours is closed, nothing
        holds it up. Facets of curved surfaces may overlap by what they differ from these.

        Args:
            others: Further contacts, whose points see the opposite where it is their Γc.

        Returns:
            The largest such depth (length), 0 if there is none or the support is rigid, and the
            place in the undeformed body, (gdim,).
        """
        comm, opposite = self.surface.mesh.comm, self._pairing
        nowhere = 0.0, np.zeros(self._gdim)
        if opposite is None:
            return nowhere
        points = self._values
        if self._looking_back is None:
            deepest = global_max(comm, self._geometric_penetration(points))
            self._looking_back = opposite.look_back(self._paired_at, deepest)
        back = self._looking_back
        product = back.approach.createVecLeft()
        back.approach.mult(self.u.x.petsc_vec, product)
        approach = product.array_r.copy()
        product.destroy()
        distance = back.distance
        if self.gap_prescribed:
            distance = opposite.largest(points["gap"])[back.facet]
        own = [c._values["penetration"] for c in (self, *others)]
        allowed = max(global_max(comm, depth) for depth in own)
        allowed = max(allowed, _UNSEEN * global_max(comm, np.abs(approach)), opposite.round_off)
        depth = approach - distance - back.slack - allowed
        if not global_max(comm, depth, empty=-1.0) > 0:
            return nowhere
        for contact in (self, *others):  # what has points of its own that look back
            if contact._pairing is not None:
                mutual = opposite.facets_among(contact._pairing)[back.facet]
                depth[mutual & np.isin(back.source, contact.surface.facets)] = -1.0
        depth[opposite.facets_near(self.status != Status.OPEN)[back.facet]] = -1.0
        rows = np.column_stack([approach - distance, back.place])[depth > 0]
        rows = gather_rows(comm, rows)
        if not len(rows):
            return nowhere
        worst = rows[np.argmax(rows[:, 0])]
        return float(worst[0]), worst[1:]

    # ---- state -----------------------------------------------------------------------------------

    def evaluate(self) -> None:
        """Evaluate gap, reactions and slip at the present ``u``; the history stays. Collective."""
        self._update_points()
        self._points = {**self._data.values, **self._evaluate_law()}

    def evaluate_yield(self) -> tuple[Array, Array]:
        """The law's yield functions at the present ``u``, and their gradients. Collective.

        Returns:
            g_j(τ, limit) (stress), (n_points, n_modes), and ∂g_j/∂τ, (n_points, n_modes, gdim).
        """
        if self._evaluate_yield is None:
            kinematics, parameters = self._kinematics(self._jump), self._sampled.parameters
            response = self._response(self.law, kinematics, parameters)
            traction = ufl.variable(response.traction)
            functions = self.law.yield_functions(kinematics, traction, response.limit, parameters)
            rows = {f"gradient {j}": ufl.diff(g, traction) for j, g in enumerate(functions)}
            self._evaluate_yield = PointEvaluator(
                self.quadrature, {"functions": ufl.as_vector(functions)} | rows, by_points=True
            )
        self._update_points()
        found = self._evaluate_yield()
        gradients = [found[name] for name in found if name != "functions"]
        return found["functions"], np.stack(gradients, axis=1)

    def forget(self) -> None:
        """Drop what was evaluated: the next look at a result evaluates the present ``u``."""
        self._points = None

    def restore(self) -> None:
        """Multipliers as at the last commit; what was evaluated is dropped. Collective."""
        if self.multipliers is not None:
            self.multipliers.restore(self.history)
        self.forget()

    def enforcement_error(self) -> float:
        """What the springs bear at the last evaluated state, relative: 0 if exact. Collective.

        The largest |Π p - λ_n| and |Π τ - λ_t| over the points, by the largest pressure or
        traction: what another round would change. k_n times the penetration is that, and k_t times
        the elastic slip, as far as displacements of Γc can undo them. Infinite where nothing is
        borne any more and multipliers are left.

        Raises:
            ValueError: There are no multipliers.
        """
        return self._augmented().error(self._values, self.history)

    def augment(self) -> float:
        """Let the multipliers bear what the springs did at the present ``u``. Collective.

        One round: solve with `form`, then call this, until what it returns is small enough;
        `commit` comes after the last. `ContactProblem` does it by itself.

        Returns:
            `enforcement_error` before.

        Raises:
            ValueError: There are no multipliers.
        """
        multipliers = self._augmented()
        self.evaluate()
        error = multipliers.error(self._values, self.history)
        multipliers.update(self._values)
        self.forget()
        return error

    def _augmented(self) -> Multipliers:
        if self.multipliers is None:
            raise ValueError(
                f'{self.name}: there are no multipliers; make it with enforcement="augmented"'
            )
        return self.multipliers

    def check_input(self) -> None:
        """Refuse parameters that are out of range or not finite at some point of Γc. Collective.

        Raises:
            ValueError: On all ranks.
        """
        comm = self.surface.mesh.comm
        if self._tributary is not None:
            self._tributary.update()
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
                if not key.startswith("parameter ") or name == "direction":
                    continue
                positive = name in self.law.positive
                if low < 0 or (low == 0 and positive):
                    raise ValueError(_range_error(self.name, name, low, positive))
        if global_min(comm, points["weight"]) < 0:
            raise ValueError(f"{self.name}: weight is negative at a point of Γc")
        if "parameter direction" in points:
            given, normal = points["parameter direction"], points["normal"]
            length = np.linalg.norm(given, axis=1)
            across = given - np.sum(given * normal, axis=1)[:, None] * normal
            share = np.linalg.norm(across, axis=1) / np.where(length > 0, length, 1.0)
            least = global_min(comm, share, empty=1.0)
            if not least > _PARALLEL:
                raise ValueError(
                    f"{self.name}: direction of friction is zero or parallel to the normal at a "
                    f"point of Γc (share across the normal: {least:.1g}); it must have a part in "
                    "the tangent plane everywhere: give another direction, or a UFL vector that "
                    "follows the surface"
                )

    def check_side(self) -> None:
        """Refuse, or warn of, a support that all of Γc looks away from. Collective.

        Raises:
            ValueError: The body is deep inside of it, too.
        """
        comm, values = self.surface.mesh.comm, self._values
        if global_max(comm, values["facing"]) > -_PARALLEL:  # NaN has its own errors
            return
        x, depth = self.surface.mesh.geometry.x, -global_min(comm, values["gap"])
        text = (
            f"{self.name}: the normal from the body to the support points into the body at every "
            "point of Γc: turn it round (a HalfSpace's points out of it, to the body: up for a "
            "floor; a Ball or Cylinder around the body has inside=True)"
        )
        size = global_max(comm, x) - global_min(comm, x)
        if depth > _DEEP * size and not self.gap_prescribed:
            raise ValueError(f"{text}; the body is inside of the support, by up to {depth:g}")
        if comm.rank == 0:
            logger.warning(text)

    def found(self) -> Found:
        """The state as evaluated, for `commit`: nothing that changes later changes it."""
        points = self._values
        values = {n: points[n] for n in ("opening", "penetration", "normal_traction")}
        if self.law.has_friction:
            values |= {
                "traction": points["traction"],
                "jump": points["jump"],
                "slip": self.history.values("slip") + points["slip_increment"],
            }
        if self.multipliers is not None:
            values |= self.multipliers.committed(points)
        return Found(points, values)

    def commit(self, found: Found | None = None) -> None:
        """Make a state the history of the next increment. Collective.

        Args:
            found: What `found` gave; by default the state at the present ``u``.
        """
        if found is None:
            self.evaluate()
            found = self.found()
        points, values = found.points, dict(found.history)
        self.history.commit(values)
        self._points, self.committed_jump = dict(points), points["jump"]
        if self.pairs_anew:
            # The traction stays with the points of Γc; what they slip over has moved on.
            self.pair(self.u)
            self.committed_jump = self._values["jump"]
            if self.law.has_friction:
                moved = values["jump"] + self.committed_jump - points["jump"]
                self.history.commit(values | {"jump": moved})
            self._points = dict(points)  # results stay those of the solution
        if self.multipliers is not None:
            self.multipliers.restore(self.history)

    def given(self) -> dict[str, Array]:
        """The data of law, support and contact at this rank's points, by name. Collective.

        What was evaluated before stays.
        """
        if self._tributary is not None:
            self._tributary.update()
        self._data.update()
        data = self._data.values
        names = ["weight", "normal", "shift"]
        if self.gap_prescribed or not self.pairs_anew:  # else it is that of the latest pairs
            names.append("gap")
        return {n: v for n, v in data.items() if n in names or n.startswith("parameter ")}

    def take_up(self, history: Array, values: Mapping[str, Array]) -> None:
        """Make a state of another run the committed one, at the u that it has. Collective.

        Args:
            history: `History.rows` of that run, with ``u`` and loads as they were in it.
            values: Its `values`, for the results to be those of its solution.
        """
        self.history.set_rows(history)
        if self.pairs_anew:
            self.pair(self.u)
        self.restore()
        self.committed_jump = self._values["jump"]
        if {n: v.shape for n, v in values.items()} == {n: v.shape for n, v in self._values.items()}:
            self._points = dict(values)

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
        """Open distance s - u_n = δ₊ - δ₋ (eq. 6), shape (n_points,), in length.

        NaN at points without an opposite.
        """
        gap = self._values["opening"] - self._values["penetration"]
        return gap if self._pairing is None else np.where(self.paired, gap, np.nan)

    @property
    def pressure(self) -> Array:
        """-r_n, shape (n_points,), in stress; negative only where the law bears tension."""
        return -self._values["normal_traction"]

    @property
    def tangential_traction(self) -> Array:
        """τ on the body, shape (n_points, gdim), in stress; zeros if the law gives none."""
        if self.law.has_tangential:
            return self._values["traction"]
        return np.zeros_like(self.points)

    @property
    def normal_stiffness(self) -> Array:
        """-∂r_n/∂u_n where closed, (n_points,), in stress/length; see `Law.normal_stiffness`."""
        return self._values["normal_stiffness" if self.law.has_own_normal else "parameter k_n"]

    @property
    def tangential_stiffness(self) -> Array:
        """K_t of the law, shape (n_points, gdim, gdim), in stress/length; zeros without any."""
        d = self._gdim
        if self.law.has_tangential:
            rows = [self._values[f"tangential_stiffness {i}"] for i in range(d)]
            return np.stack(rows, axis=1)
        return np.zeros((self.quadrature.n_points, d, d))

    @property
    def traction(self) -> Array:
        """r_n n + τ on the body, shape (n_points, gdim), in stress."""
        values = self._values
        return values["normal_traction"][:, None] * values["normal"] + self.tangential_traction

    @property
    def tangential_displacement(self) -> Array:
        """u_t (eq. 21), shape (n_points, gdim), in length; zeros if the law has no use for it."""
        if not self.law.has_tangential:
            return np.zeros_like(self.points)
        jump, normal = self._values["jump"], self._values["normal"]
        return jump - np.sum(jump * normal, axis=1)[:, None] * normal

    def slip_vector(self) -> Array:
        """Slip Δu_t + K_t⁻¹ Δτ of the increment, as a vector, (n_points, gdim), in length.

        Where the gap opens the way beyond what the springs give back counts, too. Collective.
        """
        values, normal = self._values, self._values["normal"]
        if self._slip[0] is values:
            return self._slip[1]
        # K_t has no inverse along the normal, and nothing acts there: any stiffness will do.
        along = np.einsum("q,qi,qj->qij", values["parameter k_t"], normal, normal)
        change = (values["traction"] - values["old_traction"])[:, :, None]
        with collective_errors(self.surface.mesh.comm):  # singular, where k_t is next to nothing
            stretched = np.linalg.solve(self.tangential_stiffness + along, change)[:, :, 0]
        self._slip = values, values["increment"] + stretched
        return self._slip[1]

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

        Without tangential tractions a closed point counts as slip: nothing holds it. Where the law
        bears tension no point with an opposite is open; one without is, always.
        """
        closed = self.paired & ((self._values["normal_traction"] < 0) | self.law.has_tension)
        status = np.where(closed, Status.SLIP, Status.OPEN).astype(np.int8)
        if self.law.has_tangential:
            status[closed & np.all(self.slip_increment == 0, axis=1)] = Status.STICK
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


def passing(contacts: Sequence[Contact]) -> dict[str, tuple[float, list[float]]]:
    """`Contact.unseen_penetration` by the names of the contacts that have any. Collective."""
    found = {}
    for contact in contacts:
        others = [c for c in contacts if c is not contact]
        depth, place = contact.unseen_penetration(others)
        if not depth <= 0:
            found[contact.name] = depth, [float(x) for x in place]
    return found


def _range_error(contact: str, name: str, value: float, positive: bool) -> str:
    wanted = "greater than zero" if positive else "zero or greater"
    wanted += " (stress/length)" if name.startswith("k_") else ""
    return f"{contact}: {name} is {value:g} at a point of Γc; it must be finite and {wanted}"


def displacement_degree(u: fem.Function, mesh: Any, name: str) -> int:
    """Check that ``u`` is a displacement of ``mesh`` and return its element's degree."""
    gdim, space = mesh.geometry.dim, u.function_space
    if space.component() or (space.num_sub_spaces and space.dofmap.index_map_bs == 1):
        raise ValueError(
            f"{name}: u is in a mixed element, or a part of one; u must be in a space of its own, "
            f'functionspace(mesh, ("Lagrange", degree, ({gdim},))): mixed formulations are not '
            "supported; for bodies that are nearly incompressible take degree 2 or higher"
        )
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
    basis = u.function_space.element.basix_element
    if basis.family != basix.ElementFamily.P or basis.discontinuous or basis.degree < 1:
        raise ValueError(
            f"{name}: u is in {element}, of degree {basis.degree}; it must be continuous, a "
            "Lagrange element of degree 1 or higher"
        )
    return int(basis.degree)


@dataclass(frozen=True)
class _Seen:
    """What a law sees of a point apart from displacements (UFL).

    Attributes:
        gap: Initial gap, the motion of the support included (length).
        normal: Unit normal from body to support.
        shift: Displacement of the support; None: it has none.
        parameters: Of the law, by name.
    """

    gap: Any
    normal: Any
    shift: Any
    parameters: Mapping[str, Any]

    def relative(self, jump: Any) -> Any:
        """Displacement of the body relative to the support (UFL)."""
        return jump if self.shift is None else jump - self.shift


class _Reactions:
    """What a law makes of the jump at the points: evaluators, compiled when first called."""

    def __init__(self, contact: Contact, law: Law, seen: _Seen) -> None:
        self._contact, self._law, self._seen = weakref.proxy(contact), law, seen

    def traction(self, jump: Any, seen: _Seen | None = None) -> Any:
        """r_n n + τ on the body (UFL)."""
        contact, seen = self._contact, seen or self._seen
        kinematics = contact._kinematics(jump, self._law, seen)
        response = contact._response(self._law, kinematics, seen.parameters)
        total = response.normal_traction * seen.normal
        return total if response.traction is None else total + response.traction

    @cached_property
    def evaluate_traction(self) -> PointEvaluator:
        """The "traction", (n_points, gdim)."""
        return self._evaluator({"traction": self.traction(self._contact._jump)})

    @cached_property
    def evaluate_potential(self) -> PointEvaluator:
        """The "potential" per area, (n_points,)."""
        contact, seen = self._contact, self._seen
        kinematics = contact._kinematics(contact._jump, self._law, seen)
        density = contact._acting_there(self._law.potential(kinematics, seen.parameters))
        return self._evaluator({"potential": density})

    @cached_property
    def evaluate_tangent(self) -> PointEvaluator:
        """Derivatives of the traction, row by row, (n_points, gdim).

        By the jump, "jump i"; and where the support moves freely by its displacement, "support i",
        by the normal, "normal i", and by the "gap".
        """
        contact, seen = self._contact, self._seen
        jump = ufl.variable(contact._jump)
        by = {"jump": jump}
        if contact.free_motion:
            by |= {"normal": ufl.variable(seen.normal), "support": ufl.variable(seen.shift)}
            by |= {"gap": ufl.variable(seen.gap)}
            seen = replace(seen, gap=by["gap"], normal=by["normal"], shift=by["support"])
        traction = self.traction(jump, seen)
        rows: dict[str, Any] = {}
        for name, variable in by.items():
            derivative = ufl.diff(traction, variable)
            if name == "gap":
                rows[name] = derivative
            else:
                rows |= {f"{name} {i}": derivative[i, :] for i in range(contact._gdim)}
        return self._evaluator(rows)

    def _evaluator(self, expressions: Mapping[str, Any]) -> PointEvaluator:
        return PointEvaluator(self._contact.quadrature, expressions, by_points=True)
