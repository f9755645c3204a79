"""Contact: binds displacement, surface, support and law; the boundary form and its results."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.arguments import check_instance, is_number
from fenics_contact.contact.accuracy import Accuracy
from fenics_contact.contact.deformed import DeformedPlaces
from fenics_contact.contact.finite import (
    ExactView,
    FiniteKinematics,
    Frame,
    SampledView,
    check_places,
    check_rigid,
)
from fenics_contact.contact.inputs import FreeMotion, Inputs
from fenics_contact.contact.kinematics import Seen, SmallKinematics
from fenics_contact.contact.multipliers import Multipliers, TraceProjection
from fenics_contact.contact.pairs import Pairs, PairsState
from fenics_contact.contact.passage import Passage
from fenics_contact.contact.point_data import PointData
from fenics_contact.contact.point_law import PointLaw, PointTangent
from fenics_contact.contact.present import PresentKinematics, PresentPairs
from fenics_contact.contact.results import PointResults
from fenics_contact.contact.sampled import SampledPlaces
from fenics_contact.contact.values import PointValues, Status
from fenics_contact.laws.base import Law
from fenics_contact.laws.stiffness import Springs
from fenics_contact.parallel import global_max, global_min, global_sum
from fenics_contact.supports.base import Placement, SampledSupport, Support, as_vector
from fenics_contact.supports.deformable import DeformableBody
from fenics_contact.surface.displacement import Displacement, check_kind
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.mass import assembled
from fenics_contact.surface.surface import ContactSurface, PointEvaluator
from fenics_contact.types import Array, Mask

__all__ = ["Committed", "Contact", "Found", "passing"]


logger = logging.getLogger("fenics_contact")

_ENFORCEMENTS = ("penalty", "augmented")
_KINEMATICS = ("small", "finite")
AnyKinematics: TypeAlias = SmallKinematics | FiniteKinematics | PresentKinematics
# Of augmented enforcement, where nothing is said.
_TOLERANCE = 1e-5
# Normal times outward normal of the body above minus which Γc faces its support.
_FACING = 1e-6
# The size of the mesh times this is a penetration that no mesh has.
_DEEP = 0.1


@dataclass(frozen=True)
class Found:
    """A solved state of a contact, which a commit makes its history.

    Attributes:
        points: All fields at this rank's points.
        history: Those of them that become history, as it has them.
    """

    points: PointValues
    history: Mapping[str, Array]


@dataclass(frozen=True)
class Committed:
    """A committed state of a contact.

    Attributes:
        history: `PointFields.rows`.
        jump: `Contact.committed_jump`.
        angle: `Contact.committed_angle`.
        pairs: Between what.
    """

    history: Array
    jump: Array
    angle: float
    pairs: PairsState


class Contact(PointResults):
    """Frictional contact of Γc with a support, as a boundary form and a committed history.

    Attributes:
        u: The displacement, a vector-valued Lagrange function; of a mixed function one of its own,
            which has the values of the last evaluation.
        displacement: What it is in the function that is solved for.
        surface, support, law: What was given.
        quadrature: The points of Γc.
        history: The committed state.
        multipliers: λ_n and λ_t of augmented enforcement, None under penalty.
        accuracy: What was chosen for the accuracy wanted, None if none was said.
        tolerance: What `enforcement_error` must come below, with multipliers.
        parameters: Every parameter of law and support given by a number, as a ``fem.Constant``
            by name ("friction", "k_n", "displacement" …): set ``.value`` to change it. Of a
            `Scaled` stiffness that is the multiple of E/h.
        entity_maps: For compiling `form` in a problem of one's own.
        name: In messages and files.
        free_motion: Components of the support's displacement that follow from the force on it, as
            scalar constants by number of the component: their values are results (length).
        applied_force: The forces on it, likewise (force).
        free_angle: Angle of a support that is turned by a moment, a scalar constant whose value is
            a result (radians); None: there is none.
        applied_moment: The moment, likewise (force times length).
        inputs: All that was given, as UFL.
        pairs: What lies opposite the points.
        gap_prescribed: Whether the gap was given apart from the geometry.
        finite: Whether gap, normal and slip are those of displacements of any size.
        committed_jump: Displacement relative to the support at the last commit, (n_points, gdim),
            between the places that are opposite each other from then on; zero before the first.
        committed_angle: By which the support had turned then (radians).
    """

    def __init__(
        self,
        u: fem.Function | ufl.core.expr.Expr,
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
        kinematics: str = "small",
        name: str = "contact",
    ) -> None:
        """Bind the parts. Collective; compiles what evaluates the points.

        Args:
            u: Displacement; vector-valued Lagrange of any degree on the surface's mesh. Where it is
                a part of a mixed function w, beside a pressure, that of ``u, p = ufl.split(w)``;
                parts that are bubbles may be added to it, which Γc does not feel.
            surface: Γc.
            support: What it presses on.
            law: The reactions.
            gap: Initial gap s (length) prescribed independently of the support's geometry (paper,
                footnote 1): a number, constant or UFL. The support's motion is added to it, and
                belongs into ``displacement`` of the support: a constant in the gap that is changed
                opens and closes it, as an interference that grows does, and no more. Friction feels
                nothing of what moves along Γc with it, and does no work on it.
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
                over from these springs, round by round, until neither is left (`multipliers`); k_n
                and k_t set how fast.
            tolerance: Of augmented enforcement, by default 1e-5: how much of the largest traction
                the springs may still bear, between 0 and 1, see `enforcement_error`. To the
                functions of the multipliers the penetration is that share of the penalty's.
            kinematics: "small": gap and normals are those of the undeformed body, and the verdict
                looks at what that leaves out. "finite": displacements and rotations may be of any
                size, on a rigid support whose place is known everywhere or on a `DeformableBody`;
                the bulk form should bear them, too. Tractions and stiffness are per undeformed
                area.
            name: In messages and files.

        Raises:
            ValueError: ``u`` is no displacement of this mesh, or data of support or law are wrong.
            TypeError: A parameter is of a type that cannot be a coefficient.
        """
        check_instance("name", name, str)
        order = "the order is Contact(u, surface, support, law)"
        check_kind(u, name, order)
        for what, value, kind in (
            ("surface", surface, ContactSurface),
            ("support", support, Support),
            ("law", law, Law),
        ):
            check_instance(f"{name}: {what}", value, kind, order)
        self.name = name
        self.surface, self.support, self.law = surface, support, law
        self.entity_maps = surface.entity_maps
        mesh = surface.mesh
        self._gdim = gdim = mesh.geometry.dim
        self.displacement = Displacement(u, mesh, name)
        self.u, degree = self.displacement.u, self.displacement.degree
        try:
            law.check_complete()
            law.check_dimension(gdim)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        self.accuracy = None if accuracy is None else Accuracy.of(accuracy)
        self.finite = self._choose_kinematics(kinematics, gap)
        augments, self.tolerance = self._choose_enforcement(enforcement, tolerance)
        # Linear elements hold a curved gap at their nodes alone (docs/enforcement.md). But between
        # two meshes, and on quadrilaterals of any shape, nodes carry no uniform pressure over.
        nodal = augments and degree == 1 and not isinstance(support, DeformableBody)
        nodal = nodal and surface.submesh.topology.cell_name() != "quadrilateral"
        self.quadrature = surface.quadrature(degree, nodal=nodal)
        self.multipliers: Multipliers | None = None
        if augments:
            turning = self.finite and not isinstance(support, DeformableBody)
            self.multipliers = Multipliers(self.quadrature, degree, law, turning=turning)
        self.inputs = Inputs(
            name, self.quadrature, law, support, weight=weight, accuracy=self.accuracy
        )
        if modulus is not None:
            self.set_modulus(modulus)
        self.pairs = Pairs(name, self.u, self.quadrature, support)
        self._present: PresentPairs | None = None
        if self.finite and isinstance(support, DeformableBody):
            self.pairs = self._present = PresentPairs(name, self.u, self.quadrature, support)
        self._frame = Frame(self.inputs.shift, self.inputs.rotation)
        self._jump = fem.Function(self.quadrature.space(gdim), name="jump")
        # Of a support known in numbers: seen from the undeformed Γc, and from where it has moved.
        self._sampled: tuple[SampledPlaces, SampledPlaces] | None = None
        if isinstance(support, SampledSupport):
            self._sampled = self._sample_support(support)
        placement = self._place()
        self.gap_prescribed = gap is not None

        fields = {"opening": 0, "penetration": 0, "normal_traction": 0}
        if law.has_friction:
            fields |= {"traction": gdim, "jump": gdim, "slip": law.n_modes(gdim)}
            fields |= {"normal": gdim} if self.finite and self.rigid else {}
        if self.multipliers is not None:
            fields |= {"multiplier": 0}
        self.history = PointFields(self.quadrature, fields)
        self.committed_jump: Array = np.zeros((self.quadrature.n_points, gdim))
        self.committed_angle = 0.0
        self._has_begun = False

        # All of contact is a sparse map from u to the jump at the points, and the law there: as
        # expressions for the form on Γc, and sampled at the points for all else.
        given = self._given(placement, gap)
        self._data, sampled = self._sample(given, placement)
        self._view: SampledView | None = None
        # 1 at the points that the law is confined to, 0 at others.
        self._within = fem.Function(self.quadrature.space(), name="within")
        self._within.x.array[:] = 1.0
        self._in_form, self._point_law = self._point_laws(given, sampled)
        self._point_law.prepare()
        self._acting = self._point_law
        self._frozen: tuple[PointLaw, fem.Function] | None = None  # and the pressure in it
        self._deformed = DeformedPlaces(self.quadrature, self._jump, placement)
        numbers = support if isinstance(support, SampledSupport) else None
        self._passage = Passage(self.quadrature, numbers or self._support_at)
        self._projection: TraceProjection | None = None
        self._stretch: PointEvaluator | None = None
        self._own_form: Any = None
        self._values: PointValues | None = None
        if self._present is not None:
            self._present.commit()
            self._update_points()
        else:
            if not self.rigid:
                self.pair()
            self._count_from(self._own_jump())

    # ---- construction ----------------------------------------------------------------------------

    def _choose_kinematics(self, kinematics: str, gap: Any) -> bool:
        """Whether they are finite.

        Raises:
            ValueError: It is no word for any, or something was given that has no sense with it.
        """
        name, support, law = self.name, self.support, self.law
        if kinematics not in _KINEMATICS:
            raise ValueError(
                f"{name}: kinematics is {kinematics!r}; use one of {_KINEMATICS} (the share that "
                "passes in a verdict is the kinematics of the ContactProblem)"
            )
        if kinematics == "small":
            if support.rotation is not None:
                raise ValueError(
                    f'{name}: a support that turns needs Contact(kinematics="finite"); for small '
                    "turns give its displacement as a UFL vector"
                )
            return False
        if gap is not None:
            raise ValueError(
                f"{name}: a gap is prescribed, and finite kinematics take it from the places of "
                "body and support; leave the gap out, and move the support by its displacement"
            )
        if law.has_tangential and not law.has_friction:
            raise ValueError(
                f"{name}: {type(law).__name__} bonds points to places of the support, and finite "
                "kinematics know no such law; use one with friction, or leave k_t out"
            )
        return True

    def _point_laws(self, given: Seen, sampled: Seen) -> tuple[PointLaw, PointLaw]:
        """The law in the form on Γc, and at numbers at the points. Collective."""
        law, history, x = self.law, self.history, ufl.SpatialCoordinate(self.surface.mesh)
        multipliers = None if self.multipliers is None else self.multipliers.fields
        in_form: AnyKinematics
        at_points: AnyKinematics
        in_form = at_points = SmallKinematics(history, multipliers)
        if self._present is not None:
            in_form = at_points = PresentKinematics(self._present, multipliers)
        elif self.finite:
            place = self._support_at if self._sampled is None else self._sampled[1].at
            exact = ExactView(x, self._frame, place, history, multipliers)
            turns, friction = self._frame.rotation is not None, law.has_friction
            self._view = SampledView(
                exact, self.quadrature, self._jump, turns=turns, friction=friction
            )
            in_form = FiniteKinematics(exact, multipliers)
            at_points = FiniteKinematics(self._view, multipliers)
        # Where all follows from X + u less the motion of the support, so do its derivatives.
        free = [] if self.finite else list(self.free_motion)
        paired = self.pairs.acts
        acts = self._within if paired is None else paired * self._within
        felt = self._felt
        return (
            PointLaw(law, given, in_form, self.quadrature, felt, acts=paired, free=free),
            PointLaw(law, sampled, at_points, self.quadrature, felt, acts=acts, free=free),
        )

    @property
    def _felt(self) -> fem.Function:
        """What laws are functions of, at the points."""
        return self._jump if self._present is None else self._present.felt.function

    def _choose_enforcement(
        self, enforcement: str | None, tolerance: float | None
    ) -> tuple[bool, float]:
        """Whether there are multipliers, and the tolerance.

        Raises:
            ValueError: The law has no use for them, or the tolerance is none.
        """
        chosen = self.accuracy
        if enforcement is None:
            enforcement = chosen.enforcement if chosen and self.regularised else "penalty"
        if tolerance is None:
            tolerance = chosen.tolerance if chosen else _TOLERANCE
        if enforcement not in _ENFORCEMENTS:
            raise ValueError(
                f"{self.name}: enforcement is {enforcement!r}; use one of {_ENFORCEMENTS}"
            )
        if not (is_number(tolerance) and 0.0 < tolerance < 1.0):
            raise ValueError(
                f"{self.name}: tolerance is {tolerance!r}; it must be a number between 0 and 1"
            )
        if enforcement == "penalty":
            return False, tolerance
        if not self.regularised:
            springs = [n for n, v in self.law.parameters().items() if isinstance(v, Springs)]
            what = f"{springs[0]} by Springs" if springs else type(self.law).__name__
            raise ValueError(
                f"{self.name}: {what} has the stiffness of something that is there; multipliers "
                'would take it away; use enforcement="penalty", or a law and stiffness that stand '
                "for rigid contact"
            )
        return True, tolerance

    def _place(self) -> Placement:
        """Where the support is, seen from the undeformed Γc (UFL)."""
        mesh = self.surface.mesh
        if self.pairs.distance is not None:
            return Placement(self.pairs.distance, ufl.FacetNormal(mesh))
        x = ufl.SpatialCoordinate(mesh)
        if self.finite:
            check_rigid(self.name, self.inputs.shift, self.inputs.rotation)
        if self._sampled is None and not self.finite:
            return self._support_at(x, self.inputs.shift)
        if self._sampled is None:
            check_places(self.name, self._support_at, mesh)
            place = self._support_at(self._frame.into(x))
        else:
            place = self._sampled[0].at(self._frame.into(x))
        return Placement(place.gap, self._frame.turned(place.direction))

    def _sample_support(self, support: SampledSupport) -> tuple[SampledPlaces, SampledPlaces]:
        """From X, and from X + u, in the frame of the support. Collective.

        Raises:
            ValueError: Its data are of another dimension, or not the same on every rank.
        """
        mesh, d = self.surface.mesh, self._gdim
        kind = type(support).__name__
        if support.gdim != d:
            raise ValueError(
                f"{self.name}: the {kind} is given in {support.gdim} dimensions, and the mesh has "
                f"{d}; give it {d} coordinates a point"
            )
        if len(set(mesh.comm.allgather(support.fingerprint))) > 1:
            raise ValueError(
                f"{self.name}: the data of the {kind} differ from rank to rank; give every rank "
                "the same (read the file on all of them, or broadcast its arrays)"
            )
        x = ufl.SpatialCoordinate(mesh)
        places = (self._frame.into(x), self._frame.into(x + self._jump))
        rest, moved = (SampledPlaces(self.quadrature, support, place) for place in places)
        return rest, moved

    def _support_at(self, x: Any, shift: Any = None) -> Placement:
        """Where a rigid support is, seen from x (UFL)."""
        return self.support.place(x, shift, lambda v: self.inputs.to_ufl("support", v))

    def _given(self, placement: Placement, gap: Any) -> Seen:
        """What laws see, as expressions on Γc."""
        shift, normal = self.inputs.shift, placement.normal
        open_gap = placement.gap
        if gap is not None:
            open_gap = self.inputs.scalar("gap", gap)
            if shift is not None:
                open_gap = open_gap + ufl.dot(shift, normal)
        return Seen(open_gap, normal, shift, self.inputs.law)

    def _sample(self, given: Seen, placement: Placement) -> tuple[PointData, Seen]:
        """The same at the points, and more that is known there."""
        mesh, inputs, direction = self.surface.mesh, self.inputs, placement.direction
        expressions = {
            "x": ufl.SpatialCoordinate(mesh),
            "normal": given.normal,
            "direction_length": ufl.sqrt(ufl.dot(direction, direction)),
            "facing": ufl.dot(given.normal, ufl.FacetNormal(mesh)),
            "weight": inputs.weight,
            "initial_gap": given.gap,
            "shift": inputs.prescribed_shift(),
        } | {f"parameter {n}": v for n, v in given.parameters.items()}
        if inputs.rotation is not None:
            d, matrix = self._gdim, inputs.rotation[0]
            expressions["about"] = inputs.rotation[1]
            if d == 3:
                expressions["axis"] = inputs.axis
            if inputs.free_angle is None:
                rows = [matrix[i, j] for i in range(d) for j in range(d)]
                expressions |= {"angle": inputs.angle, "turn": ufl.as_vector(rows)}
        seen = ["initial_gap", "normal", *(f"parameter {n}" for n in given.parameters)]
        if given.shift is not None:
            expressions["support"] = given.shift
            seen.append("support")
        for i, free in inputs.free_shift.items():
            expressions |= {f"gap by {i}": ufl.diff(given.gap, free)}
            expressions |= {f"normal by {i}": ufl.diff(given.normal, free)}
        data = PointData(self.quadrature, expressions, seen)
        sampled = Seen(
            data.ufl("initial_gap"),
            data.ufl("normal"),
            None if given.shift is None else data.ufl("support"),
            {n: data.ufl(f"parameter {n}") for n in given.parameters},
        )
        return data, sampled

    # ---- forms -----------------------------------------------------------------------------------

    def form(self, v: ufl.Argument) -> ufl.Form:
        """Virtual work of contact, to be **added** to a residual: -∫ (r_n v_n + τ·v_t) (46, 55).

        Args:
            v: Test function of ``u``'s space, of a mixed function the part of the test function
                that ``ufl.split`` gives. Compile with ``entity_maps=contact.entity_maps``.
                With a `SampledSupport` call `evaluate` before assembling, wherever ``u`` or the
                support has moved: the form has the expansion about where it was sampled last.

        Raises:
            ValueError: A stiffness is `Scaled` and the modulus is not known; or the support is
                another body, or moves by an amount that is unknown.
        """
        self._check_form()
        return self._form_at(self.displacement.expression, v)

    def _check_form(self) -> None:
        """Refuse what no form on Γc can hold."""
        if self.motions:
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

    def _form_at(self, displacement: Any, v: ufl.Argument) -> ufl.Form:
        """`form` at a displacement relative to what lies opposite."""
        traction = self._in_form.traction(displacement)
        return -self.inputs.weight * ufl.dot(traction, v) * self.quadrature.ds

    def potential(self) -> ufl.Form:
        """Energy whose derivative by ``u`` is `form` (eq. 19, 43).

        Raises:
            ValueError: The law has none (Coulomb; a foundation with k_t and without tension; any
                friction in a frame that turns), or as for `form`.
        """
        self._check_form()
        if self.law.has_potential and not self.has_potential:
            raise ValueError(
                f"{self.name}: friction has no potential with finite kinematics, whose tangent "
                "planes turn; use the form"
            )
        return (
            self.inputs.weight
            * self._in_form.potential(self.displacement.expression)
            * self.quadrature.ds
        )

    def tangent(self, v: ufl.Argument, du: ufl.Argument) -> ufl.Form:
        """Consistent tangent, the derivative of `form`; unsymmetric where Coulomb slips."""
        return ufl.derivative(self.form(v), self.displacement.whole, du)

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
        return self._acting.evaluate_traction()

    def acting_tangent(self) -> PointTangent:
        """Derivatives of `acting_traction` at the present ``u``. Collective."""
        self._update_points()
        data = self._data.values
        turns = {}
        if self._present is not None:
            by_felt = self._acting.evaluate_tangent({}).by_jump
            traction = self._acting.evaluate_traction()
            return PointTangent(self._present.tangent(by_felt, traction, self.history))
        if not self.finite:
            turns = {i: (data[f"gap by {i}"], data[f"normal by {i}"]) for i in self.free_motion}
        tangent = self._acting.evaluate_tangent(turns)
        if self.free_angle is None:
            return tangent
        assert self.support.rotation is not None
        spun = self.support.rotation.rate(self._acting.evaluate_traction())
        return replace(tangent, spun=spun)

    def turning_rate(self) -> Array:
        """Way by a unit angle of the support's points where those of Γc are now. Collective.

        Returns:
            ω × r, with r from the axis as it is now, (n_points, gdim) (length).

        Raises:
            ValueError: The support does not turn.
        """
        if self.support.rotation is None:
            raise ValueError(f"{self.name}: the support does not turn")
        jump = self._own_jump()
        self._update_data()
        data = self._data.values
        arm = data["x"] + jump - data["about"] - data.get("support", 0.0)
        return self.support.rotation.rate(arm)

    def energy(self) -> float:
        """`potential` at the present ``u``, this rank's points only. Collective.

        Raises:
            ValueError: The law has none.
        """
        self._update_points()
        return float(self.area @ self._acting.evaluate_potential())

    def own_forces(self) -> tuple[Array, Array]:
        """Nodal forces on the body with Γc at the present ``u``, by two routes. Collective.

        Returns:
            (n_owned_dofs,) each (force): as `add_force` has them, by sums over the points; and as
            DOLFINx assembles the boundary form (46, 55), in which ``u`` itself stands where the
            support is rigid and no motion of it is unknown, and the jump at the points otherwise.
        """
        space = self.u.function_space
        self._update_points()
        vector, forces = self.pairs.own_map.createVecs()
        forces.array[:] = (self.area[:, None] * self._point_law.evaluate_traction()).ravel()
        self.pairs.own_map.multTranspose(forces, vector)
        by_points = vector.array_r.copy()
        for item in (vector, forces):
            item.destroy()
        if self._own_form is None:
            displacement = self.u if self.rigid and not self.motions else self._felt
            form = self._form_at(displacement, ufl.TestFunction(space))
            self._own_form = compat.compile_form(-form, self.entity_maps)
        return by_points, assembled(self._own_form)[: by_points.size].copy()

    def freeze(self, pressure: Array) -> None:
        """Let `Law.at_pressure` act. Collective.

        `acting_traction`, `acting_tangent` and `energy` are those of it; results are not.

        Args:
            pressure: ≥ 0, shape (n_points,) (stress).
        """
        if self.has_potential:
            return
        if self._frozen is None:
            given = fem.Function(self.quadrature.space(), name="pressure")
            parameters = {**self._point_law.seen.parameters, "pressure": given}
            law = self.law.at_pressure(given)
            self._frozen = self._point_law.with_law(law, parameters), given
        self._acting, given = self._frozen
        given.x.array[: self.quadrature.n_points] = pressure
        given.x.scatter_forward()

    @property
    def has_potential(self) -> bool:
        """Whether the tractions follow from a potential, and the tangent is symmetric."""
        if self._present is not None:
            return False
        return self.law.has_potential and not (self.finite and self.law.has_tangential)

    @property
    def freezes(self) -> bool:
        """Whether there is a potential, at least under a given pressure."""
        if self._present is not None or (self.finite and self.law.has_tangential):
            return False
        return self.law.at_pressure(ufl.as_ufl(0.0)).has_potential

    def thaw(self) -> None:
        """Let the law itself act again."""
        self._acting = self._point_law

    def confine(self, points: Mask | None = None) -> None:
        """Let the law act at some of the points alone. Collective.

        At the others nothing acts, whatever they do: they are open.

        Args:
            points: Mask of them, (n_points,); None: all, as at first.
        """
        self._within.x.array[: self.quadrature.n_points] = 1.0 if points is None else points
        self._within.x.scatter_forward()
        self.forget()

    def springs(self, normal: npt.ArrayLike, tangential: npt.ArrayLike) -> Array:
        """Symmetric stiffness a K_n + b K_t of section 5 at the points as evaluated.

        Args:
            normal: a, a number or one per owned point.
            tangential: b, likewise.

        Returns:
            (n_points, gdim, gdim) (stress/length).
        """
        values = self.values
        n = self.quadrature.n_points
        along = np.einsum("qi,qj->qij", values.normal, values.normal)
        stiffness = np.asarray(normal) * values.normal_stiffness
        share = np.broadcast_to(np.asarray(tangential), (n,))
        return np.asarray(
            stiffness[:, None, None] * along + share[:, None, None] * values.tangential_stiffness
        )

    def _update_points(self) -> None:
        """Let the points be at the present ``u`` and data. Collective."""
        self._update_data()
        if self._present is not None:
            data, history = self._data.values, self.history
            traction = history if self.multipliers is None else self.multipliers.fields
            self.displacement.follow()
            self._present.follow(data["x"], data["normal"], history, traction)
        self._update_jump()
        if self._view is not None:
            if self._sampled is not None:
                self._sampled[1].update()
            self._view.update()

    def _update_jump(self) -> None:
        """Let the displacement at the points be the present one. Collective."""
        self.displacement.follow()
        self.jump_map.mult(self.u.x.petsc_vec, self._jump.x.petsc_vec)
        self._jump.x.scatter_forward()

    def _update_data(self) -> None:
        """Let what does not follow from ``u`` be as it was given last. Collective."""
        if self._sampled is not None:
            self._sampled[0].update()
        self._data.update()

    def _evaluate(self) -> PointValues:
        """Everything at the points, as they were updated last. Collective."""
        arrays = {**self._data.values, **self._point_law.evaluate()}
        if self._present is not None:
            arrays["paired"] = self.paired.astype(np.float64)
            arrays["depth"] = self.pairs.depth(arrays["normal_displacement"])
        elif not self.rigid:
            arrays["paired"] = self.paired.astype(np.float64)
            arrays["depth"] = self.pairs.depth(arrays["normal_displacement"])
            since = 0.0 if self.pairs.found_at is None else self.committed_jump
            slide, normal = arrays["jump"] - since, arrays["normal"]
            arrays["slide"] = slide - np.sum(slide * normal, axis=1)[:, None] * normal
        return PointValues.of(arrays)

    # ---- what was given --------------------------------------------------------------------------

    @property
    def parameters(self) -> dict[str, fem.Constant]:
        """What was given by a number; see the class."""
        return self.inputs.constants

    @property
    def weight(self) -> ufl.core.expr.Expr:
        """Factor of the surface measure (UFL)."""
        return self.inputs.weight

    @property
    def stiffness_factor(self) -> fem.Constant:
        """Factor of k_n and k_t, 1 but for the while in which stiffness is led up to it."""
        return self.inputs.stiffness_factor

    @property
    def free_motion(self) -> dict[int, fem.Constant]:
        """Unknown components of the support's displacement; see the class."""
        return self.inputs.free_motion

    @property
    def applied_force(self) -> dict[int, Any]:
        """The forces on them; see the class."""
        return self.inputs.applied_force

    @property
    def free_angle(self) -> fem.Constant | None:
        """Unknown angle of the support; see the class."""
        return self.inputs.free_angle

    @property
    def applied_moment(self) -> fem.Constant | None:
        """The moment that turns it; see the class."""
        return self.inputs.applied_moment

    @property
    def motions(self) -> list[FreeMotion]:
        """All unknowns of the support, displacements before the angle."""
        return self.inputs.motions

    @property
    def needs_modulus(self) -> bool:
        """Whether a stiffness is `Scaled` and still waits for `set_modulus`."""
        return self.inputs.needs_modulus

    def set_modulus(self, modulus: Any) -> None:
        """Fix E for `Scaled` stiffnesses: a number or a function, one value a cell. Collective."""
        self.inputs.set_modulus(modulus)

    @property
    def regularised(self) -> bool:
        """Whether the stiffness stands for none at all, and is not that of physical springs."""
        springs = (isinstance(v, Springs) for v in self.law.parameters().values())
        return not self.law.is_physical and not any(springs)

    def check_input(self) -> None:
        """Refuse parameters that are out of range or not finite at some point of Γc. Collective.

        Raises:
            ValueError: On all ranks.
        """
        self.inputs.update()
        self.evaluate()
        self.inputs.check(self.values)

    def check_side(self) -> None:
        """Refuse, or warn of, a support that all of Γc looks away from. Collective.

        Raises:
            ValueError: The body is deep inside of it, too.
        """
        comm, values = self.surface.mesh.comm, self.values
        if global_max(comm, values.facing) > -_FACING:  # NaN has its own errors
            return
        x, depth = self.surface.mesh.geometry.x, -global_min(comm, values.initial_gap)
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

    def given(self) -> dict[str, Array]:
        """The data of law, support and contact at this rank's points, by name. Collective.

        What was evaluated before stays.
        """
        self.inputs.update()
        self._update_data()
        data = self._data.values
        names = ["weight", "normal", "shift", "turn", "about", "axis"]
        if self.gap_prescribed or not self.pairs_anew:  # else it is that of the latest pairs
            names.append("initial_gap")
        return {n: v for n, v in data.items() if n in names or n.startswith("parameter ")}

    # ---- pairs -----------------------------------------------------------------------------------

    @property
    def rigid(self) -> bool:
        """Whether the support is rigid: its reactions are then external to the mesh."""
        return self.pairs.search is None

    @property
    def turns(self) -> bool:
        """Whether the support turns."""
        return self._frame.rotation is not None

    def follow(self) -> None:
        """Let pairs that follow the bodies be those of the present ``u``. Collective."""
        if self._present is not None:
            self._update_points()

    @property
    def follows(self) -> bool:
        """Whether the pairs follow the bodies wherever they go."""
        return self._present is not None

    @property
    def flat(self) -> bool:
        """Whether Γc has lost its tangent plane somewhere, with pairs that follow the bodies."""
        return self._present is not None and self._present.flat

    def turned(self, vectors: Array) -> Array:
        """Directions in the frame of the support, as they are in space: (n_points, gdim)."""
        if self._present is not None:
            return self._present.turned(vectors)
        if self._view is None:
            return vectors
        return self._view.turned(vectors)

    @property
    def couples(self) -> bool:
        """Whether contact ties unknowns together that the bulk does not."""
        return not self.rigid or bool(self.motions)

    @property
    def pairs_anew(self) -> bool:
        """Whether opposites are found anew, on the deformed bodies, at every commit."""
        if self._present is not None:
            return False
        return isinstance(self.support, DeformableBody) and self.support.update == "increment"

    @property
    def jump_map(self) -> PETSc.Mat:
        """Sparse map from ``u`` to its jump at the points, (n_points gdim, n_dofs).

        Over the unknowns of a problem it is a `ContactOperator`.
        """
        return self.pairs.jump_map

    @property
    def local_map(self) -> PETSc.Mat | None:
        """Sparse map from ``u`` to what derivatives at the points are by, where that is another.

        With pairs that follow the bodies, see `PresentPairs`.
        """
        return None if self._present is None else self._present.local_map

    @property
    def pairings(self) -> int:
        """How often opposites were found: the map changes with each."""
        return self.pairs.number

    @property
    def paired(self) -> Mask:
        """Which of this rank's points have an opposite, (n_points,); all on a rigid support.

        The others bear nothing and are open.
        """
        return self.pairs.paired

    @property
    def n_unpaired(self) -> int:
        """Points without an opposite, on all ranks."""
        return self.pairs.n_unpaired

    def pair(self, u: fem.Function | None = None) -> None:
        """Find the opposites of all points. Collective.

        Args:
            u: Displacement of the bodies in which to find them; none: the undeformed bodies.

        Points that find none are open, whatever they do, and counted in ``n_unpaired``. A warning
        says why, if they are more than half of all.
        """
        self._find_pairs(u, None)

    def _find_pairs(self, u: fem.Function | None, depth: Array | None) -> None:
        """`pair`, with the depth of the points in the opposite where it is known. Collective."""
        self._update_points()
        if self._present is not None:
            return
        points = self._evaluate()
        if depth is None:
            depth = np.zeros(self.quadrature.n_points) if u is None else points.depth
        self.pairs.find(points.x, points.normal, depth, u)
        self.forget()

    def own_displacement(self) -> Array:
        """Of the body that has Γc, at the points, (n_points, gdim) (length). Collective."""
        return self.pairs.own_displacement()

    def moment(self, about: Sequence[float]) -> Array:
        """Moment of the contact forces on the body about a point. Collective.

        They act on the undeformed Γc, or with finite kinematics at X + u. That on a rigid support
        is the opposite.

        Args:
            about: The point, gdim numbers (length).

        Returns:
            Its component out of the plane, (1,), or in space (3,) (force times length).
        """
        values = self.values
        arm = values.x - as_vector(f"{self.name}: about", about, self._gdim)
        if self.finite:
            arm = arm + self.own_displacement()
        force = self.measure[:, None] * values.total_traction
        if self._gdim == 3:
            turn = np.cross(arm, force)
        else:
            turn = (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0])[:, None]
        return global_sum(self.surface.mesh.comm, turn.sum(axis=0))

    def area_stretch(self) -> Array:
        """Deformed area by undeformed, |J F⁻ᵀ N| with F = I + grad u, (n_points,). Collective.

        Tractions divided by it are true ones (Cauchy's), per deformed area; those of the contact
        are nominal. Of axisymmetric bodies, whose hoops stretch too, by 1 + u_r/r more.
        """
        self.displacement.follow()
        if self._stretch is None:
            gradient = ufl.Identity(self._gdim) + ufl.grad(self.u)
            turned = ufl.transpose(ufl.inv(gradient))
            normal = ufl.det(gradient) * ufl.dot(turned, ufl.FacetNormal(self.surface.mesh))
            area = ufl.sqrt(ufl.dot(normal, normal))
            self._stretch = PointEvaluator(self.quadrature, {"area": area})
        return self._stretch()["area"]

    def relative_slide(self) -> Array:
        """Tangential displacement since pairs were found, (n_points, gdim) (length)."""
        return self.values.slide

    def true_placement(self) -> tuple[Array, Array]:
        """Gap and normal where the body has moved to: at X + u instead of X. Collective.

        With finite kinematics these are the gap and normal of the contact itself.

        Returns:
            Gap, (n_points,) (length): NaN where there is no opposite, and infinite where an
            `Obstacle` says no distance that could be told at other places; and unit normals from
            body to support, (n_points, gdim).
        """
        if not self.rigid:
            return self.true_gap()
        self._update_points()
        if self._view is not None:
            return self._view.values("gap"), self._view.values("normal")
        if self._sampled is not None:
            places = self._sampled[1]
            places.update()
            return places.values("distance"), places.values("normal")
        return self._deformed()

    def distance_slope(self) -> Array:
        """Length of the gradient of the gap where points are, (n_points,): 1 of a distance.

        At X with small displacements, at X + u with finite ones. Collective.
        """
        values = self.values
        if self._view is not None:
            return np.asarray(np.linalg.norm(self._view.values("slope"), axis=1))
        if self.support.is_distance:
            return self._data.values["direction_length"].copy()
        return np.ones(len(values.x))

    def support_curvature(self) -> Array:
        """Second derivatives of the distance at X + u, (n_points, gdim, gdim) (1/length).

        Collective.

        Raises:
            ValueError: Displacements are taken as small.
        """
        if self._view is None:
            raise ValueError(f'{self.name}: there is none without kinematics="finite"')
        turns = [self._view.values(f"turn {i}") for i in range(self._gdim)]
        by_place = -np.stack(turns, axis=1)
        return np.asarray(by_place + by_place.swapaxes(1, 2)) / 2

    def angle(self) -> float:
        """By which the support has turned since it began, 0 where it cannot (radians). Collective.

        It is that of the last evaluation.
        """
        if self.free_angle is not None:
            return float(self.free_angle.value)
        if self.inputs.angle is None:
            return 0.0
        # The same at all points.
        return global_max(self.surface.mesh.comm, self.values.arrays["angle"])

    def turned_by(self) -> float:
        """By which the support has turned since the last commit (radians). Collective."""
        return self.angle() - self.committed_angle

    def passed_through(self) -> Mask:
        """Points that have gone through the support since the last commit, (n_points,).

        Of points that go straight on, and a support that turns evenly, with finite kinematics.
        Collective.

        Raises:
            ValueError: Displacements are taken as small.
        """
        if not self.finite:
            raise ValueError(f'{self.name}: there is none without kinematics="finite"')
        if self._present is not None:
            return self._present.passed_through()
        x, jump, rotation = self.points, self.values.jump, self.support.rotation
        angle = self.turned_by()

        def turned(places: Array, share: float) -> Array:
            if rotation is None:
                return places
            about = self.values.arrays["about"]
            return about + rotation.turned(places - about, share * angle)

        return self._passage.through(x + self.committed_jump, x + jump, turned)

    def gap_deviation(self) -> tuple[Array, Array]:
        """True gap minus the linearised one, and the true normals: at X + u, not X. Collective.

        Returns:
            (n_points,) (length), NaN where there is no opposite in truth, and 0 where an `Obstacle`
            says no distance that could be told elsewhere; unit normals, (n_points, gdim).
        """
        gap, normal = self.true_placement()
        if self.rigid:
            return np.where(np.isinf(gap), 0.0, gap - self.gap), normal
        # Between facets that do not match it jumps from point to point; what is answered to is a
        # function on Γc.
        change = gap - self.pairs.linear_gap(self.values)
        smooth = self._traces()(np.nan_to_num(change))
        return np.where(np.isnan(change), np.nan, smooth), normal

    def true_gap(self) -> tuple[Array, Array]:
        """Distances to the opposite in the bodies as they are displaced now, by a search anew.

        To compare with the linearised ones, `gap`. The pairs stay as they are. Collective.

        Returns:
            Distance along the true normal of the displaced Γc, (n_points,) (length), NaN where
            there is no opposite; and these unit normals, (n_points, gdim).

        Raises:
            ValueError: The support is rigid.
        """
        if self.rigid:
            raise ValueError(f"{self.name}: the support is no DeformableBody; see `gap`")
        return self.pairs.true_gap(self.values)

    def unseen_penetration(
        self, others: Sequence[Contact] = (), *, stiffness: float = 0.0
    ) -> tuple[float, Array]:
        """How deep the opposite passes through Γc between the points of Γc. Collective.

        Corners and middles of the opposite's facets are followed back to Γc, with the pairs as they
        are and at the last evaluated state. Where one lies deeper than any point of the contacts,
        while no point of the facet that it passes through nor of its neighbours is closed, nothing
        holds it up. Facets of curved surfaces may overlap by what they differ from these.

        Args:
            others: Further contacts, whose points see the opposite where it is their Γc.
            stiffness: Of the bodies by area, about E/h times the contact's weight (force/length by
                area): what bears less than a millionth of it times the depth holds nothing up.

        Returns:
            The largest such depth (length), 0 if there is none or the support is rigid, and the
            place in the undeformed body, (gdim,).
        """
        if self.rigid:
            return 0.0, np.zeros(self._gdim)
        comm = self.surface.mesh.comm
        return self.pairs.unseen_penetration(
            self.values,
            self.status != Status.OPEN,
            max(global_max(comm, c.values.penetration) for c in (self, *others)),
            [c.pairs for c in others],
            gap_prescribed=self.gap_prescribed,
            stiffness=stiffness / global_max(comm, self.values.weight),
        )

    def _traces(self) -> TraceProjection:
        """The projection on functions on Γc that displacements can answer to. Collective."""
        if self._projection is None:
            self._projection = TraceProjection(self.quadrature, self.displacement.degree)
        return self._projection

    # ---- state -----------------------------------------------------------------------------------

    def evaluate(self) -> None:
        """Evaluate gap, reactions and slip at the present ``u``; the history stays. Collective."""
        self._update_points()
        self._values = self._evaluate()

    def evaluate_yield(self) -> tuple[Array, Array]:
        """The law's yield functions at the present ``u``, and their gradients. Collective.

        Returns:
            g_j(τ, limit) (stress), (n_points, n_modes), and ∂g_j/∂τ, (n_points, n_modes, gdim).
        """
        self._update_points()
        return self._point_law.evaluate_yield()

    def forget(self) -> None:
        """Drop what was evaluated: the next look at a result evaluates the present ``u``."""
        self._values = None

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
        borne any more and multipliers are left. Where multipliers grow from round to round, and
        springs bear what they did, it is relative to the tractions of the first round.

        Raises:
            ValueError: There are no multipliers.
        """
        return self._augmented().error(self.values, self.history, self.moved())

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
        error = multipliers.error(self.values, self.history, self.moved())
        multipliers.update(self.values)
        self.forget()
        return error

    def moved(self) -> Array:
        """Displacements that the jump is the difference of, whose round-off it has. Collective.

        Returns:
            Sum of their sizes at this rank's points, (n_points,) (length).
        """
        parts = self.own_displacement(), self.values.jump
        return np.asarray(sum(np.linalg.norm(part, axis=1) for part in parts))

    def _augmented(self) -> Multipliers:
        if self.multipliers is None:
            raise ValueError(
                f'{self.name}: there are no multipliers; make it with enforcement="augmented"'
            )
        return self.multipliers

    def borne_by_springs(self) -> Array:
        """What of the traction the springs bear in place of rigid contact: (n_points, gdim).

        As far as displacements of Γc can answer it, see `multipliers`: (stress). Zero where the
        stiffness is physical. Collective.
        """
        values = self.values
        if not self.regularised:
            return np.zeros_like(values.x)
        project = self._traces()
        pressure = np.zeros(self.quadrature.n_points)
        if self.law.has_normal_stiffness:
            pressure = project(self.pressure)
        side = project(self.tangential_traction)
        if self.multipliers is not None:
            pressure = pressure - self.multipliers.fields.values("pressure")
            if self.law.has_friction:
                side = side - self.multipliers.fields.values("traction")
        return np.asarray(side - pressure[:, None] * values.normal)

    def found(self) -> Found:
        """The state as evaluated, for `commit`: nothing that changes later changes it."""
        points = self.values
        values = {n: points.arrays[n] for n in ("opening", "penetration", "normal_traction")}
        if self.law.has_friction:
            values |= {
                "traction": points.framed_traction,
                "jump": points.foot,
                "normal": points.framed_normal,
                "slip": self.history.values("slip") + points.slip_increment,
            }
        if self.multipliers is not None:
            values |= self.multipliers.committed(points)
        if self._present is not None and self.law.has_friction:
            values |= {n: self._present.turned(values[n]) for n in ("traction", "jump")}
        return Found(points, values)

    def begin(self) -> None:
        """Let slip be counted from the present ``u``, if nothing has been committed. Collective.

        The support is where it was given, not displaced. `ContactProblem` calls it before its
        first increment; the constructor has done so for the ``u`` of then.
        """
        if self._has_begun:
            return
        if self._present is not None:
            if not self._present.is_begun():
                self._present.commit()
                self.forget()
            return
        jump = self._own_jump()
        if global_max(self.surface.mesh.comm, np.abs(jump - self.committed_jump)) > 0:
            self._count_from(jump)

    def _own_jump(self) -> Array:
        """Displacement relative to what lies opposite, or of the body alone. Collective."""
        self._update_jump()
        rows = self._jump.x.array.reshape(-1, self._gdim)
        return np.array(rows[: self.quadrature.n_points])

    def _count_from(self, jump: Array) -> None:
        """Let slip be counted from a displacement, the present one. Collective."""
        self.committed_jump = jump
        if self.law.has_friction:
            start = {name: self.history.values(name) for name in self.history.names}
            start["jump"] = jump
            self.history.commit(start | (self._begin_on_support(jump) if self.finite else {}))
            self.restore()

    def _begin_on_support(self, jump: Array) -> dict[str, Array]:
        """The foot, minus X, and the normal there, with finite kinematics. Collective."""
        self._update_data()
        gap, normal = self._passage.sample(self._data.values["x"] + jump)
        return {"jump": jump + gap[:, None] * normal, "normal": normal}

    def commit(self, found: Found | None = None) -> None:
        """Make a state the history of the next increment. Collective.

        Args:
            found: What `found` gave; by default the state at the present ``u``.
        """
        if found is None:
            self.evaluate()
            found = self.found()
        points, values = found.points, dict(found.history)
        self._has_begun = True
        self.history.commit(values)
        self._values, self.committed_jump = points, points.jump
        if self._present is not None:
            self._present.commit()
            self.committed_jump = np.zeros_like(points.jump)
        self.committed_angle = self.angle()
        if self.pairs_anew:
            # The traction stays with the points of Γc; what they slip over has moved on.
            self.pair(self.u)
            self.committed_jump = self.values.jump
            if self.law.has_friction:
                moved = values["jump"] + self.committed_jump - points.jump
                self.history.commit(values | {"jump": moved})
            self._values = points  # results stay those of the solution
        if self.multipliers is not None:
            self.multipliers.restore(self.history)

    def committed(self) -> Committed:
        """The committed state, for `set_committed`."""
        rows = self.history.rows()
        return Committed(rows, self.committed_jump, self.committed_angle, self.pairs.state())

    def set_committed(self, state: Committed) -> None:
        """Make a state the committed one again; `restore` drops what came after it. Collective."""
        self.history.set_rows(state.history)
        self.committed_jump, self._has_begun = state.jump, True
        self.committed_angle = state.angle
        self.pairs.set_state(state.pairs)

    def take_up(self, history: Array, values: Mapping[str, Array]) -> None:
        """Make a state of another run the committed one, at the u that it has. Collective.

        Args:
            history: `PointFields.rows` of that run, with ``u`` and loads as they were in it.
            values: The arrays of its `values`, for the results to be those of its solution.
        """
        self.history.set_rows(history)
        if self._present is not None:
            self._present.commit()
        if self.pairs_anew:
            # The pairs by which they were as deep as that are gone.
            self._find_pairs(self.u, values.get("depth"))
        self.restore()
        self.committed_jump, self._has_begun = self.values.jump, True
        self.committed_angle = self.angle()
        mine = self.values.arrays
        if {n: v.shape for n, v in values.items()} == {n: v.shape for n, v in mine.items()}:
            self._values = PointValues.of(values)

    @property
    def values(self) -> PointValues:
        """All fields of the last evaluation at this rank's points."""
        if self._values is None:
            self.evaluate()
            assert self._values is not None
        return self._values


def passing(contacts: Sequence[Contact], stiffness: float) -> dict[str, tuple[float, list[float]]]:
    """`Contact.unseen_penetration` by the names of the contacts that have any. Collective.

    Args:
        contacts: The contacts.
        stiffness: See there.
    """
    found = {}
    for contact in contacts:
        others = [c for c in contacts if c is not contact]
        depth, place = contact.unseen_penetration(others, stiffness=stiffness)
        if not depth <= 0:
            found[contact.name] = depth, [float(x) for x in place]
    return found
