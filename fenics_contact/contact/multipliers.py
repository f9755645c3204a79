"""Multipliers of the augmented Lagrangian, eq. (8), and their projection.

If λ_n = -r_n and λ_t = τ there is neither penetration nor elastic slip, for any penalty. After
every solution the multipliers are set to the tractions (Uzawa): an augmentation reduces the
penetration to about 1/(1 + k_n/k) with the stiffness k of the body, and is accelerated
(`methods/acceleration.py`).

Multipliers at every quadrature point would be too rich a space: an edge of quadratic cells has 3
points, but 2 nodes of its own. Therefore λ is the L² projection Π of the tractions onto continuous
functions of one degree less than the displacement (at least 1). The solution is a stationary point
of the augmented Lagrangian in this space, with Π(u_n - s) = 0 in closed zones; the part of the
traction left to the penalty converges with the mesh.
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
from fenics_contact.surface.mass import create_mass_solver
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.tolerances import EVALUATION_ROUND_OFF, ROUND_OFF
from fenics_contact.types import Array, Index, Mask

__all__ = ["Multipliers", "TraceProjection"]

# If tractions have grown by more than the first factor since the first augmentation, the penalty
# part must have decreased below the second factor times that of the first: otherwise multipliers
# diverge, and the penalty part is small only relative to them.
_TRACTION_GROWTH_RATIO, _PENALTY_REDUCTION_RATIO = 2.0, 0.1


class TraceProjection:
    """L² projection of values at the quadrature points onto continuous functions on Γc.

    The norm is that of the quadrature; the degree is one less than that of the displacement, and at
    least 1. If the points do not determine the function, it is one of the closest ones, which have
    equal values at the points. The constructor is collective.
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
        self._ksp = create_mass_solver(gram, rtol=1e-13, atol=1e-300, max_it=500)

    def __call__(self, values: Array) -> Array:
        """Return projected values, (n_points,) or columns (n_points, n). Collective."""
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
    """λ_n and λ_t at the points of a contact, initially zero. The constructor is collective.

    Args:
        degree: Degree of the displacement element.
        turning: Whether normals rotate.

    Attributes:
        fields: "pressure" λ_n and, with friction, "traction" λ_t (stress), in the frame of the
            obstacle; if normals rotate, also the "normal" of λ_t.
        project: The L² projection onto the multiplier space.
        as_displacement: Whether the multiplier space has the displacement's own degree, which is 1.
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
        # By connected part of Γc, whose tractions may differ by orders of magnitude.
        self._patch, self._n_patches = _patches(quadrature)
        # Change and largest traction of every part at the first augmentation; NaN before it.
        self._first: Array = np.full((2, self._n_patches), np.nan)
        self._excluded_part: Array | None = None  # from the next change of λ_t

    def _next_multipliers(self, values: PointValues) -> dict[str, Array]:
        """Return the projected tractions of an evaluated state, the next multipliers."""
        projected: dict[str, Array] = {"pressure": np.zeros(len(values.normal_traction))}
        if self._law.has_normal_stiffness:
            projected["pressure"] = self.project(-values.normal_traction)
        if self._law.has_friction:
            projected["traction"] = self.project(values.framed_traction)
            if self._excluded_part is not None:
                projected["traction"] -= self._excluded_part
        return projected

    def tangential_update(self, values: PointValues) -> Array:
        """Return the change of λ_t by an augmentation, in the obstacle's frame. Collective."""
        self._excluded_part = None
        return np.asarray(
            self._next_multipliers(values)["traction"] - self.fields.values("traction")
        )

    def exclude(self, part: Array) -> None:
        """Exclude a part from the next change of λ_t, until `tangential_update` or `restore`."""
        self._excluded_part = part

    def error(self, values: PointValues, history: PointFields, moved: Array) -> float:
        """Return `Contact.enforcement_error` of an evaluated state. Collective."""
        projected = self._next_multipliers(values)
        names = [n for n in ("normal_traction", "traction") if n in history]

        def largest(rows: Iterable[Array]) -> Array:
            return np.max([self._largest(row) for row in rows], axis=0, initial=0.0)

        change = largest(projected[n] - self.fields.values(n) for n in projected)
        scale = largest(values.arrays[n] for n in names)
        committed_scale = largest(history.values(n) for n in names)
        # The round-off of the jump times the stiffness is a traction.
        springs = [values.parameters[n] for n in sorted({"k_n", "k_t"} & set(values.parameters))]
        noise = EVALUATION_ROUND_OFF * largest(k * moved for k in springs)
        is_loaded = scale > noise
        is_first = is_loaded & (change > 0) & np.isnan(self._first[0])
        self._first = np.where(is_first, [change, scale], self._first)
        # The penalty part may be below the round-off of multipliers that have grown.
        penalty_part = np.maximum(change, EVALUATION_ROUND_OFF * scale)
        first = np.where(np.isnan(self._first), [penalty_part, scale], self._first)
        is_diverging = is_loaded & (scale > _TRACTION_GROWTH_RATIO * first[1])
        is_diverging &= penalty_part > _PENALTY_REDUCTION_RATIO * first[0]
        is_converged = change <= np.maximum(ROUND_OFF * np.maximum(scale, committed_scale), noise)
        with np.errstate(divide="ignore", invalid="ignore"):
            relative = np.where(is_converged, 0.0, change / scale)
            error = np.where(is_diverging, penalty_part / first[1], relative)
        return float(error.max())

    def _largest(self, values: Array) -> Array:
        """Return the largest absolute value on each connected part of Γc. Collective."""
        sizes = np.abs(values) if values.ndim == 1 else np.abs(values).max(axis=1, initial=0.0)
        maxima: Array = np.zeros(self._n_patches)
        np.maximum.at(maxima, self._patch, sizes)
        self._comm.Allreduce(MPI.IN_PLACE, maxima, op=MPI.MAX)
        return maxima

    def scale_pressure(self, factor: float) -> None:
        """Multiply λ_n by a factor before the augmentations; λ_t is not changed."""
        values = {name: self.fields.values(name) for name in ("pressure", *self._vectors)}
        self.fields.assign(values | {"pressure": factor * values["pressure"]})

    def reset_unloaded(self, unloaded: Mask) -> None:
        """Set the multipliers of unloaded connected parts of Γc to zero. Collective."""
        is_loaded = self._largest(np.where(unloaded, 0.0, 1.0))[self._patch] > 0.0
        self.fields.set_rows(np.where(is_loaded[:, None], self.fields.rows(), 0.0))

    def augmented(self, values: PointValues) -> Array:
        """Return the multipliers, and those after an augmentation of a state. Collective.

        Returns:
            Array (2, n_points, 1 or 1 + gdim) (stress): λ_n and, with friction, λ_t.
        """
        projected = self._next_multipliers(values)
        present = [self.fields.values(name) for name in projected]
        return np.stack([np.column_stack(present), np.column_stack(list(projected.values()))])

    def assign(self, rows: Array, values: PointValues) -> None:
        """Set λ_n and, with friction, λ_t, (n_points, 1 + gdim) (stress). Collective."""
        self.fields.assign(
            {"pressure": rows[:, 0], "traction": rows[:, 1:], "normal": values.framed_normal}
        )

    def largest_on_parts(self, rows: Array) -> Array:
        """Return the largest absolute value on the connected part of each point. Collective."""
        return self._largest(rows)[self._patch]

    def committed(self, values: PointValues) -> dict[str, Array]:
        """Return the history fields of an evaluated state, by name.

        The reference of Δu_t is such that the return map from λ_t gives the present τ; otherwise
        sticking points would creep by the part within the tolerance in every increment.
        """
        fields = {"multiplier": self.fields.values("pressure")}
        if self._law.has_friction:
            fields |= {name: self.fields.values(name) for name in self._vectors}
            fields["jump"] = values.projection_point - values.elastic_slip
        parts = [values.arrays[n] for n in ("normal_traction", "traction") if n in values.arrays]
        if not any(global_max(self._comm, np.abs(part)) > 0.0 for part in parts):
            # Round-off in the multipliers would close points at the next touch.
            zeros = {"multiplier", "traction"} & set(fields)
            fields |= {name: np.zeros_like(fields[name]) for name in zeros}
        return fields

    def restore(self, history: PointFields) -> None:
        """Restore the multipliers of the last commit. Collective."""
        self._first[:] = np.nan
        self._excluded_part = None
        values = {"pressure": history.values("multiplier")}
        self.fields.assign(values | {name: history.values(name) for name in self._vectors})


def _patches(quadrature: SurfaceQuadrature) -> tuple[Index, int]:
    """Return the connected part of Γc of each point, (n_points,), and their number. Collective."""
    space = fem.functionspace(quadrature.surface.submesh, ("Lagrange", 1))
    n_patches, of_node = connected_bodies(space)
    rows = quadrature.point_rows
    cells = np.argsort(quadrature.surface.parent_facets())
    patch = np.zeros(quadrature.n_points, dtype=np.intp)
    patch[rows.ravel()] = np.repeat(of_node[space.dofmap.list[cells, 0]], rows.shape[1])
    return patch, n_patches
