"""The displacement in what is solved for: all of it, or a part of a mixed function.

Contact is a matter of displacements alone, whatever else is solved for beside them. A displacement
that is a part of a mixed function has a function of its own here, which follows the mixed one, and
a sparse map takes its dofs to those of the whole.
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
    """A displacement, and the function that is solved for.

    The constructor is collective.

    Args:
        u: A vector-valued Lagrange function, or the part of a mixed one that is such, as
            ``ufl.split`` gives it; parts that are bubbles may be added.
        mesh: That it must live on; None: its own.
        name: Of who was given it, in messages.

    Attributes:
        whole: The function that is solved for.
        expression: The displacement as UFL, to be differentiated by ``whole``: that itself, or what
            ``ufl.split`` gives of it, with bubbles if there are any.
        u: The displacement as a function in a vector-valued Lagrange space of its own: ``whole``
            itself, or values taken over by `follow`, without bubbles.
        dofs: Of every dof of ``u`` on this rank, ghosts too, its number in ``whole``; None: the
            same.
        degree: Of the elements of ``u``.
        first: Number of its first component among those of ``whole``.

    Raises:
        ValueError: It is no displacement of the mesh.
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
            self.follow()
        self.degree = _degree(self.u, mesh or self.u.function_space.mesh, name)

    @classmethod
    def only(cls, whole: fem.Function, name: str) -> Displacement:
        """The one part of a function, mixed or not, that can be a displacement. Collective.

        Raises:
            ValueError: There is none, or more than one.
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
    def mixed(self) -> bool:
        """Whether it is a part of what is solved for, and not all."""
        return self.dofs is not None

    @property
    def n_owned(self) -> int:
        """Dofs of ``u`` that this rank owns."""
        return _n_owned(self.u)

    def same_part(self, other: Displacement) -> bool:
        """Whether another one is the same part of the same function."""
        return self.whole is other.whole and self._part == other._part

    def is_undifferentiated_in(self, expression: Any) -> bool:
        """Whether UFL has the displacement itself, and not its gradient alone."""
        own: list[Any] = [self.whole]
        if self._part is not None:
            own = [ufl.split(self.whole)[self._part]]
            own += own[0].ufl_operands  # components, as they are indexed
        rest, seen = [expand_derivatives(ufl.as_ufl(expression))], set()
        while rest:
            item = rest.pop()
            if item in own:
                return True
            if item not in seen and not isinstance(item, ufl.classes.Grad):
                rest += item.ufl_operands
            seen.add(item)
        return False

    def follow(self) -> None:
        """Take the present values of ``whole`` over into ``u``."""
        if self.dofs is not None:
            self.u.x.array[:] = self.whole.x.array[self.dofs]

    def within(self, values: Array) -> Array:
        """Of values at the owned dofs of ``u`` those at the owned dofs of ``whole``, else 0."""
        if self.dofs is None:
            return values
        found = np.zeros(_n_owned(self.whole))
        found[self.dofs[: values.size]] = values
        return found

    def vectors(self, values: Array) -> Array:
        """Of values at the owned dofs of ``whole`` those of ``u``, node by node, (n, gdim)."""
        owned = np.arange(self.n_owned) if self.dofs is None else self.dofs[: self.n_owned]
        return np.asarray(values[owned]).reshape(-1, self.u.function_space.dofmap.bs)

    def lifted(self, matrix: PETSc.Mat) -> PETSc.Mat:
        """A matrix over the dofs of ``u`` as one over those of ``whole``. Collective.

        Args:
            matrix: Its columns are dofs of ``u``. Returned itself if these are all.
        """
        return matrix if self.dofs is None else matrix.matMult(self._embedding)

    @cached_property
    def _embedding(self) -> PETSc.Mat:
        """One in the row of each dof of ``u``, at its number in ``whole``."""
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
        """The other parts of ``whole``: a space of its own, and its dofs' numbers. Collective.

        They are made when first asked for, by all ranks.
        """
        if self.dofs is None:
            return []
        space = self.whole.function_space
        return [collapsed(space.sub(i)) for i in range(space.num_sub_spaces) if i != self._part]


def is_mixed(space: fem.FunctionSpace) -> bool:
    """Whether a space is that of several fields."""
    return bool(space.num_sub_spaces) and space.dofmap.index_map_bs == 1


def _n_owned(function: fem.Function) -> int:
    dofmap = function.function_space.dofmap
    return int(dofmap.index_map.size_local * dofmap.index_map_bs)


def check_kind(u: Any, name: str, advice: str = "") -> None:
    """Refuse what is neither function nor UFL, with ``advice`` at the end of the message.

    Raises:
        ValueError: It says what it is, and where it is several functions what to do.
    """
    if isinstance(u, list | tuple):
        advice = (
            "several fields are solved for as one function of a mixed element, "
            f"w = fem.Function(fem.functionspace(mesh, {_MIXED})), of which {_SPLIT} are the parts"
        )
    if not isinstance(u, ufl.core.expr.Expr):
        check_instance(f"{name}: u", u, fem.Function, advice)


def _check_unmixed(u: fem.Function, name: str) -> None:
    """Refuse functions of several fields, and parts of them as DOLFINx gives them."""
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
    """The mixed function of a UFL displacement, and which of its parts has its trace.

    Raises:
        ValueError: It is no part of a mixed function, or a sum of other things than bubbles with
            it.
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
    """What a sum is of."""
    if not isinstance(u, ufl.algebra.Sum):
        return [u]
    return [term for operand in u.ufl_operands for term in _terms(operand)]


def _part_of(expression: Any) -> tuple[fem.Function, int] | None:
    """The mixed function and the number of its part that an expression is; None: it is none."""
    for whole in ufl.algorithms.extract_coefficients(expression):
        if isinstance(whole, fem.Function) and is_mixed(whole.function_space):
            parts = ufl.split(whole)
            if expression in parts:
                return whole, parts.index(expression)
    return None


def _is_bubble(element: Any) -> bool:
    """Whether the functions of an element vanish on the facets of cells, by its family."""
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
