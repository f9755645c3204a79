"""The results of a contact at the last evaluated state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property

import basix.ufl
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from fenics_contact.arguments import check_instance
from fenics_contact.contact.inputs import Inputs
from fenics_contact.contact.values import PointValues, Resultants, Status, ZoneExtent
from fenics_contact.laws.base import Law
from fenics_contact.obstacles.base import as_vector
from fenics_contact.parallel import collective_errors, gather_rows, global_max, global_sum
from fenics_contact.surface.displacement import Displacement
from fenics_contact.surface.facet_values import facet_values
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.surface import ContactSurface, PointEvaluator, SurfaceQuadrature
from fenics_contact.tolerances import sort_by_coordinates
from fenics_contact.types import Array

__all__ = ["PointResults"]

# Results that are functions on Γc.
_FUNCTIONS = ("pressure", "traction", "tangential_traction", "gap", "slip", "normal")


class PointResults(ABC):
    """The results of a contact at the quadrature points of Γc.

    After `ContactProblem.solve` and `Contact.evaluate` the results are available without
    communication. After `ContactStates.forget` or a change of state, the first access evaluates the
    present displacement, which is collective.

    Attributes:
        name: Name in messages and files.
        surface, law: Contact surface and contact law.
        displacement: The relation of u to the function that is solved for.
        quadrature: The quadrature points of Γc.
        history: History variables from which an increment starts.
        inputs: Data of law, obstacle and contact, as UFL.
    """

    name: str
    surface: ContactSurface
    displacement: Displacement
    law: Law
    quadrature: SurfaceQuadrature
    history: PointFields
    inputs: Inputs

    @property
    @abstractmethod
    def values(self) -> PointValues:
        """All fields of the last evaluation at this rank's points."""

    @property
    def points(self) -> Array:
        """Coordinates of this rank's quadrature points, shape (n_points, gdim), in length."""
        return self.values.x

    @property
    def gap(self) -> Array:
        """Normal gap g_N = s - u_n = δ₊ - δ₋, eq. (6), shape (n_points,), in length.

        It is NaN at points without an opposite point.
        """
        return np.where(self.values.paired > 0, self.values.gap, np.nan)

    @property
    def pressure(self) -> Array:
        """Contact pressure p = -r_n, shape (n_points,), in stress; negative only in tension."""
        return -self.values.normal_traction

    @property
    def tangential_traction(self) -> Array:
        """Tangential traction τ on the body, shape (n_points, gdim), in stress."""
        return self.values.traction

    @property
    def traction(self) -> Array:
        """Traction r_n n + τ on the body, shape (n_points, gdim), in stress."""
        return self.values.total_traction

    @property
    def tangential_displacement(self) -> Array:
        """Tangential displacement u_t, eq. (1), shape (n_points, gdim), in length.

        It is zero if the law has no tangential traction.
        """
        if not self.law.has_tangential:
            return np.zeros_like(self.points)
        return self.values.tangential(self.values.jump)

    def slip_vector(self) -> Array:
        """Return the slip vector Δu_t + K_t⁻¹ Δτ of the increment, (n_points, gdim), in length.

        Where the gap opens, it includes the displacement beyond the elastic one. Collective.

        Raises:
            numpy.linalg.LinAlgError: K_t is singular; raised on all ranks.
        """
        with collective_errors(self.surface.mesh.comm):
            return self.values.slip_vector

    @property
    def slip_increment(self) -> Array:
        """Slip increment Δβ of every mode since the last commit, (n_points, n_modes), in length."""
        return self.values.slip_increment

    @property
    def slip(self) -> Array:
        """Accumulated slip β of every mode, committed, shape (n_points, n_modes), in length."""
        if self.law.has_friction:
            return self.history.values("slip")
        return np.zeros((self.quadrature.n_points, 0))

    @property
    def status(self) -> npt.NDArray[np.int8]:
        """`Status` of every point in the last evaluated increment, shape (n_points,).

        Without tangential tractions, closed points slip. If the law bears tension, only points
        without an opposite point are open.
        """
        law = self.law
        return self.values.status(tension=law.has_tension, sticks=law.has_tangential)

    @property
    def measure(self) -> Array:
        """Quadrature weights times the contact's weight, shape (n_points,).

        Its unit is area, or length in the plane with a weight of 1 (default), per unit thickness.
        """
        return self.quadrature.weights * self.values.weight

    @abstractmethod
    def places(self) -> Array:
        """Return the points where tractions act: X, or X + u with finite kinematics. Collective.

        Returns:
            Array (n_points, gdim) (length).
        """

    def moment(self, about: Sequence[float]) -> Array:
        """Return the moment of the contact forces on the body about a point. Collective.

        The forces act on the undeformed Γc, or at X + u with finite kinematics. The moment on a
        rigid obstacle has the opposite sign.

        Args:
            about: The point, gdim numbers (length).

        Returns:
            The moment (force times length): in the plane the component out of it, (1,), in space
            (3,).
        """
        places = self.places()
        arm = places - as_vector(f"{self.name}: about", about, places.shape[1])
        force = self.measure[:, None] * self.traction
        if places.shape[1] == 3:
            moment = np.cross(arm, force)
        else:
            moment = (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0])[:, None]
        return global_sum(self.surface.mesh.comm, moment.sum(axis=0))

    def area_stretch(self) -> Array:
        """Return the area ratio |J F⁻ᵀ N| with F = I + grad u, (n_points,). Collective.

        The tractions of the contact are nominal; divided by the ratio they are Cauchy tractions,
        per deformed area. For axisymmetric bodies multiply it by the hoop stretch 1 + u_r/r.
        """
        self.displacement.update()
        return self._stretch()["area"]

    @cached_property
    def _stretch(self) -> PointEvaluator:
        u, normal = self.displacement.u, ufl.FacetNormal(self.surface.mesh)
        gradient = ufl.Identity(len(u)) + ufl.grad(u)
        normal = ufl.det(gradient) * ufl.dot(ufl.transpose(ufl.inv(gradient)), normal)
        area = ufl.sqrt(ufl.dot(normal, normal))
        return PointEvaluator(self.quadrature, {"area": area})

    def function(self, name: str, into: fem.Function | None = None) -> fem.Function:
        """Return a result as a function on Γc, for UFL forms and files. Collective.

        The function is discontinuous and linear on every facet: the least-squares fit of the values
        at the quadrature points, limited to their range. Its integral over a flat facet is that of
        the points. It is defined on ``surface.submesh``: compile forms on the body's mesh with
        ``entity_maps=contact.entity_maps``.

        Args:
            name: "pressure", "traction" (r_n n + τ on the body), "tangential_traction" (stress),
                "gap" (length; NaN on facets without opposite points), "slip" (committed, sum of the
                modes, length) or "normal".
            into: A function that an earlier call has returned for a result of this shape; its
                values are updated, so that forms need not be compiled again. By default a new
                function is created.

        Raises:
            ValueError: There is no such result, or ``into`` is another function.
        """
        if name not in _FUNCTIONS:
            raise ValueError(
                f"{self.name}: there is no function of the result {name!r}; use one of "
                f"{list(_FUNCTIONS)}"
            )
        values = self.values.normal if name == "normal" else getattr(self, name)
        values = values.sum(axis=1) if name == "slip" else values
        submesh, d = self.surface.submesh, self.points.shape[1]
        cell, shape = submesh.topology.cell_name(), values.shape[1:]
        element = basix.ufl.element("DG", cell, 1, shape=shape)
        if into is None:
            into = fem.Function(fem.functionspace(submesh, element), name=name)
        check_instance(f"{self.name}: into", into, fem.Function)
        space = into.function_space
        if space.mesh != submesh or space.ufl_element() != element:
            raise ValueError(
                f"{self.name}: into is in {space.ufl_element()}; it must be a function that "
                f"function({name!r}) of this contact has returned"
            )
        n_cells = submesh.topology.index_map(submesh.topology.dim).size_local
        rows = self.quadrature.space().dofmap.list[:n_cells]
        dofs = space.dofmap.list[:n_cells]
        nodes = space.tabulate_dof_coordinates()[dofs][:, :, :d]
        fitted = facet_values(self.points[rows], self.quadrature.weights[rows], values[rows], nodes)
        into.x.array.reshape(-1, *shape)[dofs] = fitted
        into.x.scatter_forward()
        return into

    def resultants(self) -> Resultants:
        """Return forces, moment, extents and numbers of points. Collective."""
        comm = self.surface.mesh.comm
        measure, status = self.measure, self.status
        tangential = np.linalg.norm(self.tangential_traction, axis=1)
        force = global_sum(comm, measure @ self.traction)
        sums = global_sum(
            comm,
            [
                measure @ self.pressure,
                measure @ tangential,
                *(np.count_nonzero(status == s) for s in Status),
            ],
        )
        return Resultants(
            per_thickness=self.inputs.per_thickness,
            force=force,
            normal_force=float(sums[0]),
            tangential_force=float(sums[1]),
            moment=self.moment([0.0] * self.points.shape[1]),
            extents=self._extents(),
            open=int(sums[2]),
            stick=int(sums[3]),
            slip=int(sums[4]),
            max_pressure=global_max(comm, self.pressure),
            max_penetration=global_max(comm, self.values.penetration),
        )

    def _extents(self) -> dict[str, ZoneExtent]:
        """Return the extents of the contact, stick and slip zones. Collective."""
        comm, x, status = self.surface.mesh.comm, self.points, self.status
        states = {
            "contact": status != Status.OPEN,
            "stick": status == Status.STICK,
            "slip": status == Status.SLIP,
        }
        areas = global_sum(comm, [self.measure @ points for points in states.values()])
        local_ends = [
            (x[points].min(axis=0, initial=np.inf), x[points].max(axis=0, initial=-np.inf))
            for points in states.values()
        ]
        ends = np.array(comm.allgather(local_ends))  # by rank and state
        low, high = ends[:, :, 0].min(axis=0), ends[:, :, 1].max(axis=0)
        low, high = (np.where(low <= high, end, np.nan) for end in (low, high))
        rows = zip(states, areas, low, high, strict=True)
        return {name: ZoneExtent(float(area), *each) for name, area, *each in rows}

    def gather(self) -> dict[str, Array]:
        """Gather the results of all ranks on every rank. Collective.

        Points are sorted by their coordinates, which are rounded to 1e-9 of the largest one.

        Returns:
            Arrays over all points of Γc by name: x, normal, gap, pressure, tangential_traction,
            slip (sum of the modes), status, measure.
        """
        d = self.surface.mesh.geometry.dim
        rows = np.column_stack(
            [
                self.points,
                self.values.normal,
                self.tangential_traction,
                self.gap,
                self.pressure,
                self.slip.sum(axis=1),
                self.status,
                self.measure,
            ]
        )
        rows = gather_rows(self.surface.mesh.comm, rows)
        rows = rows[sort_by_coordinates(rows[:, :d])]
        vectors = {"x": rows[:, :d], "normal": rows[:, d : 2 * d]}
        vectors["tangential_traction"] = rows[:, 2 * d : 3 * d]
        names = ("gap", "pressure", "slip", "status", "measure")
        return vectors | {n: rows[:, 3 * d + i] for i, n in enumerate(names)}
