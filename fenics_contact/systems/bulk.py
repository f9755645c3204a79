"""The residual form of the bulk as a map u → F(u) with its tangent, assembled once if linear.

The additional fields of a mixed function, such as pressures, are scaled so that they are lengths
and their equations forces, of the magnitude of displacements and of forces on them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import basix
import dolfinx.fem.petsc
import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc
from ufl.algorithms import extract_coefficients
from ufl.corealg.traversal import unique_pre_traversal

from fenics_contact.compiling import compile_by_quadrature_rule, compile_expression, compile_form
from fenics_contact.parallel import all_finite, collective_errors, global_max, global_min
from fenics_contact.surface.dependence import Dependence
from fenics_contact.surface.displacement import Displacement
from fenics_contact.systems.measures import check_measures, share_subdomain_data
from fenics_contact.tolerances import NEGLIGIBLE, ROUND_OFF
from fenics_contact.types import Array, Indices

__all__ = ["Bulk"]

_MIXED_HINT = (
    "; several fields must be one function w of a mixed element, whose residual has the "
    "test functions v, q = ufl.TestFunctions(W)"
)


class Bulk:
    """The bulk residual F(u; v), without contact. The constructor is collective.

    Attributes:
        form: The residual (UFL), with one `subdomain_data` for each kind of measure.
        space: Function space of ``u``.
        displacement: The displacement within ``u``.
        units: Scale of every dof of this rank, ghosts included, fixed at the first `update`; None:
            all are 1. All other classes use values over units, and residuals times units.
        tangent_form: The derivative of the residual with respect to ``u`` (UFL).
        linear: Whether F is affine in ``u``: its tangent is then assembled once, and its loads once
            per increment.
        symmetric: Whether the assembled tangent is symmetric.
        stiffness: The tangent without Dirichlet conditions, valid after `update`.
        scale: Largest diagonal entry of the tangent, of the first one if F is not linear: the unit
            of stiffness (force/length).

    Raises:
        ValueError: ``form`` is not a residual in the space of ``u``.
    """

    def __init__(self, form: ufl.Form, displacement: Displacement) -> None:
        u = displacement.whole
        if not isinstance(form, ufl.Form):
            raise ValueError(
                f"F is a {type(form).__name__}; it must be the UFL residual of the bulk, such as "
                "inner(sigma(u), epsilon(v))*dx - inner(load, v)*ds"
                + (_MIXED_HINT if isinstance(form, list | tuple) else "")
            )
        arguments = form.arguments()
        if any(argument.part() is not None for argument in arguments):
            raise ValueError(f"F has test functions of several spaces{_MIXED_HINT}")
        if not arguments:
            raise ValueError(
                "F has no TestFunction; it must be a residual: for an energy use "
                "ufl.derivative(energy, u, v)"
            )
        if len(arguments) != 1:
            raise ValueError(
                f"F has {len(arguments)} arguments; it must be a residual in one TestFunction and "
                "the Function u: replace a TrialFunction by u"
            )
        space = arguments[0].ufl_function_space()
        if space != u.function_space:
            raise ValueError(
                "the TestFunction of F and u are of different function spaces"
                + (
                    "; use v, q = ufl.TestFunctions(W) of its space W"
                    if displacement.is_mixed
                    else ""
                )
            )
        if u not in form.coefficients():
            raise ValueError(
                "F does not depend on u: write the residual with the Function u itself"
                + (", with the parts of ufl.split(w)" if displacement.is_mixed else "")
            )
        for other in form.coefficients():
            if other is not u and np.shares_memory(other.x.array, u.x.array):
                raise ValueError(
                    f"F has {other.name!r}, a part of u given by w.sub(i), which the derivative "
                    "with respect to u ignores; use the parts of ufl.split(w)"
                )
        check_measures(form, u.function_space.mesh)
        form = share_subdomain_data(form)
        self._u, self.displacement = u, displacement
        self.units: Array | None = None
        self.form, self.space = form, u.function_space
        derivative = ufl.derivative(form, u, ufl.TrialFunction(u.function_space))
        self.tangent_form = ufl.algorithms.expand_derivatives(derivative)
        self.linear = not (u in self.tangent_form.coefficients() or _has_condition_on(form, u))
        self._volumes = None if self.linear else _Volumes(displacement)
        kinds = dict.fromkeys(integral.integral_type() for integral in form.integrals())
        parts = (_Part(form, kind, u) for kind in kinds)
        self._parts = [part for part in parts if not part.is_empty]
        self._compiled_tangent = compile_by_quadrature_rule(self.tangent_form)
        self._pattern = (
            self._compiled_tangent[0]
            if len(self._compiled_tangent) == 1
            else compile_form(self.tangent_form)
        )
        self.stiffness: PETSc.Mat = fem.petsc.create_matrix(self._pattern)
        self.symmetric = True
        self.scale = 0.0
        self._load = fem.Function(u.function_space)  # F(0)
        self._image = fem.Function(u.function_space)
        self._state = fem.Function(u.function_space)  # u in units, if there are any
        dofmap = u.function_space.dofmap
        self._n_owned: int = dofmap.index_map.size_local * dofmap.index_map_bs
        tangent = self.tangent_form
        self._dependence = Dependence(tangent.constants(), tangent.coefficients())
        data = [c for c in tangent.coefficients() if c is not u]
        self._data = Dependence(tangent.constants(), data)

    def check_finite(self) -> None:
        """Check that all coefficients and constants are finite. Collective.

        Raises:
            ValueError: One is not; the message names it.
        """
        comm = self._u.function_space.mesh.comm
        for kind, items in (
            ("function", self.form.coefficients()),
            ("constant", self.form.constants()),
        ):
            for position, item in enumerate(items):
                array = item.x.array if kind == "function" else np.ravel(item.value)
                if not all_finite(comm, array):
                    name = "u" if item is self._u else getattr(item, "name", f"number {position}")
                    raise ValueError(
                        f"the {kind} {name!r} in F has values that are not finite (NaN or inf); "
                        "check its definition"
                    )

    def is_current(self) -> bool:
        """Return whether the tangent is that of the present data. Collective."""
        if not self.linear:
            return False
        changed = self._dependence.changed
        return self._u.function_space.mesh.comm.allreduce(int(changed)) == 0

    def update(self) -> bool:
        """Assemble the tangent if it may have changed; return whether it was. Collective."""
        if self.is_current():
            return False
        self._dependence.forget()  # until the matrix is complete
        self.stiffness.zeroEntries()
        self._assemble_tangent(self.stiffness)
        diagonal = self.stiffness.getDiagonal()
        if self.linear or not self.scale:
            of_displacement = self.displacement.within(np.ones(self.displacement.n_owned))
            sizes = np.abs(diagonal.array_r * of_displacement)
            self.scale = global_max(self._u.function_space.mesh.comm, sizes)
        if self.displacement.is_mixed:
            self._apply_units()
            diagonal.destroy()
            diagonal = self.stiffness.getDiagonal()
        self.symmetric = self._is_symmetric(diagonal)
        diagonal.destroy()
        if self.linear:
            self._dependence.note()
        return True

    @contextmanager
    def present_stiffness(self) -> Iterator[PETSc.Mat]:
        """Yield the tangent at the present ``u`` without changing `stiffness`. Collective."""
        if self.is_current():
            yield self.stiffness
            return
        matrix = fem.petsc.create_matrix(self._pattern)
        self._assemble_tangent(matrix)
        self._scale_by_units(matrix)
        try:
            yield matrix
        finally:
            matrix.destroy()

    def _assemble_tangent(self, matrix: PETSc.Mat) -> None:
        """Add the tangent at the present ``u`` to a matrix. Collective."""
        for part in self._compiled_tangent:
            fem.petsc.assemble_matrix(matrix, part)
        matrix.assemble()

    @contextmanager
    def stiffness_at_rest(self) -> Iterator[PETSc.Mat]:
        """Yield the tangent at u = 0 without changing `stiffness`. Collective."""
        values = self._u.x.array
        saved = values.copy()
        values[:] = 0.0
        try:
            with self.present_stiffness() as matrix:
                values[:] = saved
                yield matrix
        finally:
            values[:] = saved

    def has_new_data(self) -> bool:
        """Return whether tangent data have changed since `note_data`. Collective."""
        return self.space.mesh.comm.allreduce(int(self._data.changed)) > 0

    def note_data(self) -> None:
        """Record the present data of the tangent."""
        self._data.note()

    def own_stiffness(self) -> PETSc.Mat:
        """Return the tangent of this rank's cells, with rows of ghosts last. Collective.

        On one rank it is `stiffness`; on several it is a new matrix, and the sum over the ranks is
        `stiffness`.
        """
        if self.space.mesh.comm.size == 1:
            return self.stiffness
        # Unlike that of `fem.petsc`, this matrix keeps the rows of ghosts on this rank.
        matrix = fem.create_matrix(self._pattern)
        for part in self._compiled_tangent:
            fem.assemble_matrix(matrix, part)
        rows = matrix.to_scipy(ghosted=True).tocsr()
        rows.sort_indices()
        csr = (rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType), rows.data)
        return PETSc.Mat().createAIJ(rows.shape, csr=csr, comm=PETSc.COMM_SELF)

    def check_elastic(self) -> None:
        """Check that the assembled tangent has a positive, finite diagonal entry.

        Raises:
            ValueError: It has none.
        """
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(
                f"the largest entry on the diagonal of the bulk stiffness is {self.scale:g}: F has "
                "no elastic part, or a modulus is zero or not finite"
            )

    def update_load(self) -> Array:
        """Assemble F(0), minus the external forces, at this rank's owned dofs. Collective."""
        with collective_errors(self._u.function_space.mesh.comm):
            self._load.x.array[:] = sum(part.assemble_at_zero() for part in self._parts)
        self._load.x.scatter_reverse(dolfinx.la.InsertMode.add)
        return self._owned_residual(self._load)

    def residual(self) -> Array:
        """Evaluate F(u) at this rank's owned dofs, if linear after `update_load`. Collective."""
        if not self.linear:
            return self.assemble_residual()
        state = self._u
        if self.units is not None:
            state = self._state
            state.x.array[:] = self._u.x.array / self.units
        self.stiffness.mult(state.x.petsc_vec, self._image.x.petsc_vec)
        n = self._n_owned
        return self._image.x.array[:n] + self._owned_residual(self._load)

    def assemble_residual(self) -> Array:
        """Assemble F(u) at this rank's owned dofs, also if it is linear. Collective."""
        self._image.x.array[:] = 0.0
        with collective_errors(self._u.function_space.mesh.comm):
            for part in self._parts:
                part.assemble(self._image.x.array)
        self._image.x.scatter_reverse(dolfinx.la.InsertMode.add)
        return self._owned_residual(self._image)

    def is_inverted(self) -> bool:
        """Return whether det(I + grad u) ≤ 0 at a point of a nonlinear bulk. Collective.

        Many hyperelastic forms have spurious solutions there.
        """
        return self._volumes is not None and not self._volumes.find_minimum() > 0

    def _owned_residual(self, function: fem.Function) -> Array:
        """Return a residual at this rank's owned dofs in force units, a copy."""
        values = function.x.array[: self._n_owned]
        return values.copy() if self.units is None else values * self.units[: self._n_owned]

    def in_units(self, values: Array) -> Array:
        """Return values of the first dofs of this rank divided by their units, a copy."""
        return values.copy() if self.units is None else values / self.units[: values.size]

    def from_units(self, values: Array) -> Array:
        """Return values multiplied by the units of their dofs, a copy."""
        return values.copy() if self.units is None else values * self.units[: values.size]

    def _apply_units(self) -> None:
        """Scale `stiffness` by the units, which are measured the first time. Collective."""
        if self.units is None:
            units = fem.Function(self.space)
            units.x.array[:] = 1.0
            for _, dofs in self.displacement.others:
                units.x.array[dofs] = self._measure_unit(dofs)
            self.units = units.x.array
        self._scale_by_units(self.stiffness)

    def _measure_unit(self, dofs: Indices) -> float:
        """Return the unit of a field that makes its coupling to displacements `scale`. Collective.

        A field coupled only to other fields, or by round-off, is scaled by its diagonal block.
        """
        mask = np.zeros(self._n_owned)
        mask[dofs[dofs < self._n_owned]] = 1.0
        displacements = self.displacement.within(np.ones(self.displacement.n_owned))
        coupling = self._block_norm(mask, displacements)
        diagonal = self._block_norm(mask, mask)
        if coupling > NEGLIGIBLE * np.sqrt(self.scale * diagonal):
            unit = self.scale / coupling
        else:
            unit = np.sqrt(self.scale / diagonal) if diagonal > 0 else 1.0
        # A power of two scales without round-off.
        return float(2.0 ** np.round(np.log2(unit)))

    def _block_norm(self, rows: Array, columns: Array) -> float:
        """Return the infinity norm of a block of `stiffness`. Collective."""
        block = self.stiffness.copy()
        left, right = block.createVecLeft(), block.createVecRight()
        left.array[:], right.array[:] = rows, columns
        block.diagonalScale(left, right)
        size = float(block.norm(PETSc.NormType.NORM_INFINITY))
        for item in (block, left, right):
            item.destroy()
        return size

    def _scale_by_units(self, matrix: PETSc.Mat) -> None:
        """Scale rows and columns of a tangent by the units. Collective."""
        if self.units is not None:
            scaling = matrix.createVecLeft()
            scaling.array[:] = self.units[: self._n_owned]
            matrix.diagonalScale(scaling, scaling)
            scaling.destroy()

    def _is_symmetric(self, probe: PETSc.Vec) -> bool:
        """Compare products with the matrix and its transpose for one rough vector."""
        start, _ = probe.getOwnershipRange()
        probe.array[:] = np.cos(1.0 + 3.0 * (start + np.arange(probe.getLocalSize())) ** 1.5)
        image, mirrored = probe.duplicate(), probe.duplicate()
        self.stiffness.mult(probe, image)
        self.stiffness.multTranspose(probe, mirrored)
        size = image.norm()
        image.axpy(-1.0, mirrored)
        symmetric = image.norm() <= ROUND_OFF * size
        image.destroy()
        mirrored.destroy()
        return bool(symmetric)


