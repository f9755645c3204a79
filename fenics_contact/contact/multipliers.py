"""Augmented Lagrangian: multipliers take over what the springs of the penalty bear.

With λ_n and λ_t at the points of Γc the laws read r_n = -⟨λ_n + k_n (u_n - s)⟩₊, and the return map
starts from λ_t in place of the committed traction. Where λ_n = -r_n and λ_t = τ nothing penetrates,
and nothing creeps before it slips, however soft the springs are. After every solution the
multipliers are taken from the tractions found, and the next one starts from there (Uzawa): each
round leaves a share of about 1/(1 + k_n/k) of the penetration, k the stiffness of the body against
it. Where springs are soft that is nearly all of it, so rounds are accelerated
(`methods/acceleration.py`).

There are more points on Γc than displacements can answer: 3 to an edge of quadratic cells, which
has 2 nodes of its own. Multipliers of every point would pile up what nothing answers, and those
that hold a displacement by a corner would take hundreds of rounds. So λ is the L2 projection Π of
the tractions onto continuous functions of one degree less than the displacement (at least 1), with
the quadrature of Γc: stationary point of the augmented Lagrangian with multipliers in that space,
Π(u_n - s) = 0 where all of a neighbourhood is closed. What the projection leaves to the springs
falls with the mesh as the rest of the error does.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from fenics_contact.contact.values import PointValues
from fenics_contact.laws.base import Law
from fenics_contact.parallel import global_max
from fenics_contact.surface.bodies import connected_bodies
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.mass import mass_solver
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.tolerances import ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["Multipliers", "TraceProjection"]


# Round-off of a displacement, by its size.
_BLUR = 100 * np.finfo(float).eps
# Where tractions have grown by more than the first factor since the rounds began, the springs must
# bear less than this share of what they did then: else multipliers grow by the same in every round,
# and what is left is small beside them alone.
_GROWN, _FALLEN = 2.0, 0.1
# Round-off of a traction, by its size.
_LOST = 16 * np.finfo(float).eps


class TraceProjection:
    """The function of a degree on Γc that is closest to values at the points, at these points.

    Closest in the mean square over Γc by its quadrature; continuous. Where the points are too few
    to tell the functions apart it is one of the closest, which have the same values there. The
    constructor is collective.

    Args:
        degree: Of the displacement element; that of the functions is one less, and at least 1.
    """

    def __init__(self, quadrature: SurfaceQuadrature, degree: int) -> None:
        trace = ("Lagrange", max(1, degree - 1))
        space = fem.functionspace(quadrature.surface.submesh, trace)
        self._basis = quadrature.interpolation_matrix(space)
        self._values = self._basis.createVecLeft()
        self._weights = self._basis.createVecLeft()
        self._weights.array[:] = quadrature.weights
        weighted = self._basis.copy()
        weighted.diagonalScale(self._weights, None)
        gram = self._basis.transposeMatMult(weighted)
        weighted.destroy()
        self._right, self._solution = gram.createVecs()
        self._ksp = mass_solver(gram, rtol=1e-13, atol=1e-300, max_it=500)

    def __call__(self, values: Array) -> Array:
        """Project, (n_points,) or a column at a time (n_points, n). Collective."""
        columns = values if values.ndim > 1 else values[:, None]
        result = np.zeros_like(columns)
        for i in range(columns.shape[1]):
            self._values.array[:] = columns[:, i]
            self._values.pointwiseMult(self._weights, self._values)
            self._basis.multTranspose(self._values, self._right)
            self._ksp.solve(self._right, self._solution)
            self._basis.mult(self._solution, self._values)
            result[:, i] = self._values.array_r
        return result.reshape(values.shape)


class Multipliers:
    """λ_n and λ_t at the points of a contact, zero at first.

    The constructor is collective.

    Args:
        degree: Degree of the displacement element.
        turning: Whether normals turn.

    Attributes:
        fields: "pressure" λ_n and, with friction, "traction" λ_t (stress), in the frame of the
            obstacle; where normals turn, "normal" are those it is across.
        project: The L² projection onto the space that they are in.
        as_displacement: Whether they are functions of the displacement's own degree, which is 1.
    """

    def __init__(
        self, quadrature: SurfaceQuadrature, degree: int, law: Law, *, turning: bool
    ) -> None:
        self._comm = quadrature.surface.mesh.comm
        self._law = law
        vectors = ["traction", "normal"] if turning else ["traction"]
        self._vectors = vectors if law.has_friction else []
        gdim = quadrature.surface.mesh.geometry.dim
        self.fields = PointFields(quadrature, {"pressure": 0} | dict.fromkeys(self._vectors, gdim))
        self.as_displacement = degree == 1
        self.project = TraceProjection(quadrature, degree)
        # By connected part of Γc: one of them may bear a millionth of another.
        self._patch, self._n_patches = _patches(quadrature)
        # Of every part, change and tractions of the first round; NaN: there was none yet.
        self._first: Array = np.full((2, self._n_patches), np.nan)
        self._left_out: Array | None = None  # of the next change of λ_t

    def _next(self, values: PointValues) -> dict[str, Array]:
        """The multipliers that the tractions of an evaluated contact make."""
        found: dict[str, Array] = {"pressure": np.zeros(len(values.normal_traction))}
        if self._law.has_normal_stiffness:
            found["pressure"] = self.project(-values.normal_traction)
        if self._law.has_friction:
            found["traction"] = self.project(values.framed_traction)
            if self._left_out is not None:
                found["traction"] -= self._left_out
        return found

    def tangential_change(self, values: PointValues) -> Array:
        """All that the tractions of an evaluated contact change of λ_t. Collective.

        Returns:
            In the frame of the obstacle, (n_points, gdim) (stress).
        """
        self._left_out = None
        return np.asarray(self._next(values)["traction"] - self.fields.values("traction"))

    def leave_out(self, part: Array) -> None:
        """Leave a part out of the next change, until `tangential_change` or `restore` is called."""
        self._left_out = part

    def error(self, values: PointValues, history: PointFields, moved: Array) -> float:
        """Largest change that `update` would make, see `Contact.enforcement_error`. Collective."""
        found = self._next(values)
        names = [n for n in ("normal_traction", "traction") if n in history]

        def largest(rows: Iterable[Array]) -> Array:
            return np.max([self._largest(row) for row in rows], axis=0, initial=0.0)

        change = largest(found[n] - self.fields.values(n) for n in found)
        # By the tractions of this increment: those before it leave round-off and no more.
        scale = largest(values.arrays[n] for n in names)
        before = largest(history.values(n) for n in names)
        # Displacements have round-off however little is borne, and springs make a traction of it.
        springs = [values.parameters[n] for n in sorted({"k_n", "k_t"} & set(values.parameters))]
        noise = _BLUR * largest(k * moved for k in springs)
        bears = scale > noise
        begins = bears & (change > 0) & np.isnan(self._first[0])
        self._first = np.where(begins, [change, scale], self._first)
        # What springs bear may be lost in the round-off of multipliers that have grown so far.
        left = np.maximum(change, _LOST * scale)
        first = np.where(np.isnan(self._first), [left, scale], self._first)
        grown = bears & (scale > _GROWN * first[1]) & (left > _FALLEN * first[0])
        nothing = change <= np.maximum(ROUND_OFF * np.maximum(scale, before), noise)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(nothing, 0.0, change / scale)
            error = np.where(grown, left / first[1], relative)
        return float(error.max())

    def _largest(self, values: Array) -> Array:
        """Largest absolute value on every connected part of Γc, (n_patches,). Collective.

        Args:
            values: (n_points,) or (n_points, n).
        """
        sizes = np.abs(values) if values.ndim == 1 else np.abs(values).max(axis=1, initial=0.0)
        found: Array = np.zeros(self._n_patches)
        np.maximum.at(found, self._patch, sizes)
        self._comm.Allreduce(MPI.IN_PLACE, found, op=MPI.MAX)
        return found

    def shrink(self, share: float) -> None:
        """Begin the rounds with a share of λ_n; λ_t, which friction has come to, stays."""
        values = {name: self.fields.values(name) for name in ("pressure", *self._vectors)}
        self.fields.assign(values | {"pressure": share * values["pressure"]})

    def drop(self, idle: Mask) -> None:
        """Forget the multipliers of the parts of Γc of which no point bears force. Collective.

        Args:
            idle: Which points bear none, (n_points,).
        """
        bears = self._largest(np.where(idle, 0.0, 1.0))[self._patch] > 0.0
        self.fields.set_rows(np.where(bears[:, None], self.fields.rows(), 0.0))

    def augmented(self, values: PointValues) -> Array:
        """The multipliers, and those that the tractions of an evaluated contact make. Collective.

        Returns:
            Array (2, n_points, 1 or 1 + gdim) (stress): λ_n and, with friction, λ_t.
        """
        found = self._next(values)
        given = [self.fields.values(name) for name in found]
        return np.stack([np.column_stack(given), np.column_stack(list(found.values()))])

    def take(self, rows: Array, values: PointValues) -> None:
        """Go on with other multipliers at an evaluated contact. Collective.

        Args:
            rows: λ_n and, with friction, λ_t, (n_points, 1 + gdim) (stress).
            values: Of the contact.
        """
        self.fields.assign(
            {"pressure": rows[:, 0], "traction": rows[:, 1:], "normal": values.framed_normal}
        )

    def sizes(self, rows: Array) -> Array:
        """Largest absolute values on each connected part of Γc, at its points. Collective.

        Args:
            rows: (n_points, n).

        Returns:
            Array (n_points,).
        """
        return self._largest(rows)[self._patch]

    def committed(self, values: PointValues) -> dict[str, Array]:
        """What of the state of an evaluated contact becomes history, by name.

        The next increment counts Δu_t from where its return map, which starts from λ_t, gives the
        present τ: else a sticking point would creep by what is left within the tolerance, increment
        by increment.
        """
        found = {"multiplier": self.fields.values("pressure")}
        if self._law.has_friction:
            found |= {name: self.fields.values(name) for name in self._vectors}
            found["jump"] = values.projection_point - values.elastic_slip
        borne = [values.arrays[n] for n in ("normal_traction", "traction") if n in values.arrays]
        if not any(global_max(self._comm, np.abs(part)) > 0.0 for part in borne):
            # Round-off that is left of them would close points that a body just touches again.
            zeros = {"multiplier", "traction"} & set(found)
            found |= {name: np.zeros_like(found[name]) for name in zeros}
        return found

    def restore(self, history: PointFields) -> None:
        """Take those of the last commit. Collective."""
        self._first[:] = np.nan
        self._left_out = None
        values = {"pressure": history.values("multiplier")}
        self.fields.assign(values | {name: history.values(name) for name in self._vectors})


def _patches(quadrature: SurfaceQuadrature) -> tuple[Index, int]:
    """The connected part of Γc that each of this rank's points is on, and their number. Collective.

    Returns:
        Numbers from 0, (n_points,), and how many there are.
    """
    space = fem.functionspace(quadrature.surface.submesh, ("Lagrange", 1))
    n_patches, of_node = connected_bodies(space)
    rows = quadrature.point_rows
    cells = np.argsort(quadrature.surface.parent_facets())
    patch = np.zeros(quadrature.n_points, dtype=np.intp)
    patch[rows.ravel()] = np.repeat(of_node[space.dofmap.list[cells, 0]], rows.shape[1])
    return patch, n_patches
