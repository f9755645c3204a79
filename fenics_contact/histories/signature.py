"""Signatures of UFL: a word that tells the code of a law or of an obstacle from other code.

It depends on neither process, rank, mesh nor on how many functions were made before: laws and
obstacles are written in symbols of their own, which have names, and are hashed node by node. What
the symbols stand for, the data, is compared by its values elsewhere.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from typing import Any

import basix.ufl
import numpy as np
import ufl
from ufl import classes
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.classes import FixedIndex
from ufl.corealg.traversal import unique_post_traversal

from fenics_contact.laws.base import Law, PointKinematics
from fenics_contact.obstacles.base import Obstacle

__all__ = ["signature_of_law", "signature_of_obstacle"]

# Digits of numbers in an obstacle, whose last ones may be round-off of where they come from.
_DIGITS = 12


class _Symbols:
    """Named symbols, numbered from one count on: UFL orders the terms of a sum by these."""

    _FIRST = 10_000  # all numbers have as many digits, by which UFL may order, too

    def __init__(self, gdim: int) -> None:
        """Take an abstract mesh of a dimension."""
        cell = "triangle" if gdim == 2 else "tetrahedron"
        self._mesh = ufl.Mesh(basix.ufl.element("Lagrange", cell, 1, shape=(gdim,)))
        self.names: dict[Any, str] = {}

    def new(self, name: str, *shape: int) -> Any:
        """A symbol of a shape."""
        symbol = ufl.Constant(self._mesh, shape, count=self._FIRST + len(self.names))
        self.names[symbol] = name
        return symbol


def signature_of_law(law: Law, gdim: int, *, multipliers: bool) -> str:
    """A word that differs where anything that a law says as UFL, or of its kind, differs.

    Args:
        law: The law; values of its parameters do not count.
        gdim: Dimension of space.
        multipliers: Whether it is enforced by multipliers.
    """
    symbols = _Symbols(gdim)
    felt = PointKinematics(
        symbols.new("gap"),
        symbols.new("normal", gdim),
        symbols.new("tangential displacement", gdim) if law.has_tangential else None,
        symbols.new("tangential increment", gdim) if law.has_friction else None,
        symbols.new("traction", gdim) if law.has_friction else None,
        symbols.new("multiplier") if multipliers else None,
    )
    given = {
        name: symbols.new(f"parameter {name}", *(gdim,) * (name == "direction"))
        for name in law.parameters()
    }
    response = law.contact_traction(felt, given)
    said = [response.normal_traction, *response.slip]
    said.append(law.stored(felt, response, given))
    if law.has_own_normal:
        said += [law.normal_potential(felt, given), law.normal_stiffness(felt, given)]
    if law.has_tangential:
        said += [response.traction, law.tangential_stiffness(felt, given)]
    if law.has_friction:
        traction, pressure = symbols.new("present traction", gdim), symbols.new("pressure")
        said += [response.friction_bound, law.friction_bound(felt, pressure, given)]
        said += law.yield_functions(felt, traction, pressure, given)
        said += [law.elastic_displacement(felt, traction, given)]
        said += [law.dissipated(felt, response, given)]
    kind = law.has_tension, law.has_potential, law.has_normal_stiffness, law.is_physical
    return _word([*map(str, kind), *_hashes(said, symbols.names)])


def signature_of_obstacle(obstacle: Obstacle, gdim: int) -> str:
    """A word that differs where gap or direction of an obstacle are other functions of the place.

    Args:
        obstacle: Of which numbers count by their values, constants and functions do not.
        gdim: Dimension of space.
    """
    symbols = _Symbols(gdim)

    def to_ufl(value: Any) -> Any:
        if isinstance(value, ufl.core.expr.Expr):
            return value
        rounded = np.vectorize(lambda v: float(f"{v:.{_DIGITS}g}"), otypes=[float])(value)
        return ufl.as_ufl(float(rounded)) if rounded.ndim == 0 else ufl.as_tensor(rounded.tolist())

    placement = obstacle.placed(symbols.new("place", gdim), to_ufl)
    return _word(_hashes([placement.gap, placement.direction], symbols.names))


def _word(parts: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


_ZERO = _word(["0"])


def _sum(terms: Sequence[str]) -> str:
    """Of a sum, by the hashes of its terms."""
    some = sorted(term for term in terms if term != _ZERO)
    return some[0] if len(some) == 1 else _word(["Sum", *some]) if some else _ZERO


def _hashes(expressions: Iterable[Any], names: dict[Any, str]) -> list[str]:
    """Of each component of expressions a hash."""
    components, found = _Components(names), []
    for expression in expressions:
        plain = apply_algebra_lowering(ufl.as_ufl(expression))
        for node in unique_post_traversal(plain):  # no chain is as deep as Python's stack
            if isinstance(node, classes.Operator) and not node.ufl_shape:
                if not node.ufl_free_indices:
                    components.hash(node, (), {})
        for place in np.ndindex(plain.ufl_shape):
            found.append(components.hash(plain, place, {}))
    return found


class _Components:
    """Hashes of scalar components of tensors, whose indices are all numbers.

    Releases of UFL differ in where they write an index, and order sums and products by numbers of
    the process: here there is no index, and terms and factors are sorted.
    """

    def __init__(self, names: dict[Any, str]) -> None:
        """Take the names of symbols."""
        self._names = names
        self._known: dict[Any, str] = {}

    def hash(self, node: Any, place: tuple[int, ...], bound: dict[int, int]) -> str:
        """Of the component at a place.

        Args:
            node: An expression without products of tensors.
            place: Its indices, as many as the expression has axes.
            bound: Values of its free indices, by their numbers.
        """
        free = getattr(node, "ufl_free_indices", ())
        key = node, place, tuple(bound[i] for i in free)
        if key not in self._known:
            self._known[key] = self._written(node, place, bound)
        return self._known[key]

    def _written(self, node: Any, place: tuple[int, ...], bound: dict[int, int]) -> str:
        operands = node.ufl_operands
        match node:
            case _ if node in self._names:
                return _word([f"{self._names[node]} {place}"])
            case classes.Zero():
                return _ZERO
            case classes.ScalarValue():
                return _word([f"{float(node):.15g}"])
            case classes.Identity():
                return _word(["1"]) if place[0] == place[1] else _ZERO
            case classes.Variable():
                return self.hash(operands[0], place, bound)
            case classes.ListTensor():
                return self.hash(operands[place[0]], place[1:], bound)
            case classes.Indexed():
                at = (
                    int(i) if isinstance(i, FixedIndex) else bound[i.count()] for i in operands[1]
                )
                return self.hash(operands[0], tuple(at), bound)
            case classes.ComponentTensor():
                given = {i.count(): k for i, k in zip(operands[1], place, strict=True)}
                return self.hash(operands[0], (), bound | given)
            case classes.IndexSum():
                (index,) = operands[1]
                terms = [
                    self.hash(operands[0], (), bound | {index.count(): k})
                    for k in range(node.dimension())
                ]
                return _sum(terms)
            case classes.Sum():
                return _sum([self.hash(operand, place, bound) for operand in operands])
            case classes.Product():
                factors = [self.hash(operand, place, bound) for operand in operands]
                return _ZERO if _ZERO in factors else _word(["Product", *sorted(factors)])
        parts = [f"{type(node).__name__} {getattr(node, 'ufl_shape', ())} {place}"]
        for operand in operands:
            shape = getattr(operand, "ufl_shape", ())
            inside = [place] if shape and shape == node.ufl_shape else np.ndindex(shape)
            parts += [self.hash(operand, at, bound) for at in inside]
        return _word(parts)
