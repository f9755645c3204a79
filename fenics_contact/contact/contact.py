"""Contact: a displacement, a surface, an obstacle and a law; boundary form, state and results."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.arguments import check_instance
from fenics_contact.contact.accuracy import Accuracy
from fenics_contact.contact.choices import select_enforcement, select_kinematics
from fenics_contact.contact.contact_kinematics import ContactKinematics, ContactParts
from fenics_contact.contact.effective_law import EffectiveLaw
from fenics_contact.contact.inputs import Inputs, is_varying
from fenics_contact.contact.multipliers import Multipliers, TraceProjection
from fenics_contact.contact.results import PointResults
from fenics_contact.contact.states import ContactStates
from fenics_contact.contact.values import PointValues
from fenics_contact.laws.base import Law
from fenics_contact.obstacles.base import Obstacle
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.surface.displacement import Displacement, check_kind
from fenics_contact.surface.facet_sampling import FacetSampling
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.surface import ContactSurface, tagged_facets
from fenics_contact.types import Array, Mask

__all__ = ["Contact"]


class Contact(PointResults):
    """Contact of the surface Γc with a rigid obstacle or an opposing body.

    A block on a rigid floor, with Γc the facets tagged 1::

        surface = fc.ContactSurface(msh, tags, 1)
        floor = fc.HalfSpace(point=(0, 0), normal=(0, 1))
        contact = fc.Contact(u, surface, floor, fc.Coulomb(friction=0.3))

    A Contact adds the virtual work -∫ (r_n v_n + τ·v_t) on Γc to the residual, eq. (9); it has the
    history variables at the quadrature points of Γc, and the results. The constructor is
    collective, and compiles the expressions that are evaluated at the points.

    Args:
        u: Displacement, a vector-valued Lagrange function of any degree on the surface's mesh. If
            it is a part of a mixed function w, with a pressure for instance, pass the part that
            ``u, p = ufl.split(w)`` gives. Bubble functions, which vanish on Γc, may be added to it.
        surface: The potential contact surface Γc.
        obstacle: The rigid obstacle or the opposing `DeformableBody`.
        law: The contact law.
        gap: Initial gap s (length) that replaces that of the geometry: a number, constant or UFL
            expression; with small displacements only. Use 0 for conforming surfaces that coincide
            initially, whose facets leave gaps between them. The displacement of the obstacle is
            taken into account in addition. A change of ``gap`` itself, such as a growing
            interference, opens and closes the contact, but causes no slip and no work of friction.
        weight: Factor of the surface measure, as in the bulk form: a thickness, or 2πr for
            axisymmetric problems; 1 by default.
        modulus: Young's modulus near Γc (stress), a number or a function with one value per cell,
            for `RelativeStiffness`. By default `ContactProblem` evaluates it from the bulk form.
        accuracy: "draft", "standard", "fine", or the relative error wanted in contact force and
            pressure. It sets the defaults of enforcement, its tolerance, stiffness, the solver's
            tolerance and the number of increments. `Accuracy` has the values.
        enforcement: "penalty" (default): the body penetrates by p/k_n, and sticking points are
            displaced by τ/k_t. "augmented": augmented Lagrangian method, eq. (8), in which k_n
            and k_t determine only the rate of convergence.
        tolerance: Tolerance of the augmented Lagrangian method, between 0 and 1, 1e-5 by default:
            the largest `enforcement_error` accepted, that is, the penalty part of the traction
            relative to the largest traction.
        kinematics: "small" (default): gap and normals are those of the undeformed body, eq. (1);
            the error of this assumption is estimated after every increment. "finite":
            displacements, rotations and slip of any size, eq. (2) and (3), on a rigid obstacle
            whose geometry is known everywhere or on a `DeformableBody`; the bulk form must then be
            valid for them, too. Tractions and stiffness are per undeformed area.
        name: Name in messages and files.

    Attributes:
        u: The displacement; for a part of a mixed function, a copy with the values of the last
            evaluation.
        displacement: The relation of u to the function that is solved for.
        surface, obstacle, law: The arguments.
        quadrature: The quadrature points of Γc.
        history: History variables from which an increment starts: a working copy of the committed
            values, in which it may change the slip reference.
        multipliers: λ_n and λ_t of the augmented Lagrangian method; None with a penalty.
        accuracy: The `Accuracy` chosen; None if the argument was not given.
        tolerance: Largest `enforcement_error` accepted, with multipliers.
        entity_maps: Entity maps with which to compile `form`.
        name: Name in messages and files.
        inputs: Data of law, obstacle and contact, as UFL.
        parameters: The parameters of law and obstacle that were given by numbers, as
            ``fem.Constant``, by name ("friction", "k_n", "displacement" …); set ``.value`` to
            change one. The value of a `RelativeStiffness` is the multiple of E/h.
        free_motion: Unknown components of the obstacle's displacement, by number of the component.
            The values of these scalar constants are results (length).
        applied_force: Given forces on the obstacle (force), by number of the component.
        free_angle: Unknown rotation angle of the obstacle, a result (radians); None if it is not
            free.
        applied_moment: Given moment on the obstacle (force times length); None if its angle is not
            free.
        motions: All unknown motions of the obstacle: displacements, then the angle.
        gap_prescribed: Whether the initial gap was given by ``gap``.
        kinematics: The argument.
        contact_kinematics: Gap, normal and jump at the points, and their committed state.
        pairs: The pairs of points of Γc and opposite points.
        effective_law: The law evaluated at the points.
        states: The committed state, and the results evaluated last.

    Raises:
        ValueError: ``u`` is not a displacement on this mesh; data of obstacle or law are invalid.
        TypeError: A parameter is of a type that cannot be a coefficient.
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
        check_instance("name", name, str)
        order = "the arguments are Contact(u, surface, obstacle, law)"
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
        kinematics_type = select_kinematics(name, kinematics, obstacle, law, gap)
        self.kinematics, is_finite = kinematics, kinematics_type.is_finite
        augmented, self.tolerance = select_enforcement(
            name, enforcement, tolerance, law, self.accuracy
        )
        # Linear elements can satisfy a curved gap at their nodes only (docs/enforcement.md), but
        # nodes do not transfer a uniform pressure between two meshes, on quadrilaterals of any
        # shape, or with a weight that varies.
        nodal = augmented and degree == 1 and not isinstance(obstacle, DeformableBody)
        nodal = nodal and surface.submesh.topology.cell_name() != "quadrilateral"
        nodal = nodal and not is_varying(weight)
        opposite = None
        if isinstance(obstacle, DeformableBody):
            opposite = tagged_facets(surface.mesh, obstacle.facet_tags, obstacle.tags)
        self.quadrature = surface.quadrature(
            degree,
            nodal=nodal,
            opposite=opposite,
            pieces=not is_finite,
            radius=obstacle.smallest_radius,
        )
        has_frame = is_finite and not isinstance(obstacle, DeformableBody)
        self.multipliers: Multipliers | None = None
        if augmented:
            self.multipliers = Multipliers(self.quadrature, degree, law, turning=has_frame)
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
            self.inputs.set_modulus(modulus)
        inputs = self.inputs
        self.parameters, self.motions = inputs.constants, inputs.motions
        self.free_motion, self.applied_force = inputs.free_motion, inputs.applied_force
        self.free_angle, self.applied_moment = inputs.free_angle, inputs.applied_moment
        self.gap_prescribed = gap is not None

        fields = {"opening": 0, "penetration": 0, "normal_traction": 0}
        if law.has_friction:
            fields |= {"traction": gdim, "jump": gdim, "slip": law.n_modes(gdim)}
            fields |= {"normal": gdim} if has_frame else {}
        if self.multipliers is not None:
            fields |= {"multiplier": 0}
        self.history = PointFields(self.quadrature, fields)

        parts = ContactParts(
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
        self.contact_kinematics: ContactKinematics = kinematics_type(parts)
        self.pairs = self.contact_kinematics.pairs
        self.effective_law = EffectiveLaw(parts, self.contact_kinematics)
        if not self.contact_kinematics.is_rigid:
            self.contact_kinematics.update()
            self.contact_kinematics.find_pairs(None, np.zeros(self.quadrature.n_points))
        self.states = ContactStates(
            parts, self.multipliers, self.contact_kinematics, self.effective_law
        )

    # ---- forms -----------------------------------------------------------------------------------

    def form(self, v: ufl.Argument) -> ufl.Form:
        """Return the virtual work of contact, -∫ (r_n v_n + τ·v_t), to be **added** to a residual.

        Eq. (9). Compile the form with ``entity_maps=contact.entity_maps``. With a `SampledObstacle`
        call `evaluate` before assembling whenever ``u`` or the obstacle has moved: the form
        expands the distance about the positions sampled last.

        Args:
            v: Test function of ``u``'s space; with a mixed function, the part of its test function
                that ``ufl.split`` gives.

        Raises:
            ValueError: A stiffness is `RelativeStiffness` and the modulus is not known; or the
                obstacle is another body, or has unknown motions.
        """
        self._check_form()
        return self.form_at(self.displacement.expression, v)

    def form_at(self, displacement: Any, v: ufl.Argument) -> ufl.Form:
        """Return `form` at a jump (UFL)."""
        traction = self.effective_law.in_form.traction(displacement)
        return -self.inputs.weight * ufl.dot(traction, v) * self.quadrature.ds

    def _check_form(self) -> None:
        """Check that the contact has a boundary form, or raise a ValueError."""
        if self.motions:
            raise ValueError(
                f"{self.name}: the boundary form cannot contain the unknown motion of the obstacle;"
                " use ContactProblem, or prescribe the displacement"
            )
        if not self.contact_kinematics.is_rigid:
            raise ValueError(
                f"{self.name}: the boundary form cannot couple Γc to the dofs of the opposing body;"
                " use ContactProblem, or a ContactOperator"
            )
        if self.inputs.needs_modulus:
            raise ValueError(
                f"{self.name}: k_n or k_t is a multiple of E/h, and E is not known; give "
                "Contact(modulus=...) or k_n and k_t in stress/length, or use ContactProblem, "
                "which measures E from the bulk form"
            )

    def potential(self) -> ufl.Form:
        """Return the energy whose derivative with respect to ``u`` is `form`.

        Raises:
            ValueError: The law has no potential (Coulomb; a foundation with k_t and without
                tension; friction with finite kinematics), or the contact has no `form`.
        """
        self._check_form()
        if self.law.has_potential and not self.effective_law.has_potential:
            raise ValueError(
                f"{self.name}: friction has no potential with finite kinematics, because the "
                "tangent planes rotate; use Contact.form"
            )
        return (
            self.inputs.weight
            * self.effective_law.in_form.potential(self.displacement.expression)
            * self.quadrature.ds
        )

    def tangent(self, v: ufl.Argument, du: ufl.Argument) -> ufl.Form:
        """Return the consistent tangent, the derivative of `form`.

        It is unsymmetric where a point slips with Coulomb friction.
        """
        return ufl.derivative(self.form(v), self.displacement.whole, du)

    # ---- pointwise evaluation, for `ContactOperator` ---------------------------------------------

    @property
    def area(self) -> Array:
        """Quadrature weights times the contact's weight as evaluated last, (n_points,)."""
        return self.quadrature.weights * self.contact_kinematics.data.values["weight"]

    def energy(self) -> float:
        """Return the value of `potential` at the present ``u``, summed over this rank's points.

        Collective.

        Raises:
            ValueError: The law has no potential.
        """
        potential = self.effective_law.potential()
        return float(self.area @ potential)

    def restrict_to(self, points: Mask | None = None) -> None:
        """Restrict the law to some of the points; the others are open. Collective.

        Args:
            points: Mask of the points, (n_points,); None: all points.
        """
        self.effective_law.restrict_to(points)
        self.states.forget()

    # ---- data ------------------------------------------------------------------------------------

    def check_input(self) -> None:
        """Check that all parameters are finite and in range at every point of Γc. Collective.

        Raises:
            ValueError: A parameter is not; raised on all ranks.
        """
        self.surface.check_places(self.name)
        self.inputs.update()
        self.contact_kinematics.update()
        self.states.forget()
        self.inputs.check(
            self.contact_kinematics.data.values, undeformed=not self.contact_kinematics.is_finite
        )

    # ---- pairs -----------------------------------------------------------------------------------

    def places(self) -> Array:
        """Return the points where tractions act: X, or X + u with finite kinematics. Collective.

        Returns:
            Array (n_points, gdim) (length).
        """
        x = self.values.x
        return x + self.pairs.own_displacement() if self.contact_kinematics.is_finite else x

    def true_placement(self) -> tuple[Array, Array]:
        """Return the gap and the normal at the deformed position X + u. Collective.

        Returns:
            Arrays (n_points,) (length) and (n_points, gdim).
        """
        return self.contact_kinematics.true_placement(self.values)

    @cached_property
    def traces(self) -> TraceProjection:
        """The L² projection onto the multiplier space on Γc. Collective."""
        if self.multipliers is not None:
            return self.multipliers.project
        return TraceProjection(self.quadrature, self.displacement.degree)

    @cached_property
    def facet_sampling(self) -> FacetSampling:
        """Additional points on the facets of Γc, between the quadrature points. Collective."""
        return FacetSampling(self.quadrature, self.u.function_space, self.points)

    # ---- state -----------------------------------------------------------------------------------

    @property
    def values(self) -> PointValues:
        """All fields of the last evaluation at this rank's points."""
        return self.states.values

    def evaluate(self) -> None:
        """Evaluate gap, tractions and slip at the present ``u``. Collective.

        The history is not changed.
        """
        self.states.evaluate()

    def commit(self) -> None:
        """Make the state at the present ``u`` the history of the next increment. Collective."""
        self.states.commit()

    def enforcement_error(self) -> float:
        """Return the traction that is left to the penalty, relative to the largest. Collective.

        It is the maximum of |Π p - λ_n| and |Π τ - λ_t| over the points, divided by the largest
        pressure or traction of the same connected part of Γc, at the last evaluated state; Π is the
        L² projection onto the multiplier space. It is the change of the multipliers in another
        augmentation, and zero if the contact conditions hold exactly. It is infinite if tractions
        vanish and multipliers do not. If multipliers grow from augmentation to augmentation and the
        penalty part does not decrease, it is relative to the tractions of the first augmentation.

        Raises:
            ValueError: The enforcement is not "augmented".
        """
        size = self.pairs.displacement_size(self.values.jump)
        return self._augmented().error(self.values, self.history, size)

    def augment(self) -> float:
        """Set the multipliers to the projected tractions at the present ``u``. Collective.

        This is one augmentation of the augmented Lagrangian method: solve with `form` and call
        `augment` until the returned error is small enough, then call `commit`. `ContactProblem`
        does so itself, and accelerates the augmentations of all its contacts.

        Returns:
            The `enforcement_error` before the update.

        Raises:
            ValueError: The enforcement is not "augmented".
        """
        multipliers = self._augmented()
        self.evaluate()
        error = self.enforcement_error()
        multipliers.assign(multipliers.augmented(self.values)[1], self.values)
        self.states.forget()
        return error

    def _augmented(self) -> Multipliers:
        """Return the multipliers, or raise a ValueError with a penalty."""
        if self.multipliers is None:
            raise ValueError(
                f"{self.name}: there are no multipliers with a penalty; create the contact with "
                'enforcement="augmented"'
            )
        return self.multipliers
