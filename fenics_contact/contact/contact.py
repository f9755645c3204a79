"""Contact: binds displacement, surface, obstacle and law; the boundary form and its results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from fenics_contact.arguments import check_instance
from fenics_contact.contact.accuracy import Accuracy
from fenics_contact.contact.acting import ActingLaw
from fenics_contact.contact.choices import (
    enforcement_of,
    is_finite,
    is_regularised,
    opposite_of,
)
from fenics_contact.contact.inputs import FreeMotion, Inputs, varies
from fenics_contact.contact.multipliers import Multipliers, TraceProjection
from fenics_contact.contact.opposite import OppositeState, Parts
from fenics_contact.contact.pairs import Pairs
from fenics_contact.contact.results import PointResults
from fenics_contact.contact.values import PointValues
from fenics_contact.laws.base import Law
from fenics_contact.obstacles.base import Obstacle, SampledObstacle
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.surface.displacement import Displacement, check_kind
from fenics_contact.surface.facet_places import FacetPlaces
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.surface import ContactSurface, tagged_facets
from fenics_contact.types import Array, Mask

__all__ = ["Committed", "Contact", "Found"]


@dataclass(frozen=True)
class Found:
    """A solved state of a contact, which a commit makes its history.

    Attributes:
        points: All fields at this rank's points.
        history: Those of them that become history, as it has them.
        counted: `PointFields.rows` that its slip is counted from; None: what was committed.
    """

    points: PointValues
    history: Mapping[str, Array]
    counted: Array | None


@dataclass(frozen=True)
class Committed:
    """A committed state of a contact.

    Attributes:
        history: `PointFields.rows`.
        opposite: What was committed of what lies opposite.
        commits: `Contact.commits`.
        points: All fields at this rank's points; None: nothing was committed.
    """

    history: Array
    opposite: OppositeState
    commits: int
    points: PointValues | None


class Contact(PointResults):
    """Frictional contact of Γc with an obstacle, as a boundary form and a committed history.

    Attributes:
        u: The displacement, a vector-valued Lagrange function; of a mixed function one of its own,
            which has the values of the last evaluation.
        displacement: What it is in the function that is solved for.
        surface, obstacle, law: What was given.
        quadrature: The points of Γc.
        history: The committed state.
        multipliers: λ_n and λ_t of augmented enforcement, None under penalty.
        accuracy: What was chosen for the accuracy wanted, None if none was said.
        tolerance: What `enforcement_error` must come below, with multipliers.
        parameters: Every parameter of law and obstacle given by a number, as a ``fem.Constant``
            by name ("friction", "k_n", "displacement" …): set ``.value`` to change it. Of a
            `RelativeStiffness` stiffness that is the multiple of E/h.
        entity_maps: For compiling `form` in a problem of one's own.
        name: In messages and files.
        free_motion: Components of the obstacle's displacement that follow from the force on it, as
            scalar constants by number of the component: their values are results (length).
        applied_force: The forces on it, likewise (force).
        free_angle: Angle of an obstacle that is turned by a moment, a scalar constant whose value
            is a result (radians); None: there is none.
        applied_moment: The moment, likewise (force times length).
        inputs: All that was given, as UFL.
        gap_prescribed: Whether the gap was given apart from the geometry.
        finite: Whether gap, normal and slip are those of displacements of any size.
        opposite: What lies opposite the points, and what they feel of it.
        acting: The law at the points.
        commits: Number of commits.
    """

    def __init__(
        self,
        u: fem.Function | ufl.core.expr.Expr,
        surface: ContactSurface,
        obstacle: Obstacle,
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
            obstacle: What it presses on.
            law: The reactions.
            gap: Initial gap s (length) prescribed independently of the obstacle's geometry (paper,
                footnote 1): a number, constant or UFL. The obstacle's motion is added to it, and
                belongs into ``displacement`` of the obstacle: a constant in the gap that is changed
                opens and closes it, as an interference that grows does, and no more. Friction feels
                nothing of what moves along Γc with it, and does no work on it. 0 is for bodies that
                touch all over at first, whose facets alone leave gaps.
            weight: Factor of the surface measure where the bulk form carries one: a thickness, or
                2πr for axisymmetric problems.
            modulus: Young's modulus near Γc (stress), a number or function with one value per
                cell, for `RelativeStiffness`. By default it is measured from the bulk
                form, by `ContactProblem`.
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
                size, on a rigid obstacle whose place is known everywhere or on a `DeformableBody`;
                the bulk form should bear them, too. Tractions and stiffness are per undeformed
                area.
            name: In messages and files.

        Raises:
            ValueError: ``u`` is no displacement of this mesh, or data of obstacle or law are wrong.
            TypeError: A parameter is of a type that cannot be a coefficient.
        """
        check_instance("name", name, str)
        order = "the order is Contact(u, surface, obstacle, law)"
        check_kind(u, name, order)
        for what, value, kind in (
            ("surface", surface, ContactSurface),
            ("obstacle", obstacle, Obstacle),
            ("law", law, Law),
        ):
            check_instance(f"{name}: {what}", value, kind, order)
        self.name = name
        self.surface, self.obstacle, self.law = surface, obstacle, law
        self.entity_maps = surface.entity_maps
        gdim = surface.mesh.geometry.dim
        self.displacement = Displacement(u, surface.mesh, name)
        self.u, degree = self.displacement.u, self.displacement.degree
        try:
            obstacle.check_complete()
            law.check_complete()
            law.check_dimension(gdim)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        self.accuracy = None if accuracy is None else Accuracy.of(accuracy)
        self.finite = is_finite(name, kinematics, obstacle, law, gap)
        augments, self.tolerance = enforcement_of(name, enforcement, tolerance, law, self.accuracy)
        # Linear elements hold a curved gap at their nodes alone (docs/enforcement.md). But between
        # two meshes, and on quadrilaterals of any shape, nodes carry no uniform pressure over.
        nodal = augments and degree == 1 and not isinstance(obstacle, DeformableBody)
        nodal = nodal and surface.submesh.topology.cell_name() != "quadrilateral"
        # Nor where the area of a vertex is not that of its share of a uniform pressure.
        nodal = nodal and not varies(weight)
        opposite = None
        if isinstance(obstacle, DeformableBody):
            opposite = tagged_facets(surface.mesh, obstacle.facet_tags, obstacle.tags)
        self.quadrature = surface.quadrature(
            degree,
            nodal=nodal,
            opposite=opposite,
            pieces=not self.finite,
            radius=obstacle.smallest_radius,
        )
        moving = self.finite and not isinstance(obstacle, DeformableBody)
        self.multipliers: Multipliers | None = None
        if augments:
            self.multipliers = Multipliers(self.quadrature, degree, law, turning=moving)
        self.inputs = Inputs(
            name,
            self.quadrature,
            law,
            obstacle,
            weight=weight,
            accuracy=self.accuracy,
            opposite=opposite,
        )
        if modulus is not None:
            self.set_modulus(modulus)
        self.gap_prescribed = gap is not None

        fields = {"opening": 0, "penetration": 0, "normal_traction": 0}
        if law.has_friction:
            fields |= {"traction": gdim, "jump": gdim, "slip": law.n_modes(gdim)}
            fields |= {"normal": gdim} if moving else {}
        if self.multipliers is not None:
            fields |= {"multiplier": 0}
        self.history = PointFields(self.quadrature, fields)
        self.commits = 0

        # All of contact is a sparse map from u to the jump at the points, and the law there: as
        # expressions for the form on Γc, and sampled at the points for all else.
        parts = Parts(
            name=name,
            displacement=self.displacement,
            quadrature=self.quadrature,
            obstacle=obstacle,
            law=law,
            inputs=self.inputs,
            gap=gap,
            history=self.history,
            multipliers=None if self.multipliers is None else self.multipliers.fields,
        )
        self.opposite = opposite_of(parts, finite=self.finite)
        self.acting = ActingLaw(law, self.opposite, self.quadrature)
        self._values: PointValues | None = None
        self._committed_values: PointValues | None = None
        self._aloft: Array | None = None  # history rows as committed, where slip is counted anew
        if not self.rigid:
            self.pair()
        self.opposite.begins_anew()
        self._count_anew()

    # ---- forms -----------------------------------------------------------------------------------

    def form(self, v: ufl.Argument) -> ufl.Form:
        """Virtual work of contact, to be **added** to a residual: -∫ (r_n v_n + τ·v_t) (46, 55).

        Args:
            v: Test function of ``u``'s space, of a mixed function the part of the test function
                that ``ufl.split`` gives. Compile with ``entity_maps=contact.entity_maps``.
                With a `SampledObstacle` call `evaluate` before assembling, wherever ``u`` or the
                obstacle has moved: the form has the expansion about where it was sampled last.

        Raises:
            ValueError: A stiffness is `RelativeStiffness` and the modulus is not known; or the
                obstacle is another body, or moves by an amount that is unknown.
        """
        self._check_form()
        return self.form_at(self.displacement.expression, v)

    def form_at(self, displacement: Any, v: ufl.Argument) -> ufl.Form:
        """`form` at a displacement relative to what lies opposite (UFL)."""
        traction = self.acting.in_form.traction(displacement)
        return -self.inputs.weight * ufl.dot(traction, v) * self.quadrature.ds

    def _check_form(self) -> None:
        """Refuse what no form on Γc can hold."""
        if self.motions:
            raise ValueError(
                f"{self.name}: the form on Γc cannot hold the unknown motion of the obstacle; use "
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

    def potential(self) -> ufl.Form:
        """Energy whose derivative by ``u`` is `form` (eq. 19, 43).

        Raises:
            ValueError: The law has none (Coulomb; a foundation with k_t and without tension; any
                friction in a frame that turns), or as for `form`.
        """
        self._check_form()
        if self.law.has_potential and not self.acting.has_potential:
            raise ValueError(
                f"{self.name}: friction has no potential with finite kinematics, whose tangent "
                "planes turn; use the form"
            )
        return (
            self.inputs.weight
            * self.acting.in_form.potential(self.displacement.expression)
            * self.quadrature.ds
        )

    def tangent(self, v: ufl.Argument, du: ufl.Argument) -> ufl.Form:
        """Consistent tangent, the derivative of `form`; unsymmetric where Coulomb slips."""
        return ufl.derivative(self.form(v), self.displacement.whole, du)

    # ---- the same, point by point: see `ContactOperator` -----------------------------------------

    @property
    def area(self) -> Array:
        """Area that each point stands for, the weight as it was sampled last, (n_points,)."""
        return self.quadrature.weights * self.opposite.data.values["weight"]

    def energy(self) -> float:
        """`potential` at the present ``u``, this rank's points only. Collective.

        Raises:
            ValueError: The law has none.
        """
        potential = self.acting.potential()
        return float(self.area @ potential)

    def confine(self, points: Mask | None = None) -> None:
        """Let the law act at some of the points alone. Collective.

        At the others nothing acts, whatever they do: they are open.

        Args:
            points: Mask of them, (n_points,); None: all, as at first.
        """
        self.acting.confine(points)
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
        """Unknown components of the obstacle's displacement; see the class."""
        return self.inputs.free_motion

    @property
    def applied_force(self) -> dict[int, Any]:
        """The forces on them; see the class."""
        return self.inputs.applied_force

    @property
    def free_angle(self) -> fem.Constant | None:
        """Unknown angle of the obstacle; see the class."""
        return self.inputs.free_angle

    @property
    def applied_moment(self) -> fem.Constant | None:
        """The moment that turns it; see the class."""
        return self.inputs.applied_moment

    @property
    def motions(self) -> list[FreeMotion]:
        """All unknowns of the obstacle, displacements before the angle."""
        return self.inputs.motions

    @property
    def needs_modulus(self) -> bool:
        """Whether a stiffness is `RelativeStiffness` and still waits for `set_modulus`."""
        return self.inputs.needs_modulus

    def set_modulus(self, modulus: Any) -> None:
        """Set E for `RelativeStiffness`: a number or a function, one value a cell. Collective."""
        self.inputs.set_modulus(modulus)

    @property
    def regularised(self) -> bool:
        """Whether the stiffness stands for none at all, and is not that of physical springs."""
        return is_regularised(self.law)

    def check_input(self) -> None:
        """Refuse parameters that are out of range or not finite at some point of Γc. Collective.

        Raises:
            ValueError: On all ranks.
        """
        self.surface.check_places(self.name)
        self.inputs.update()
        self.opposite.update()
        self.forget()
        self.inputs.check(self.opposite.data.values)

    def given(self) -> dict[str, Array]:
        """The data of law, obstacle and contact at this rank's points, by name. Collective.

        What was evaluated before stays.
        """
        self.inputs.update()
        self.opposite.update_data()
        data = self.opposite.data.values
        names = ["weight", "normal", "shift", "turn", "about", "axis"]
        # Else it is that of the latest pairs.
        if self.gap_prescribed or not self.opposite.may_pair_anew:
            names.append("initial_gap")
        return {n: v for n, v in data.items() if n in names or n.startswith("parameter ")}

    def reads(self, constant: fem.Constant) -> bool:
        """Whether law, obstacle, gap or weight were given with it.

        True where that cannot be seen: shapes in numbers, and laws from elsewhere, may hold it.
        """
        own = type(self.law).__module__.split(".")[0] == __name__.split(".")[0]
        seen = own and not isinstance(self.obstacle, SampledObstacle)
        loads = [motion.load() for motion in self.motions]
        return not seen or self.opposite.data.reads(constant) or any(f is constant for f in loads)

    # ---- pairs -----------------------------------------------------------------------------------

    @property
    def rigid(self) -> bool:
        """Whether the obstacle is rigid: its reactions are then external to the mesh."""
        return self.opposite.is_rigid

    @property
    def pairs(self) -> Pairs:
        """What lies opposite the points."""
        return self.opposite.pairs

    @property
    def couples(self) -> bool:
        """Whether contact ties unknowns together that the bulk does not."""
        return not self.rigid or bool(self.motions)

    @property
    def paired(self) -> Mask:
        """Which of this rank's points have an opposite, (n_points,); all on a rigid obstacle.

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
        self.opposite.update()
        none = np.zeros(self.quadrature.n_points)
        self.opposite.find_pairs(u, none if u is None else self._evaluate().depth)
        self.forget()

    def own_displacement(self) -> Array:
        """Of the body that has Γc, at the points, (n_points, gdim) (length). Collective."""
        return self.pairs.own_displacement()

    def places(self) -> Array:
        """Where tractions act, (n_points, gdim) (length): X, or X + u with finite kinematics.

        Collective.
        """
        x = self.values.x
        return x + self.own_displacement() if self.finite else x

    def true_placement(self) -> tuple[Array, Array]:
        """Gap and normal where the body has moved to: at X + u instead of X. Collective.

        See `Opposite.true_placement`: (n_points,) (length) and (n_points, gdim).
        """
        return self.opposite.true_placement(self.values)

    @cached_property
    def traces(self) -> TraceProjection:
        """The projection on functions on Γc that displacements can answer to. Collective."""
        return TraceProjection(self.quadrature, self.displacement.degree)

    @cached_property
    def facet_places(self) -> FacetPlaces:
        """Places between the points, on the facets of Γc. Collective."""
        return FacetPlaces(self.quadrature, self.u.function_space, self.points)

    # ---- state -----------------------------------------------------------------------------------

    def evaluate(self) -> None:
        """Evaluate gap, reactions and slip at the present ``u``; the history stays. Collective."""
        self.opposite.update()
        self._values = self._evaluate()

    def _evaluate(self) -> PointValues:
        """Everything at the points, as they were updated last. Collective."""
        arrays = {**self.opposite.data.values, **self.acting.own.evaluate()}
        return PointValues.of(arrays | self.opposite.told(arrays))

    def evaluate_yield(self) -> tuple[Array, Array]:
        """The law's yield functions at the present ``u``, and their gradients. Collective.

        Returns:
            g_j(τ, limit) (stress), (n_points, n_modes), and ∂g_j/∂τ, (n_points, n_modes, gdim).
        """
        self.opposite.update()
        return self.acting.own.evaluate_yield()

    def forget(self) -> None:
        """Drop what was evaluated: the next look at a result evaluates the present ``u``."""
        self._values = None

    def restore(self, found: Found | None = None) -> None:
        """Multipliers as at the last commit, and results; before one none are. Collective.

        At that state the law would call points that have slipped to it sticking ones.

        Args:
            found: A state solved since, whose results these are to be.
        """
        counted = self._aloft if found is None or found.counted is None else found.counted
        if counted is not None:
            self.history.set_rows(counted)
        if found is None or found.counted is None:
            self._aloft = None
        if self.multipliers is not None:
            self.multipliers.restore(self.history)
        self._values = self._committed_values if found is None else found.points

    def enforcement_error(self) -> float:
        """What the springs bear at the last evaluated state, relative: 0 if exact. Collective.

        The largest |Π p - λ_n| and |Π τ - λ_t| over the points, by the largest pressure or
        traction of the same connected part of Γc, and of all parts the largest: what another round
        would change. k_n times the penetration is that, and k_t times the elastic slip, as far as
        displacements of Γc can undo them. Infinite where nothing is borne any more and multipliers
        are left. Where multipliers grow from round to round, and springs bear what they did, it is
        relative to the tractions of the first round.

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
        counted = None if self._aloft is None else self.history.rows()
        return Found(points, self.opposite.committed_fields(values), counted)

    def set_down(self, moved: Mask, released: Mask) -> None:
        """Let slip be counted from the state evaluated last, where points bore nothing before.

        `restore` takes it back. Collective.

        Args:
            moved: Which points moved as bodies were set down, (n_points,).
            released: Of these, the points of bodies that bore no force by then, (n_points,): the
                tractions committed there are round-off.
        """
        bore = self.history.values("normal_traction") != 0.0
        self._count_from_here(released | (moved & ~bore))

    def count_slip_from_here(self) -> None:
        """Let slip be counted from the state evaluated last, at which surfaces first touch.

        `restore` takes it back. Collective.
        """
        self._count_from_here(np.ones(self.quadrature.n_points, dtype=np.bool_))

    def _count_from_here(self, points: Mask) -> None:
        """Let slip at some points be counted from the state evaluated last. Collective."""
        if not self.law.has_friction:
            return
        if self._aloft is None:
            self._aloft = self.history.rows()
        kept = {name: self.history.values(name) for name in self.history.names}
        feet = self.opposite.feet(self.values)
        counted = {n: np.where(points[:, None], v, kept[n]) for n, v in feet.items()}
        self.history.commit(kept | counted)
        self.forget()

    def begin(self) -> None:
        """Let slip be counted from the present ``u``, if nothing has been committed. Collective.

        The obstacle is where it was given, not displaced. `ContactProblem` calls it before its
        first increment; the constructor has done so for the ``u`` of then.
        """
        if not self.commits and self.opposite.begins_anew():
            self._count_anew()

    def _count_anew(self) -> None:
        """Let the history have the displacements that ways are counted from. Collective."""
        if self.law.has_friction:
            start = {name: self.history.values(name) for name in self.history.names}
            self.history.commit(start | self.opposite.start())
        self.restore()

    def commit(self, found: Found | None = None) -> None:
        """Make a state the history of the next increment. Collective.

        Args:
            found: What `found` gave; by default the state at the present ``u``.
        """
        if found is None:
            self.evaluate()
            found = self.found()
        values = dict(found.history)
        self._aloft = None
        self.commits += 1
        self.history.commit(values)
        self._values = found.points  # results stay those of the solution, whatever its pairs
        moved = self.opposite.commit(found.points)
        if moved is not None and self.law.has_friction:
            self.history.commit(values | {"jump": values["jump"] + moved})
        self._committed_values = found.points
        if self.multipliers is not None:
            self.multipliers.restore(self.history)

    def committed(self) -> Committed:
        """The committed state, for `set_committed`."""
        rows, state = self.history.rows(), self.opposite.state()
        rows = rows if self._aloft is None else self._aloft.copy()
        return Committed(rows, state, self.commits, self._committed_values)

    def set_committed(self, state: Committed) -> None:
        """Make a state the committed one again; `restore` drops what came after it. Collective."""
        self.history.set_rows(state.history)
        self._aloft = None
        self.opposite.set_state(state.opposite)
        self.commits, self._committed_values = state.commits, state.points

    def take_up(self, history: Array, values: Mapping[str, Array], *, anew: bool) -> None:
        """Make a state of another run the committed one, at the u that it has. Collective.

        Args:
            history: `PointFields.rows` of that run, with ``u`` and loads as they were in it.
            values: The arrays of its `values`, for the results to be those of its solution.
            anew: Whether pairs were found anew at its commits.
        """
        self.history.set_rows(history)
        self._aloft = None
        self._committed_values = None

        def present() -> PointValues:
            self.restore()
            return self.values

        unknown = np.zeros(self.quadrature.n_points)
        self.opposite.resume(values.get("depth", unknown), present, anew=anew)
        self.commits += 1
        mine = self.values.arrays
        if {n: v.shape for n, v in values.items()} == {n: v.shape for n, v in mine.items()}:
            self._values = PointValues.of(values)
        self._committed_values = self._values

    @property
    def values(self) -> PointValues:
        """All fields of the last evaluation at this rank's points."""
        if self._values is None:
            self.evaluate()
            assert self._values is not None
        return self._values