class _Volumes:
    """det(I + grad u) at the points of a lattice of degree 2p in every cell, vertices included.

    For bilinear displacements it is extreme at the vertices of a straight quadrilateral, which
    Gauss points miss. The constructor is collective.
    """

    def __init__(self, displacement: Displacement) -> None:
        u, mesh = displacement.expression, displacement.u.function_space.mesh
        cell = mesh.basix_cell()
        points = basix.create_lattice(
            cell, 2 * displacement.degree, basix.LatticeType.equispaced, exterior=True
        )
        self._mesh = mesh
        self._cells = np.arange(
            mesh.topology.index_map(mesh.topology.dim).size_local, dtype=np.int32
        )
        self._change = compile_expression(ufl.det(ufl.Identity(len(u)) + ufl.grad(u)), points)

    def find_minimum(self) -> float:
        """Return the minimum at the present u over all ranks, NaN included. Collective."""
        values = self._change.eval(self._mesh, self._cells)
        return global_min(self._mesh.comm, values, empty=np.inf)


def _has_condition_on(form: ufl.Form, u: fem.Function) -> bool:
    """Return whether a form has a condition on ``u``.

    The derivative need not show it, as for a load that jumps from one constant to another.
    """
    expanded = ufl.algorithms.expand_derivatives(form)
    return any(
        isinstance(item, ufl.classes.Condition) and u in extract_coefficients(item)
        for integral in expanded.integrals()
        for item in unique_pre_traversal(integral.integrand())
    )


