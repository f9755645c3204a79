"""Augmented Lagrangian: multipliers take over what the springs of the penalty bear.

With λ_n and λ_t at the points of Γc the laws read r_n = -⟨λ_n + k_n (u_n - s)⟩₊, and the return map
starts from λ_t in place of the committed traction. Where λ_n = -r_n and λ_t = τ nothing penetrates,
and nothing creeps before it slips, however soft the springs are. After every solution the
multipliers are taken from the tractions found, and the next one starts from there (Uzawa): each
round leaves a share of about 1/(1 + k_n/k) of the penetration, k the stiffness of the body against
it. Where springs are soft that is nearly all of it, so a round goes on to the combination of the
last ones that leaves least (Anderson acceleration, doi:10.1137/10078356X).

There are more points on Γc than displacements can answer: 3 to an edge of quadratic cells, which
has 2 nodes of its own. Multipliers of every point would pile up what nothing answers, and those
that hold a displacement by a corner would take hundreds of rounds. So λ is the L2 projection Π of
the tractions onto continuous functions of one degree less than the displacement (at least 1), with
the quadrature of Γc: stationary point of the augmented Lagrangian with multipliers in that space,
Π(u_n - s) = 0 where all of a neighbourhood is closed. What the projection leaves to the springs
falls with the mesh as the rest of the error does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from dolfinx import fem

from fenics_contact.contact.values import PointValues
from fenics_contact.laws.base import Law
from fenics_contact.parallel import global_max, global_sum
from fenics_contact.surface.fields import PointFields
from fenics_contact.surface.mass import mass_solver
from fenics_contact.surface.surface import SurfaceQuadrature
from fenics_contact.types import Array

__all__ = ["Multipliers", "TraceProjection"]


# Of the projection of tractions, relative.
_ROUND_OFF = 1e-12
# Round-off of a displacement, by its size.
_BLUR = 100 * np.finfo(float).eps
# How many rounds before the last are combined with it, and how well their rests are to be told
# apart, relative and squared.
_DEPTH, _DISTINCT = 6, 1e-12
# Where tractions have grown by more than the first factor since the rounds began, the springs must
# bear less than this share of what they did then: else multipliers grow by the same in every round,
# and what is left is small beside them alone.
_GROWN, _FALLEN = 2.0, 0.1
# Round-off of a traction, by its size.
_LOST = 16 * np.finfo(float).eps


class TraceProjection:
    """The function of a degree on Γc that is closest to values at the points, at these points.

    Closest in the mean square over Γc by its quadrature; continuous. Where the points are too few
    to tell the functions apart it is one of the closest, which have the same values there.
    """

    def __init__(self, quadrature: SurfaceQuadrature, degree: int) -> None:
        """Tabulate the functions. Collective.

        Args:
            quadrature: The points.
            degree: Of the displacement element; that of the functions is one less, and at least 1.
        """
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


class _Acceleration:
    """Anderson's, of a sequence in which each array is made from the one before.

    The next is the combination of those made, the coefficients adding up to 1, whose rests (what a
    round changes) combined that way are least in the mean square over Γc. A rest that is larger
    than the one before, as where points have changed their status, begins a new sequence.
    """

    def __init__(self, quadrature: SurfaceQuadrature) -> None:
        self._comm = quadrature.surface.mesh.comm
        self._weights = quadrature.weights
        self._last: tuple[Array, Array] | None = None
        self._size = np.inf
        self._steps: list[tuple[Array, Array]] = []

    def begin(self) -> None:
        """Drop all rounds."""
        self._last, self._size, self._steps = None, np.inf, []

    def __call__(self, given: Array, made: Array) -> Array:
        """The next of the sequence. Collective.

        Args:
            given: What the round began with, (n_points, n).
            made: What came of it, the same shape.
        """
        rest = made - given
        size = float(self._product(rest, rest))
        if self._last is None or size > self._size:
            self.begin()
        else:
            self._steps.append((rest - self._last[0], made - self._last[1]))
            self._steps = self._steps[-_DEPTH:]
        self._last, self._size = (rest, made), size
        if not self._steps:
            return made
        changes = [change for change, _ in self._steps]
        gram = np.array([[self._product(a, b) for b in changes] for a in changes])
        right = np.array([self._product(a, rest) for a in changes])
        long = np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
        share = np.linalg.lstsq(gram / np.outer(long, long), right / long, rcond=_DISTINCT)[0]
        steps = [way for _, way in self._steps]
        return made - sum(c * way for c, way in zip(share / long, steps, strict=True))

    def _product(self, a: Array, b: Array) -> Array:
        return global_sum(self._comm, self._weights @ np.sum(a * b, axis=1))


class Multipliers:
    """λ_n and λ_t at the points of a contact.

    Attributes:
        fields: "pressure" λ_n and, with friction, "traction" λ_t (stress), in the frame of the
            support; where normals turn, "normal" are those it is across.
        as_displacement: Whether they are functions of the displacement's own degree, which is 1.
    """

    def __init__(
        self, quadrature: SurfaceQuadrature, degree: int, law: Law, *, turning: bool
    ) -> None:
        """Zeros. Collective.

        Args:
            quadrature: The points.
            degree: Of the displacement element.
            law: Of the contact.
            turning: Whether normals turn.
        """
        self._comm = quadrature.surface.mesh.comm
        self._law = law
        vectors = ["traction", "normal"] if turning else ["traction"]
        self._vectors = vectors if law.has_friction else []
        gdim = quadrature.surface.mesh.geometry.dim
        self.fields = PointFields(quadrature, {"pressure": 0} | dict.fromkeys(self._vectors, gdim))
        self.as_displacement = degree == 1
        self._project = TraceProjection(quadrature, degree)
        self._accelerated = _Acceleration(quadrature)
        self._first: tuple[float, float] | None = None  # change and tractions of the first round
        self._left_out: Array | None = None  # of the next change of λ_t

    def _next(self, values: PointValues) -> dict[str, Array]:
        """The multipliers that the tractions of an evaluated contact make."""
        found: dict[str, Array] = {"pressure": np.zeros(len(values.normal_traction))}
        if self._law.has_normal_stiffness:
            found["pressure"] = self._project(-values.normal_traction)
        if self._law.has_friction:
            found["traction"] = self._project(values.framed_traction)
            if self._left_out is not None:
                found["traction"] -= self._left_out
        return found

    def tangential_change(self, values: PointValues) -> Array:
        """All that the tractions of an evaluated contact change of λ_t. Collective.

        Returns:
            In the frame of the support, (n_points, gdim) (stress).
        """
        self._left_out = None
        return np.asarray(self._next(values)["traction"] - self.fields.values("traction"))

    def leave_out(self, part: Array) -> None:
        """Make the next change without a part, until `tangential_change` or `restore` is called.

        Args:
            part: Of what `tangential_change` gave.
        """
        self._left_out = part

    def error(self, values: PointValues, history: PointFields, moved: Array) -> float:
        """Largest change that `update` would make, see `Contact.enforcement_error`. Collective.

        Args:
            values: Of the evaluated contact.
            history: The committed state.
            moved: See `Contact.moved`.
        """
        found = self._next(values)
        names = [n for n in ("normal_traction", "traction") if n in history]

        def largest(of: Callable[[str], Array], names: Iterable[str]) -> float:
            return max(global_max(self._comm, np.abs(of(n))) for n in names)

        change = largest(lambda n: found[n] - self.fields.values(n), found)
        # By the tractions of this increment: those before it leave round-off and no more.
        scale = largest(lambda n: values.arrays[n], names)
        before = largest(history.values, names)
        # Displacements have round-off however little is borne, and springs make a traction of it.
        springs = [values.parameters[n] for n in sorted({"k_n", "k_t"} & set(values.parameters))]
        noise = max(
            (float(_BLUR * global_max(self._comm, k * moved)) for k in springs), default=0.0
        )
        if scale > noise:
            if change > 0:
                self._first = self._first or (change, scale)
            # What springs bear may be lost in the round-off of multipliers that have grown so far.
            left = max(change, _LOST * scale)
            first = self._first or (left, scale)
            if scale > _GROWN * first[1] and left > _FALLEN * first[0]:
                return left / first[1]
        if change <= max(_ROUND_OFF * max(scale, before), noise):
            return 0.0
        return change / scale if scale > 0 else np.inf

    def shrink(self, share: float) -> None:
        """Begin the rounds with a share of λ_n; λ_t, which friction has come to, stays."""
        values = {name: self.fields.values(name) for name in ("pressure", *self._vectors)}
        self.fields.commit(values | {"pressure": share * values["pressure"]})

    def update(self, values: PointValues) -> None:
        """Make the tractions of an evaluated contact the multipliers, and go on. Collective."""
        found = self._next(values)
        given = np.column_stack([self.fields.values(name) for name in found])
        rows = self._accelerated(given, np.column_stack(list(found.values())))
        self.fields.commit(
            {"pressure": rows[:, 0], "traction": rows[:, 1:], "normal": values.framed_normal}
        )

    def committed(self, values: PointValues) -> dict[str, Array]:
        """What of the state of an evaluated contact becomes history, by name.

        The next increment counts Δu_t from where its return map, which starts from λ_t, gives the
        present τ: else a sticking point would creep by what is left within the tolerance, increment
        by increment.
        """
        found = {"multiplier": self.fields.values("pressure")}
        if self._law.has_friction:
            found |= {name: self.fields.values(name) for name in self._vectors}
            found["jump"] = values.foot - values.elastic_slip
        borne = [values.arrays[n] for n in ("normal_traction", "traction") if n in values.arrays]
        if not any(global_max(self._comm, np.abs(part)) > 0.0 for part in borne):
            # Round-off that is left of them would close points that a body just touches again.
            zeros = {"multiplier", "traction"} & set(found)
            found |= {name: np.zeros_like(found[name]) for name in zeros}
        return found

    def restore(self, history: PointFields) -> None:
        """Take those of the last commit. Collective."""
        self._accelerated.begin()
        self._first = self._left_out = None
        values = {"pressure": history.values("multiplier")}
        self.fields.commit(values | {name: history.values(name) for name in self._vectors})
