"""User data of a contact as UFL: numbers become constants, whose values may be changed."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from ufl.corealg.traversal import traverse_unique_terminals

from fenics_contact.arguments import check_instance, check_positive, is_number
from fenics_contact.contact.accuracy import DEFAULT_FACTOR, Accuracy
from fenics_contact.contact.values import PointValues
from fenics_contact.laws.base import Law, Parameters
from fenics_contact.laws.stiffness import NodalSprings, RelativeStiffness
from fenics_contact.obstacles.base import Motion, Obstacle, Rotation, as_vector, nonzero_vector
from fenics_contact.parallel import global_max, global_min
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.modulus import modulus_over_height
from fenics_contact.surface.surface import SurfaceQuadrature, VertexAreas
from fenics_contact.tolerances import FLAT, ROUND_OFF
from fenics_contact.types import Array, Indices

__all__ = ["FreeMotion", "Inputs", "check_data", "is_varying"]

logger = logging.getLogger("fenics_contact")

# Names of the contact's own data, which parameters of a law must not have.
_RESERVED_NAMES = ("angle", "displacement", "gap", "moment", "obstacle", "weight")
# Initial penetration relative to the mesh size above which the normal points the wrong way.
_DEEP_PENETRATION_RATIO = 0.1


@dataclass(frozen=True)
class FreeMotion:
    """An unknown displacement or rotation of a rigid obstacle, scaled to a length and a force.

    Attributes:
        way: "along x", or "about its axis".
        constant: The unknown: a displacement (length) or an angle.
        load: Returns the given force or moment.
        length: Factor from an angle to the unknown, and divisor from the moment to its force: 1 for
            displacements, a power of two for angles, to avoid round-off.
        turns: Whether the unknown is an angle.
    """

    way: str
    constant: fem.Constant
    load: Callable[[], Any]
    length: float = 1.0
    turns: bool = False

    @property
    def kind(self) -> str:
        """The kind of motion, "rotation" or "translation"."""
        return "rotation" if self.turns else "translation"

    @property
    def value(self) -> float:
        """The unknown (length)."""
        return float(self.constant.value) * self.length

    def set_value(self, value: float) -> None:
        """Set the unknown (length)."""
        self.constant.value = value / self.length

    @property
    def force(self) -> float:
        """The given force (force)."""
        load = self.load()
        return float(load.value if isinstance(load, fem.Constant) else load) / self.length


class Inputs:
    """Weight, parameters of the law and motion of the obstacle, as UFL.

    The constructor is collective.

    Args:
        accuracy: Accuracy that determines the default stiffness.
        opposite: This rank's facets of the opposing body; None if the obstacle is rigid.

    Attributes:
        constants: Every parameter given by a number, by name; see `Contact.parameters`.
        stiffness_factor: Factor of k_n and k_t.
        weight: Factor of the surface measure, 1 by default.
        law: Parameters of the law, by name.
        shift: Displacement of the obstacle; None if it has none.
        rotation: Rotation matrix and a point of the axis; None if the obstacle does not rotate.
        angle: Rotation angle (radians); None without rotation.
        axis: Direction of the axis in space; None in the plane and without rotation.
        free_motion: Unknown components of the displacement, constants by number.
        free_shift: The same components as variables, to differentiate by.
        applied_force: The forces on these components.
        free_angle: The unknown rotation angle; None if it is not free.
        applied_moment: The moment about the axis of a free rotation.
        motions: All unknowns of the obstacle, displacements first.

    Raises:
        ValueError: A number is out of range, or a shape is wrong.
        TypeError: A parameter is neither a number nor UFL.
    """

    def __init__(
        self,
        name: str,
        quadrature: SurfaceQuadrature,
        law: Law,
        obstacle: Obstacle,
        *,
        weight: Any,
        accuracy: Accuracy | None,
        opposite: Indices | None,
    ) -> None:
        self._name, self._law, self._quadrature = name, law, quadrature
        self._surface, self._accuracy = quadrature.surface, accuracy
        self._gdim = self._surface.mesh.geometry.dim
        self._modulus_scale: fem.Function | None = None  # E/h of RelativeStiffness
        self._has_modulus = False
        self._opposite = opposite
        self._vertex_areas: VertexAreas | None = None  # if a stiffness is that of NodalSprings
        self.constants: dict[str, fem.Constant] = {}
        self.weight = self.scalar("weight", 1.0 if weight is None else weight)
        for key in [n for n in _RESERVED_NAMES if n in law.parameters()]:
            raise ValueError(
                f"{name}: {type(law).__name__} has a parameter {key!r}, which is a name of the "
                "contact's own data; rename it"
            )
        parameters = {n: self._make_parameter(n, v) for n, v in law.parameters().items()}
        self.law = Parameters(law, parameters)
        self.stiffness_factor = fem.Constant(self._surface.mesh, 1.0)
        for n in {"k_n", "k_t"} & set(self.law):
            self.law[n] = self.stiffness_factor * self.law[n]
        self.free_motion: dict[int, fem.Constant] = {}
        self.free_shift: dict[int, ufl.core.expr.Expr] = {}
        self.applied_force: dict[int, Any] = {}
        self.shift = self._make_shift(obstacle.displacement)
        self.angle: Any = None
        self.motions = [
            FreeMotion(f"along {'xyz'[i]}", constant, partial(self.applied_force.get, i))
            for i, constant in self.free_motion.items()
        ]
        self.axis: Any = None
        self.free_angle: fem.Constant | None = None
        self.applied_moment: fem.Constant | None = None
        self.rotation = self._make_rotation(obstacle.rotation)

    # ---- as UFL ----------------------------------------------------------------------------------

    @property
    def per_thickness(self) -> bool:
        """Whether integrals are per unit thickness: in the plane with a weight of 1."""
        weight = self.weight
        return self._gdim == 2 and isinstance(weight, fem.Constant) and float(weight.value) == 1.0

    def scalar(self, name: str, value: Any) -> ufl.core.expr.Expr:
        """Return a number, constant or UFL scalar as UFL."""
        expression = self.to_ufl(name, value)
        if expression.ufl_shape != ():
            raise ValueError(
                f"{self._name}: {name} has shape {expression.ufl_shape}; it must be a scalar"
            )
        return expression

    def to_ufl(self, name: str, value: Any) -> ufl.core.expr.Expr:
        """Return UFL; numbers become constants of the mesh, so that values are not compiled in."""
        if isinstance(value, ufl.core.expr.Expr):
            return value
        try:
            # Python's integers may be too large for NumPy's.
            array = np.asarray(float(value) if type(value) is int else value)
        except (ValueError, OverflowError):  # a ragged list, a number out of range
            array = np.asarray(None)
        if array.dtype.kind not in "iuf":
            is_sequence = isinstance(value, list | tuple)
            if is_sequence:  # the numbering of UFL objects differs between ranks
                is_ufl = (isinstance(v, ufl.core.expr.Expr) for v in value)
                value = [type(v).__name__ if s else v for v, s in zip(value, is_ufl, strict=True)]
            of_components = ", such as ufl.as_vector([displacement, 0.0])" if is_sequence else ""
            raise TypeError(
                f"{self._name}: {name} is {value!r}; it must be a number or numbers, a "
                f"fem.Constant, a fem.Function or a UFL expression{of_components}"
            )
        constant = fem.Constant(self._surface.mesh, array.astype(np.float64))
        if name != "obstacle":
            self.constants[name] = constant
        return constant

    def _make_parameter(self, name: str, value: Any) -> ufl.core.expr.Expr:
        if name == "direction":
            return self.to_ufl(
                name, nonzero_vector(f"{self._name}: direction of friction", value, self._gdim)
            )
        if isinstance(value, NodalSprings):
            if self._vertex_areas is None:
                self._vertex_areas = VertexAreas(self._quadrature, self.weight, self._name)
            return self.to_ufl(name, value.k) / self._vertex_areas.area
        if isinstance(value, RelativeStiffness):
            if self._modulus_scale is None:
                space = fem.functionspace(self._surface.submesh, ("Lagrange", 1))
                self._modulus_scale = fem.Function(space)
                self._modulus_scale.x.array[:] = 1.0
            factor = self._accuracy.factor if self._accuracy else DEFAULT_FACTOR
            return self.to_ufl(name, value.factor or factor) * self._modulus_scale
        positive = name in self._law.positive
        if is_number(value):
            is_invalid = not np.isfinite(value) or value < 0 or (positive and value == 0)
            if is_invalid:
                raise ValueError(_range_message(self._name, name, float(value), positive))
        return self.scalar(name, value)

    def _make_shift(self, displacement: Any) -> Any:
        if isinstance(displacement, Motion):
            return self._make_free_shift(displacement)
        if displacement is None:
            return None
        shift = self.to_ufl("displacement", displacement)
        if shift.ufl_shape != (self._gdim,):
            raise ValueError(
                f"{self._name}: displacement of the obstacle has shape {shift.ufl_shape}; on this "
                f"mesh it must be ({self._gdim},)"
            )
        return shift

    def _make_rotation(self, rotation: Rotation | None) -> tuple[Any, Any] | None:
        if rotation is None:
            return None
        check_instance(f"{self._name}: rotation", rotation, Rotation)
        given = rotation.angle, rotation.moment
        if (given[0] is None) == (given[1] is None):
            raise ValueError(
                f"{self._name}: the Rotation has angle {given[0]!r} and moment {given[1]!r}; give "
                "one of them, and None for the other"
            )
        about = as_vector(f"{self._name}: about of the Rotation", rotation.about, self._gdim)
        axis = rotation.unit_axis(self._gdim)
        angle = self._make_free_angle(rotation, about) if given[0] is None else given[0]
        self.angle = self.to_ufl("angle", angle)
        matrix = rotation.matrix(self._gdim, self.angle)
        self.axis = self.to_ufl("obstacle", axis) if self._gdim == 3 else None
        return matrix, self.to_ufl("obstacle", about)

    def _make_free_angle(self, rotation: Rotation, about: Any) -> fem.Constant:
        """Return the unknown angle of an obstacle that a moment rotates. Collective."""
        moment = rotation.moment
        if not (is_number(moment) or (isinstance(moment, fem.Constant) and not moment.ufl_shape)):
            raise TypeError(
                f"{self._name}: moment of the Rotation is {moment!r}; it must be a number or a "
                "scalar fem.Constant"
            )
        if isinstance(about, ufl.core.expr.Expr):
            raise TypeError(
                f"{self._name}: about of the Rotation is {about!r}; with a given moment it must be "
                f"{self._gdim} numbers: move the axis by the displacement of the obstacle"
            )
        self.applied_moment = self.to_ufl("moment", moment)
        self.free_angle = fem.Constant(self._surface.mesh, 0.0)
        # Coordinates of nodes do not depend on the number of ranks.
        arms = self._surface.submesh.geometry.x[:, : self._gdim] - about
        reach = np.linalg.norm(rotation.rate(arms), axis=1)
        _, exponent = math.frexp(global_max(self._surface.mesh.comm, reach))
        length = 2.0 ** (exponent - 1)
        self.motions.append(
            FreeMotion(
                "about its axis", self.free_angle, lambda: self.applied_moment, length, turns=True
            )
        )
        return self.free_angle

    def _make_free_shift(self, motion: Motion) -> ufl.core.expr.Expr:
        """Return the displacement of an obstacle with unknown components."""
        forces, given = motion.components(self._gdim)
        shift: list[Any] = [None] * self._gdim
        for i, value in given.items():
            shift[i] = self.scalar(f"displacement {i}", value)
        for i, value in forces.items():
            if not (is_number(value) or (isinstance(value, fem.Constant) and not value.ufl_shape)):
                raise TypeError(
                    f"{self._name}: force {i} of the Motion is {value!r}; it must be a number or a "
                    "scalar fem.Constant"
                )
            self.applied_force[i] = value
            self.free_motion[i] = fem.Constant(self._surface.mesh, 0.0)
            shift[i] = self.free_shift[i] = ufl.variable(self.free_motion[i])
        return ufl.as_vector(shift)

    def prescribed_shift(self) -> Any:
        """Return the displacement of the obstacle without its free components."""
        if self.shift is None:
            return ufl.as_vector([0.0] * self._gdim)
        return ufl.replace(self.shift, {c: ufl.as_ufl(0.0) for c in self.free_motion.values()})

    # ---- stiffness -------------------------------------------------------------------------------

    @property
    def needs_modulus(self) -> bool:
        """Whether a stiffness is `RelativeStiffness` and `set_modulus` was not called."""
        return self._modulus_scale is not None and not self._has_modulus

    def set_modulus(self, modulus: Any) -> None:
        """Set Young's modulus E of `RelativeStiffness`. Collective.

        Args:
            modulus: A number, or a function with one value per cell (stress).
        """
        if self._modulus_scale is None:
            return
        if not isinstance(modulus, fem.Function):
            what = "a positive number, or a fem.Function with one value per cell"
            check_positive(f"{self._name}: modulus", modulus, what)
            value = float(modulus)
            modulus = fem.Function(fem.functionspace(self._surface.mesh, ("DG", 0)))
            modulus.x.array[:] = value
        scale = modulus_over_height(self._surface, modulus, self._opposite)
        self._modulus_scale.x.array[:] = scale.x.array
        self._has_modulus = True

    def update(self) -> None:
        """Update vertex areas, whose weight may have changed. Collective."""
        if self._vertex_areas is not None:
            self._vertex_areas.update()

    # ---- checks ----------------------------------------------------------------------------------

    def check(self, data: Mapping[str, Array], *, undeformed: bool) -> None:
        """Check that all data are finite and in range at every point of Γc. Collective.

        Args:
            data: Samples at the points, by name; see `PointValues`.
            undeformed: Whether gap and normal of the undeformed Γc are used.

        Raises:
            ValueError: Data are invalid; raised on all ranks.
        """
        comm = self._surface.mesh.comm
        prefix = "parameter "
        parameters = {n.removeprefix(prefix): v for n, v in data.items() if n.startswith(prefix)}
        shortest = global_min(comm, data["direction_length"], empty=1.0)
        if undeformed and not shortest > 0.0:
            raise ValueError(
                f"{self._name}: the normal of the obstacle has length {shortest:g} at a point of "
                "Γc; it must not vanish anywhere, and point from the body to the obstacle"
            )
        # Only user data: fields that depend on u are checked with u.
        weight = data["weight"]
        given = {"weight": weight, "displacement of the obstacle": data["shift"]}
        given |= {name: data[name] for name in ("angle", "about") if name in data}
        if undeformed:
            given |= {"gap": data["initial_gap"], "normal": data["normal"]}
        for name, array in {**given, **parameters}.items():
            low, high = global_min(comm, array), global_max(comm, array)
            if not (np.isfinite(low) and np.isfinite(high)):
                raise ValueError(
                    f"{self._name}: {name} is not finite at a point of Γc (values from {low:g} "
                    f"to {high:g}); check its expression or function"
                )
            if name in given or name == "direction":
                continue
            positive = name in self._law.positive
            if low < 0 or (low == 0 and positive):
                raise ValueError(_range_message(self._name, name, low, positive))
        least = global_min(comm, weight)
        if least < 0:
            raise ValueError(
                f"{self._name}: weight is {least:g} at a point of Γc; it must not be negative"
            )
        if global_max(comm, weight) == 0.0:
            raise ValueError(
                f"{self._name}: weight is zero at every point of Γc, so that there is no contact "
                "force; it must be the thickness, or 2πr"
            )
        if self._quadrature.at_vertices and least <= ROUND_OFF * global_max(comm, weight):
            raise ValueError(
                f"{self._name}: weight is {least:g} at a vertex of Γc, as 2πr is on the axis, so "
                'that with quadrature_scheme="vertex" it has no contact force; use the default '
                "rule, whose points are in the interior of the facets"
            )
        if "direction" in parameters:
            self._check_direction(parameters["direction"], data["normal"])

    def check_side(self, values: PointValues, *, gap_prescribed: bool) -> None:
        """Reject or warn of a normal that points into the body on all of Γc. Collective.

        A ValueError is raised if the body is also deep inside the obstacle.
        """
        comm = self._surface.mesh.comm
        if global_max(comm, values.facing) > -FLAT:  # NaN is reported elsewhere
            return
        x, depth = self._surface.mesh.geometry.x, -global_min(comm, values.initial_gap)
        text = (
            f"{self._name}: the normal from the body to the obstacle points into the body at every "
            "point of Γc: reverse it (that of a HalfSpace points out of it, to the body: up for a "
            "floor; a Ball or Cylinder around the body has inside=True; the points of a "
            "RigidProfile have the obstacle on their left)"
        )
        size = global_max(comm, x) - global_min(comm, x)
        if depth > _DEEP_PENETRATION_RATIO * size and not gap_prescribed:
            raise ValueError(f"{text}; the body is inside of the obstacle, by up to {depth:g}")
        if comm.rank == 0:
            logger.warning(text)

    def _check_direction(self, given: Array, normal: Array) -> None:
        length = np.linalg.norm(given, axis=1)
        tangent = np.linalg.norm(given - np.sum(given * normal, axis=1)[:, None] * normal, axis=1)
        fraction = tangent / np.where(length > 0, length, 1.0)
        least = global_min(self._surface.mesh.comm, fraction, empty=1.0)
        if not least > FLAT:
            raise ValueError(
                f"{self._name}: direction of friction is zero or parallel to the normal at a "
                f"point of Γc (tangential part: {least:.1g} of its length); it must have a "
                "tangential part everywhere: give another direction, or a UFL vector that varies "
                "along the surface"
            )


def is_varying(value: Any) -> bool:
    """Whether a number or UFL expression may vary in space."""
    if not isinstance(value, ufl.core.expr.Expr):
        return False
    spatial = (ufl.classes.Coefficient, ufl.classes.GeometricQuantity)
    return any(isinstance(item, spatial) for item in traverse_unique_terminals(value))


def check_data(
    name: str,
    given: Mapping[str, Any],
    quadrature: SurfaceQuadrature,
    displacement: Displacement,
) -> None:
    """Check that data have values at the points of Γc that are constant within an increment.

    The law is evaluated with these values, so that data cannot depend on the unknown. If they do,
    or have no values there, a ValueError is raised.
    """
    unknowns = displacement.whole.x.array, displacement.u.x.array
    for what, expression in given.items():
        for item in traverse_unique_terminals(ufl.as_ufl(expression)):
            if isinstance(item, ufl.Argument):
                raise ValueError(
                    f"{name}: {what} has a test or trial function; it must have a value at every "
                    "point of Γc"
                )
            if isinstance(item, fem.Constant | fem.Function) and item.dtype != np.float64:
                raise ValueError(
                    f"{name}: {what} has a {type(item).__name__} of type {item.dtype}; it must be "
                    "in double precision, np.float64"
                )
            if not isinstance(item, fem.Function):
                continue
            _check_space(f"{name}: {what}", item, quadrature)
            if any(np.shares_memory(item.x.array, array) for array in unknowns):
                raise ValueError(
                    f"{name}: {what} depends on the unknown {item.name!r}, but data are constant "
                    "within an increment: use another function, whose values you set between "
                    "increments, or a user-defined law, whose contact_traction is a function of "
                    "gap and slip"
                )


def _check_space(what: str, function: fem.Function, quadrature: SurfaceQuadrature) -> None:
    """Check that a function has values at the points."""
    surface = quadrature.surface
    mesh, element = function.function_space.mesh, function.function_space.ufl_element()
    on_surface = mesh is surface.submesh or mesh == surface.submesh
    if not (on_surface or mesh is surface.mesh or mesh == surface.mesh):
        raise ValueError(
            f"{what} has a function, {function.name!r}, on another mesh than Γc; use the mesh of u"
        )
    if not element.has_custom_quadrature:
        return
    expected = quadrature.space().ufl_element().custom_quadrature()[0]
    points = element.custom_quadrature()[0]
    if not (on_surface and points.shape == expected.shape and np.array_equal(points, expected)):
        raise ValueError(
            f"{what} has a function, {function.name!r}, on a quadrature element with other points "
            "than those of Γc; use a function of a Lagrange or DG space"
        )


def _range_message(contact: str, name: str, value: float, positive: bool) -> str:
    condition = "greater than zero" if positive else "zero or greater"
    condition += " (stress/length)" if name.startswith("k_") else ""
    return f"{contact}: {name} is {value:g} at a point of Γc; it must be finite and {condition}"
