"""The displacement field among the unknowns: all of them, or a part of a mixed function.

A displacement that is a part of a mixed function is copied to a function of its own. A sparse
matrix maps its dofs to those of the mixed function.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import basix
import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc
from ufl.algorithms import expand_derivatives

from fenics_contact.arguments import check_instance
from fenics_contact.compat import collapsed
from fenics_contact.types import Array, Indices

__all__ = ["Displacement", "check_kind"]

_SPLIT = "u, p = ufl.split(w)"
_MIXED = 'mixed_element([element("P", cell, 2, shape=(gdim,)), element("P", cell, 1)])'


class Displacement:
    """A displacement and the function of all unknowns.

    The constructor is collective.

    Args:
        u: A vector-valued Lagrange function, or such a part of a mixed function as returned by
            ``ufl.split``, to which bubble functions may be added.
        mesh: Mesh on which it must be defined; None: any.
        name: Name of the caller for error messages.

    Attributes:
        whole: Function of all unknowns.
        expression: The displacement as UFL, with bubble functions, differentiable by ``whole``.
        u: The displacement without bubble functions in a vector-valued Lagrange space: ``whole``
            itself, or a copy updated by `follow`.
        dofs: Dof of ``whole`` for every dof of ``u`` on this rank, ghosts included; None: the same.
        degree: Degree of the elements of ``u``.
        first: Index of its first component among those of ``whole``.

    Raises:
        ValueError: ``u`` is not a displacement on the mesh.
    """

    def __init__(self, u: Any, mesh: Any, name: str) -> None:
        self.expression = u
        self.dofs: Indices | None = None
        check_kind(u, name)
        if isinstance(u, fem.Function):
            self.whole = self.u = u
            self._part, self.first = None, 0
            _check_unmixed(u, name)
        else:
            self.whole, self._part = _parts(u, name)
            space, self.dofs = collapsed(self.whole.function_space.sub(self._part))
            self.u = fem.Function(space, name="u")
            before = ufl.split(self.whole)[: self._part]
            self.first = sum(int(np.prod(part.ufl_shape, dtype=int)) for part in before)
            self.update()
        self.degree = _degree(self.u, mesh or self.u.function_space.mesh, name)

    @classmethod
    def only(cls, whole: fem.Function, name: str) -> Displacement:
        """Find the only part of a function that can be a displacement. Collective.

        Raises:
            ValueError: No part or more than one can be a displacement.
        """
        if not is_mixed(whole.function_space):
            return cls(whole, None, name)
        found = []
        for part in ufl.split(whole):
            try:
                found.append(cls(part, None, name))
            except ValueError:
                continue
        if len(found) != 1:
            raise ValueError(
                f"{name}: u is in {whole.function_space.ufl_element()}, of which {len(found)} "
                f"parts can be a displacement; it must be exactly one, as in {_MIXED}"
            )
        return found[0]

    @property
    def is_mixed(self) -> bool:
        """Whether the displacement is a part of a mixed function."""
        return self.dofs is not None

    @property
    def n_owned(self) -> int:
        """Number of dofs of ``u`` owned by this rank."""
        return _n_owned(self.u)

    def is_same_part(self, other: Displacement) -> bool:
        """Return whether another displacement is the same part of the same function."""
        return self.whole is other.whole and self._part == other._part

    def is_undifferentiated_in(self, expression: Any) -> bool:
        """Return whether a UFL expression contains the displacement other than by its gradient."""
        symbols: list[Any] = [self.whole]
        if self._part is not None:
            symbols = [ufl.split(self.whole)[self._part]]
            symbols += symbols[0].ufl_operands  # components, as they are indexed
        pending, seen = [expand_derivatives(ufl.as_ufl(expression))], set()
        while pending:
            item = pending.pop()
            if item in symbols:
                return True
            if item not in seen and not isinstance(item, ufl.classes.Grad):
                pending += item.ufl_operands
            seen.add(item)
        return False

    def update(self) -> None:
        """Copy the present values of ``whole`` to ``u``."""
        if self.dofs is not None:
            self.u.x.array[:] = self.whole.x.array[self.dofs]

    def within(self, values: Array) -> Array:
        """Extend values at the owned dofs of ``u`` by zero to the owned dofs of ``whole``."""
        if self.dofs is None:
            return values
        found = np.zeros(_n_owned(self.whole))
        found[self.dofs[: values.size]] = values
        return found

    def vectors(self, values: Array) -> Array:
        """Restrict values at the owned dofs of ``whole`` to the nodes of ``u``, (n, gdim)."""
        owned = np.arange(self.n_owned) if self.dofs is None else self.dofs[: self.n_owned]
        return np.asarray(values[owned]).reshape(-1, self.u.function_space.dofmap.bs)

    def expand_columns(self, matrix: PETSc.Mat) -> PETSc.Mat:
        """Map the columns of a matrix from the dofs of ``u`` to those of ``whole``. Collective.

        The matrix itself is returned if these are the same.
        """
        return matrix if self.dofs is None else matrix.matMult(self._embedding)

    @cached_property
    def _embedding(self) -> PETSc.Mat:
        """Boolean matrix that restricts dofs of ``whole`` to those of ``u``."""
        assert self.dofs is not None
        n, index_map = self.n_owned, self.whole.function_space.dofmap.index_map
        columns = index_map.local_to_global(self.dofs[:n]).astype(PETSc.IntType)
        return PETSc.Mat().createAIJ(
            ((n, None), (index_map.size_local, None)),
            csr=(np.arange(n + 1, dtype=PETSc.IntType), columns, np.ones(n)),
            comm=self.whole.function_space.mesh.comm,
        )

    @cached_property
    def others(self) -> list[tuple[fem.FunctionSpace, Indices]]:
        """The other parts of ``whole``: collapsed spaces and their dofs. Collective once."""
        if self.dofs is None:
            return []
        space = self.whole.function_space
        return [collapsed(space.sub(i)) for i in range(space.num_sub_spaces) if i != self._part]


def is_mixed(space: fem.FunctionSpace) -> bool:
    """Return whether a space is that of a mixed element."""
    return bool(space.num_sub_spaces) and space.dofmap.index_map_bs == 1


def _n_owned(function: fem.Function) -> int:
    dofmap = function.function_space.dofmap
    return int(dofmap.index_map.size_local * dofmap.index_map_bs)


def check_kind(u: Any, name: str, advice: str = "") -> None:
    """Check that ``u`` is a function or UFL; ``advice`` ends the error message.

    Raises:
        ValueError: ``u`` is of another type, or a list of functions.
    """
    if isinstance(u, list | tuple):
        advice = (
            "several fields are solved for as one function of a mixed element, "
            f"w = fem.Function(fem.functionspace(mesh, {_MIXED})), of which {_SPLIT} are the parts"
        )
    if not isinstance(u, ufl.core.expr.Expr):
        check_instance(f"{name}: u", u, fem.Function, advice)


def _check_unmixed(u: fem.Function, name: str) -> None:
    """Check that ``u`` is neither a mixed function nor a subfunction of DOLFINx."""
    if u.function_space.component():
        raise ValueError(
            f"{name}: u is a part of a mixed function given by w.sub(i), on which derivatives with "
            f"respect to w do not depend; use {_SPLIT}"
        )
    if is_mixed(u.function_space):
        raise ValueError(
            f"{name}: u is in a mixed element, {u.function_space.ufl_element()}; give its "
            f"displacement, the u of {_SPLIT}, which must be vector-valued: {_MIXED}"
        )


def _parts(u: ufl.core.expr.Expr, name: str) -> tuple[fem.Function, int]:
    """Return the mixed function of a UFL displacement and the number of its part with a trace.

    Raises:
        ValueError: ``u`` is not a part of a mixed function, plus bubble functions.
    """
    found = [_part_of(term) for term in _terms(u)]
    wholes = {id(part[0]): part[0] for part in found if part is not None}
    if len(wholes) != 1 or None in found:
        raise ValueError(
            f"{name}: u is a {type(u).__name__}; it must be a Function, or the displacement of a "
            f"mixed function w, {_SPLIT}, to which bubble functions may be added"
        )
    (whole,) = wholes.values()
    element = whole.function_space.ufl_element()
    numbers = [part[1] for part in found if part is not None]
    traces = [i for i in numbers if not _is_bubble(element.sub_elements[i])]
    if len(traces) != 1:
        raise ValueError(
            f"{name}: u is a sum of {len(numbers)} parts of {element}, of which {len(traces)} are "
            "no bubble functions; it must be exactly one"
        )
    return whole, traces[0]


def _terms(u: Any) -> list[Any]:
    """Return the terms of a sum."""
    if not isinstance(u, ufl.algebra.Sum):
        return [u]
    return [term for operand in u.ufl_operands for term in _terms(operand)]


def _part_of(expression: Any) -> tuple[fem.Function, int] | None:
    """Return the mixed function and the number of its part; None for other expressions."""
    for whole in ufl.algorithms.extract_coefficients(expression):
        if isinstance(whole, fem.Function) and is_mixed(whole.function_space):
            parts = ufl.split(whole)
            if expression in parts:
                return whole, parts.index(expression)
    return None


def _is_bubble(element: Any) -> bool:
    """Return whether an element consists of bubble functions."""
    return element.basix_element.family == basix.ElementFamily.bubble


def _degree(u: fem.Function, mesh: Any, name: str) -> int:
    """Check that ``u`` is a displacement of ``mesh`` and return its element's degree."""
    gdim = mesh.geometry.dim
    if u.ufl_shape != (gdim,):
        raise ValueError(
            f"{name}: u has shape {u.ufl_shape}; a displacement on this mesh has shape ({gdim},): "
            f'make its space with functionspace(mesh, ("Lagrange", degree, ({gdim},)))'
        )
    if u.function_space.mesh is not mesh and u.function_space.mesh != mesh:
        raise ValueError(f"{name}: u is on another mesh than the contact surface; use the same")
    if u.x.array.dtype != np.float64:
        raise ValueError(
            f"{name}: u has values of type {u.x.array.dtype}; the mesh, its functions and PETSc "
            "must be in float64"
        )
    element = u.function_space.ufl_element()
    if u.function_space.dofmap.bs != gdim or element.pullback != ufl.identity_pullback:
        raise ValueError(
            f"{name}: u is in {element}; it must be in a vector-valued Lagrange space, "
            f'functionspace(mesh, ("Lagrange", degree, ({gdim},)))'
        )
    basis = u.function_space.element.basix_element
    if basis.family == basix.ElementFamily.custom:
        raise ValueError(
            f"{name}: u is in {element}, a custom or enriched element; make bubble functions a "
            "separate part, mixed_element([P1, bubbles, pressure]), and give the sum of "
            "both parts, u + b of u, b, p = ufl.split(w)"
        )
    if basis.family != basix.ElementFamily.P or basis.discontinuous or basis.degree < 1:
        raise ValueError(
            f"{name}: u is in {element}, of degree {basis.degree}; it must be continuous, a "
            "Lagrange element of degree 1 or higher"
        )
    return int(basis.degree)