class _Part:
    """The integrals of F of one type, such as cells, compiled by quadrature rule.

    The constructor is collective.
    """

    def __init__(self, form: ufl.Form, kind: str, u: fem.Function) -> None:
        integrals = ufl.Form([i for i in form.integrals() if i.integral_type() == kind])
        self.is_empty = ufl.algorithms.expand_derivatives(
            integrals
        ).empty()  # a load that is 0 in UFL
        at_zero = ufl.replace(integrals, {u: ufl.zero(u.ufl_shape)})
        self._is_zero = ufl.algorithms.expand_derivatives(at_zero).empty()
        self._compiled = compile_by_quadrature_rule(integrals)
        self._u = u
        others = [c for c in integrals.coefficients() if c is not u]
        self._dependence = Dependence(integrals.constants(), others)
        self._at_zero: Array = np.zeros(u.x.array.size)

    def assemble(self, target: Array) -> None:
        """Add the integrals to ``target``, without summing up ghosts."""
        for part in self._compiled:
            fem.assemble_vector(target, part)

    def assemble_at_zero(self) -> Array:
        """Return the values at u = 0, without summing up ghosts, cached."""
        if self._is_zero:
            return self._at_zero
        if self._dependence.changed:
            self._dependence.forget()  # until the assembly is complete
            u = self._u.x.array
            saved = u.copy()
            u[:] = 0.0
            self._at_zero[:] = 0.0
            try:
                self.assemble(self._at_zero)
            finally:
                u[:] = saved
            self._dependence.note()
        return self._at_zero
