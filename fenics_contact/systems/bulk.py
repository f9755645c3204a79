"""The user's bulk form as a map u -> F(u) with a tangent, treated once where it is linear.

Of a mixed function the parts beside the displacement, such as pressures, are counted in units of
their own: with them they are lengths, and their equations forces, as large as those of
displacements. So all that is judged by forces, or scaled by stiffness, can be.
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

from fenics_contact.compiling import compile_by_rule, compile_expression, compile_form
from fenics_contact.parallel import all_finite, collective_errors, global_max, global_min
from fenics_contact.surface.dependence import Dependence
from fenics_contact.surface.displacement import Displacement
from fenics_contact.systems.measures import check_measures, share_subdomain_data
from fenics_contact.tolerances import NEGLIGIBLE, ROUND_OFF
from fenics_contact.types import Array, Indices

__all__ = ["Bulk"]

_OF_ONE = (
    "; several fields must be one function w of a mixed element, whose residual has the "
    "test functions v, q = ufl.TestFunctions(W)"
)


class Bulk:
    """The bulk residual F(u; v), without contact. The constructor is collective.

    Attributes:
        form: The residual, UFL, with one object of tags for each kind of measure.
        space: Of ``u``.
        displacement: What of ``u`` is one.
        units: Of every dof of this rank, ghosts too: values over units are what all others see, and
            residuals times units; None: all are 1. They stay as they are from the first `update`.
        tangent_form: Its derivative by ``u``, UFL.
        linear: Whether F is affine in ``u``: then its tangent is assembled once, a residual is a
            product with it, and loads are assembled once an increment.
        symmetric: Whether the assembled tangent is symmetric.
        stiffness: The tangent without Dirichlet conditions, valid after `update`.
        scale: Largest entry on the tangent's diagonal, the unit of stiffness (force/length); of a
            nonlinear bulk on that of the first tangent, so that it is one unit all the way.

    Raises:
        ValueError: ``form`` is no residual in the space of ``u``.
    """

    def __init__(self, form: ufl.Form, displacement: Displacement) -> None:
        u = displacement.whole
        if not isinstance(form, ufl.Form):
            raise ValueError(
                f"F is a {type(form).__name__}; it must be the UFL residual of the bulk, such as "
                "inner(sigma(u), epsilon(v))*dx - inner(load, v)*ds"
                + (_OF_ONE if isinstance(form, list | tuple) else "")
            )
        arguments = form.arguments()
        if any(argument.part() is not None for argument in arguments):
            raise ValueError(f"F has test functions of several spaces{_OF_ONE}")
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
                + ("; use v, q = ufl.TestFunctions(W) of its space W" if displacement.mixed else "")
            )
        if u not in form.coefficients():
            raise ValueError(
                "F does not depend on u: write the residual with the Function u itself"
                + (", with the parts of ufl.split(w)" if displacement.mixed else "")
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
        self.linear = not (u in self.tangent_form.coefficients() or _branches_by(form, u))
        self._volumes = None if self.linear else _Volumes(displacement)
        kinds = dict.fromkeys(integral.integral_type() for integral in form.integrals())
        parts = (_Part(form, kind, u) for kind in kinds)
        self._parts = [part for part in parts if not part.empty]
        self._compiled_tangent = compile_by_rule(self.tangent_form)
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
        # What the tangent at rest depends on.
        data = [c for c in tangent.coefficients() if c is not u]
        self._data = Dependence(tangent.constants(), data)

    def check_finite(self) -> None:
        """Refuse values that are not finite in any coefficient or constant. Collective.

        Raises:
            ValueError: It names the coefficient.
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
        """Whether the tangent is that of the present data: False if it may differ. Collective."""
        if not self.linear:
            return False
        changed = self._dependence.changed
        return self._u.function_space.mesh.comm.allreduce(int(changed)) == 0

    def update(self) -> bool:
        """Assemble the tangent at ``u`` if it may have changed; True if it did. Collective."""
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
        if self.displacement.mixed:
            self._take_units()
            diagonal.destroy()
            diagonal = self.stiffness.getDiagonal()
        self.symmetric = self._is_symmetric(diagonal)
        diagonal.destroy()
        if self.linear:
            self._dependence.note()
        return True

    @contextmanager
    def present_stiffness(self) -> Iterator[PETSc.Mat]:
        """The tangent at the present ``u`` and data; `stiffness` stays as it is. Collective."""
        if self.is_current():
            yield self.stiffness
            return
        matrix = fem.petsc.create_matrix(self._pattern)
        self._assemble_tangent(matrix)
        self._in_units(matrix)
        try:
            yield matrix
        finally:
            matrix.destroy()

    def _assemble_tangent(self, matrix: PETSc.Mat) -> None:
        """Add the tangent at the present ``u`` to a matrix of its pattern. Collective."""
        for part in self._compiled_tangent:
            fem.petsc.assemble_matrix(matrix, part)
        matrix.assemble()

    @contextmanager
    def stiffness_at_rest(self) -> Iterator[PETSc.Mat]:
        """The tangent at u = 0 with the present data; `stiffness` stays as it is. Collective."""
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
        """Whether data of the tangent have changed since `note_data` was called. Collective."""
        return self.space.mesh.comm.allreduce(int(self._data.changed)) > 0

    def note_data(self) -> None:
        """Take the data of the tangent as they are now for known."""
        self._data.note()

    def own_stiffness(self) -> PETSc.Mat:
        """The tangent of this rank's cells alone, ghosts behind its own dofs. Collective.

        On one rank that is `stiffness`, and otherwise a new matrix: the ranks' add up to it.
        """
        if self.space.mesh.comm.size == 1:
            return self.stiffness
        # Entries of rows of ghosts are still here, not where their owners would add them up.
        matrix = fem.create_matrix(self._pattern)
        for part in self._compiled_tangent:
            fem.assemble_matrix(matrix, part)
        rows = matrix.to_scipy(ghosted=True).tocsr()
        rows.sort_indices()
        csr = (rows.indptr.astype(PETSc.IntType), rows.indices.astype(PETSc.IntType), rows.data)
        return PETSc.Mat().createAIJ(rows.shape, csr=csr, comm=PETSc.COMM_SELF)

    def check_elastic(self) -> None:
        """Refuse a tangent without stiffness, after `update`.

        Raises:
            ValueError: It says what was found.
        """
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(
                f"the largest entry on the diagonal of the bulk stiffness is {self.scale:g}: F has "
                "no elastic part, or a modulus is zero or not finite"
            )

    def update_load(self) -> Array:
        """F(0), minus the external forces, at this rank's owned dofs. Collective."""
        with collective_errors(self._u.function_space.mesh.comm):
            self._load.x.array[:] = sum(part.at_rest() for part in self._parts)
        self._load.x.scatter_reverse(dolfinx.la.InsertMode.add)
        return self._owned(self._load)

    def residual(self) -> Array:
        """F(u) at this rank's owned dofs; a linear bulk needs `update_load` before. Collective."""
        if not self.linear:
            return self.assemble_residual()
        state = self._u
        if self.units is not None:
            state = self._state
            state.x.array[:] = self._u.x.array / self.units
        self.stiffness.mult(state.x.petsc_vec, self._image.x.petsc_vec)
        n = self._n_owned
        return self._image.x.array[:n] + self._owned(self._load)

    def assemble_residual(self) -> Array:
        """F(u) by assembly, whatever the bulk. Collective."""
        self._image.x.array[:] = 0.0
        with collective_errors(self._u.function_space.mesh.comm):
            for part in self._parts:
                part.assemble(self._image.x.array)
        self._image.x.scatter_reverse(dolfinx.la.InsertMode.add)
        return self._owned(self._image)

    def is_inverted(self) -> bool:
        """Whether cells are turned inside out by ``u``. Collective.

        That is det(I + grad u) ≤ 0 at a point of the bulk: many forms of hyperelastic bodies have
        solutions there. With a linear bulk displacements are small, and nothing is looked at.
        """
        return self._volumes is not None and not self._volumes.least() > 0

    def _owned(self, function: fem.Function) -> Array:
        """A residual at this rank's owned dofs, by its unit; a copy."""
        values = function.x.array[: self._n_owned]
        return values.copy() if self.units is None else values * self.units[: self._n_owned]

    def in_units(self, values: Array) -> Array:
        """Values of ``u`` at dofs of this rank, from the first on, as all others see them; a copy.

        The other way round: `from_units`.
        """
        return values.copy() if self.units is None else values / self.units[: values.size]

    def from_units(self, values: Array) -> Array:
        """The inverse of `in_units`."""
        return values.copy() if self.units is None else values * self.units[: values.size]

    def _take_units(self) -> None:
        """Measure the units, the first time, and put `stiffness` in them. Collective."""
        if self.units is None:
            units = fem.Function(self.space)
            units.x.array[:] = 1.0
            for _, dofs in self.displacement.others:
                units.x.array[dofs] = self._unit(dofs)
            self.units = units.x.array
        self._in_units(self.stiffness)

    def _unit(self, dofs: Indices) -> float:
        """Of a part: with it what couples it to displacements is as stiff as these. Collective.

        A part that is coupled to others alone, or by round-off as bubbles are, is as stiff in
        itself.
        """
        mask = np.zeros(self._n_owned)
        mask[dofs[dofs < self._n_owned]] = 1.0
        displacements = self.displacement.within(np.ones(self.displacement.n_owned))
        coupling = self._block_size(mask, displacements)
        own = self._block_size(mask, mask)
        if coupling > NEGLIGIBLE * np.sqrt(self.scale * own):
            unit = self.scale / coupling
        else:
            unit = np.sqrt(self.scale / own) if own > 0 else 1.0
        # A power of two, by which no digit is lost: a file has values, and a state is by units.
        return float(2.0 ** np.round(np.log2(unit)))

    def _block_size(self, rows: Array, columns: Array) -> float:
        """Largest sum of absolute values in a row of a block of `stiffness`. Collective."""
        block = self.stiffness.copy()
        left, right = block.createVecLeft(), block.createVecRight()
        left.array[:], right.array[:] = rows, columns
        block.diagonalScale(left, right)
        size = float(block.norm(PETSc.NormType.NORM_INFINITY))
        for item in (block, left, right):
            item.destroy()
        return size

    def _in_units(self, matrix: PETSc.Mat) -> None:
        """Put a tangent in the units. Collective."""
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
    """Change of volume det(I + grad u) at the points of a lattice of degree 2p in every cell.

    The vertices of the cell are among them. There det(I + grad u) of bilinear displacements, which
    varies linearly over a straight quadrilateral, is extreme; points inside alone, as those of a
    Gauss rule, do not show a corner that is turned inside out. The constructor is collective.
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

    def least(self) -> float:
        """At the present u, over all ranks; NaN where it is none. Collective."""
        values = self._change.eval(self._mesh, self._cells)
        return global_min(self._mesh.comm, values, empty=np.inf)


def _branches_by(form: ufl.Form, u: fem.Function) -> bool:
    """Whether there is a condition on ``u`` in a form, which its derivative need not show.

    A load that steps from one constant to another has none.
    """
    expanded = ufl.algorithms.expand_derivatives(form)
    return any(
        isinstance(item, ufl.classes.Condition) and u in extract_coefficients(item)
        for integral in expanded.integrals()
        for item in unique_pre_traversal(integral.integrand())
    )


class _Part:
    """The integrals of F of one kind: over cells, over exterior facets ...

    Taken apart no further but by rules, so that every integral keeps the one that it has in F. The
    constructor is collective.
    """

    def __init__(self, form: ufl.Form, kind: str, u: fem.Function) -> None:
        mine = ufl.Form([i for i in form.integrals() if i.integral_type() == kind])
        self.empty = ufl.algorithms.expand_derivatives(mine).empty()  # a load that is 0 in UFL
        still = ufl.replace(mine, {u: ufl.zero(u.ufl_shape)})
        self._vanishes = ufl.algorithms.expand_derivatives(still).empty()
        self._compiled = compile_by_rule(mine)
        self._u = u
        others = [c for c in mine.coefficients() if c is not u]
        self._dependence = Dependence(mine.constants(), others)
        self._at_rest: Array = np.zeros(u.x.array.size)

    def assemble(self, target: Array) -> None:
        """Add to ``target``, ghosts not collected."""
        for part in self._compiled:
            fem.assemble_vector(target, part)

    def at_rest(self) -> Array:
        """Values at u = 0, ghosts not collected; assembled if they may have changed."""
        if self._vanishes:
            return self._at_rest
        if self._dependence.changed:
            self._dependence.forget()  # until the assembly is complete
            u = self._u.x.array
            saved = u.copy()
            u[:] = 0.0
            self._at_rest[:] = 0.0
            try:
                self.assemble(self._at_rest)
            finally:
                u[:] = saved
            self._dependence.note()
        return self._at_rest
