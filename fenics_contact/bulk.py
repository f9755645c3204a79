"""The user's bulk form as a map u -> F(u) with a tangent, treated once where it is linear."""

from __future__ import annotations

import dolfinx.fem.petsc
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.parallel import collective_errors, global_max

__all__ = ["Bulk"]

Array = npt.NDArray[np.float64]


class Bulk:
    """The bulk residual F(u; v), without contact.

    Attributes:
        form: The residual, UFL.
        tangent_form: Its derivative by ``u``, UFL.
        linear: Whether F is affine in ``u``: then its tangent is assembled once, a residual is a
            product with it, and loads are assembled once an increment.
        symmetric: Whether the assembled tangent is symmetric.
        stiffness: The tangent without Dirichlet conditions, valid after `update`.
        scale: Largest entry on the tangent's diagonal, the unit of stiffness (force/length).
    """

    def __init__(self, form: ufl.Form, u: fem.Function) -> None:
        """Differentiate and compile. Collective.

        Raises:
            ValueError: ``form`` is no residual in the space of ``u``.
        """
        if not isinstance(form, ufl.Form):
            raise ValueError(
                f"F is a {type(form).__name__}; it must be the UFL residual of the bulk, such as "
                "inner(sigma(u), epsilon(v))*dx - inner(load, v)*ds"
            )
        arguments = form.arguments()
        if len(arguments) != 1:
            raise ValueError(
                f"F has {len(arguments)} arguments; it must be a residual in one TestFunction and "
                "the Function u: replace a TrialFunction by u"
            )
        space = arguments[0].ufl_function_space()
        if space != u.function_space:
            raise ValueError("the TestFunction of F and u are of different function spaces")
        if u not in form.coefficients():
            raise ValueError(
                "F does not depend on u: write the residual with the Function u itself"
            )
        self._u = u
        self.form = form
        derivative = ufl.derivative(form, u, ufl.TrialFunction(u.function_space))
        self.tangent_form = ufl.algorithms.expand_derivatives(derivative)
        self.linear = u not in self.tangent_form.coefficients()
        self._compiled = compat.compile_form(form)
        self._compiled_tangent = compat.compile_form(self.tangent_form)
        self.stiffness: PETSc.Mat = fem.petsc.create_matrix(self._compiled_tangent)
        self.symmetric = True
        self.scale = 0.0
        self._load = fem.Function(u.function_space)  # F(0)
        self._image = fem.Function(u.function_space)
        self._fingerprint: Array | None = None

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
                if not np.isfinite(global_max(comm, np.abs(array))):
                    name = "u" if item is self._u else getattr(item, "name", f"number {position}")
                    raise ValueError(
                        f"the {kind} {name!r} in F has values that are not finite (NaN or inf); "
                        "check what set it"
                    )

    def update(self) -> bool:
        """Assemble the tangent at ``u`` if it may have changed; True if it did. Collective."""
        if self.linear:
            fingerprint = self._tangent_data()
            same = self._fingerprint is not None and np.array_equal(fingerprint, self._fingerprint)
            if self._u.function_space.mesh.comm.allreduce(not same) == 0:
                return False
        self._fingerprint = None  # until the matrix is complete
        self.stiffness.zeroEntries()
        fem.petsc.assemble_matrix(self.stiffness, self._compiled_tangent)
        self.stiffness.assemble()
        diagonal = self.stiffness.getDiagonal()
        self.scale = diagonal.norm(PETSc.NormType.NORM_INFINITY)
        self.symmetric = self._is_symmetric(diagonal)
        diagonal.destroy()
        if self.linear:
            self._fingerprint = fingerprint
        return True

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
        """Assemble F(0), minus the external forces, at this rank's owned dofs. Collective."""
        u = self._u.x.array
        saved = u.copy()
        u[:] = 0.0
        try:
            self._assemble(self._load)
        finally:
            u[:] = saved
        return self._owned(self._load)

    def residual(self) -> Array:
        """F(u) at this rank's owned dofs; a linear bulk needs `update_load` before. Collective."""
        if not self.linear:
            return self.assemble_residual()
        self.stiffness.mult(self._u.x.petsc_vec, self._image.x.petsc_vec)
        return self._owned(self._image) + self._owned(self._load)

    def assemble_residual(self) -> Array:
        """F(u) by assembly, whatever the bulk. Collective."""
        self._assemble(self._image)
        return self._owned(self._image).copy()

    def _assemble(self, target: fem.Function) -> None:
        target.x.array[:] = 0.0
        with collective_errors(self._u.function_space.mesh.comm):
            fem.assemble_vector(target.x.array, self._compiled)
        target.x.scatter_reverse(dolfinx.la.InsertMode.add)

    def _owned(self, function: fem.Function) -> Array:
        dofmap = function.function_space.dofmap
        return function.x.array[: dofmap.index_map.size_local * dofmap.index_map_bs]

    def _tangent_data(self) -> Array:
        """All numbers the tangent depends on, to see whether the user changed one."""
        values = [np.ravel(c.value) for c in self.tangent_form.constants()]
        values += [f.x.array for f in self.tangent_form.coefficients()]
        return np.concatenate(values) if values else np.zeros(0)

    def _is_symmetric(self, probe: PETSc.Vec) -> bool:
        """Compare products with the matrix and its transpose for one rough vector."""
        start, _ = probe.getOwnershipRange()
        probe.array[:] = np.cos(1.0 + 3.0 * (start + np.arange(probe.getLocalSize())) ** 1.5)
        image, mirrored = probe.duplicate(), probe.duplicate()
        self.stiffness.mult(probe, image)
        self.stiffness.multTranspose(probe, mirrored)
        size = image.norm()
        image.axpy(-1.0, mirrored)
        symmetric = image.norm() <= 1e-10 * size
        image.destroy()
        mirrored.destroy()
        return bool(symmetric)
