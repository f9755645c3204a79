"""Signatures of UFL expressions: hashes that identify the code of a law or of an obstacle.

They are independent of process, rank, mesh and UFL's counters: laws and obstacles are evaluated
with named symbols, and hashed node by node. The data behind the symbols are compared elsewhere.
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

# Significant digits of numbers in an obstacle; further ones may be round-off.
_DIGITS = 12


class _Symbols:
    """Named symbols with fixed counts, by which UFL sorts the terms of a sum."""

    _FIRST_COUNT = 10_000  # counts of equal length sort in the same order as strings

    def __init__(self, gdim: int) -> None:
        """Create an abstract mesh of dimension ``gdim``."""
        cell = "triangle" if gdim == 2 else "tetrahedron"
        self._mesh = ufl.Mesh(basix.ufl.element("Lagrange", cell, 1, shape=(gdim,)))
        self.names: dict[Any, str] = {}

    def new(self, name: str, *shape: int) -> Any:
        """Create a symbol of a shape."""
        symbol = ufl.Constant(self._mesh, shape, count=self._FIRST_COUNT + len(self.names))
        self.names[symbol] = name
        return symbol


def signature_of_law(law: Law, gdim: int, *, multipliers: bool) -> str:
    """Return a hash of UFL expressions and properties of a law, without values of parameters."""
    symbols = _Symbols(gdim)
    kinematics = PointKinematics(
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
    response = law.contact_traction(kinematics, given)
    terms = [response.normal_traction, *response.slip]
    terms.append(law.stored(kinematics, response, given))
    if law.has_own_normal:
        terms += [law.normal_potential(kinematics, given), law.normal_stiffness(kinematics, given)]
    if law.has_tangential:
        terms += [response.traction, law.tangential_stiffness(kinematics, given)]
    if law.has_friction:
        traction, pressure = symbols.new("present traction", gdim), symbols.new("pressure")
        terms += [response.friction_bound, law.friction_bound(kinematics, pressure, given)]
        terms += law.yield_functions(kinematics, traction, pressure, given)
        terms += [law.elastic_displacement(kinematics, traction, given)]
        terms += [law.dissipated(kinematics, response, given)]
    kind = law.has_tension, law.has_potential, law.has_normal_stiffness, law.is_physical
    return _hash([*map(str, kind), *_hash_components(terms, symbols.names)])


def signature_of_obstacle(obstacle: Obstacle, gdim: int) -> str:
    """Return a hash of an obstacle's gap and direction, without values of its coefficients."""
    symbols = _Symbols(gdim)

    def to_ufl(value: Any) -> Any:
        if isinstance(value, ufl.core.expr.Expr):
            return value
        rounded = np.vectorize(lambda v: float(f"{v:.{_DIGITS}g}"), otypes=[float])(value)
        return ufl.as_ufl(float(rounded)) if rounded.ndim == 0 else ufl.as_tensor(rounded.tolist())

    placement = obstacle.placed(symbols.new("place", gdim), to_ufl)
    return _hash(_hash_components([placement.gap, placement.direction], symbols.names))


def _hash(parts: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


_ZERO = _hash(["0"])


def _hash_sum(terms: Sequence[str]) -> str:
    """Hash a sum of terms with these hashes, in any order."""
    nonzero = sorted(term for term in terms if term != _ZERO)
    return nonzero[0] if len(nonzero) == 1 else _hash(["Sum", *nonzero]) if nonzero else _ZERO


def _hash_components(expressions: Iterable[Any], names: dict[Any, str]) -> list[str]:
    """Return the hash of each component of expressions."""
    components, hashes = _Components(names), []
    for expression in expressions:
        plain = apply_algebra_lowering(ufl.as_ufl(expression))
        for node in unique_post_traversal(plain):  # bottom-up, to bound the recursion depth
            if isinstance(node, classes.Operator) and not node.ufl_shape:
                if not node.ufl_free_indices:
                    components.hash(node, (), {})
        for component in np.ndindex(plain.ufl_shape):
            hashes.append(components.hash(plain, component, {}))
    return hashes


class _Components:
    """Hashes of scalar components of tensors, with numbers for all indices.

    They are independent of how releases of UFL place indices and sort terms and factors.
    """

    def __init__(self, names: dict[Any, str]) -> None:
        """Store the names of symbols."""
        self._names = names
        self._cache: dict[Any, str] = {}

    def hash(self, node: Any, component: tuple[int, ...], bound: dict[int, int]) -> str:
        """Return the hash of a component, given the values of its free indices by their counts."""
        free = getattr(node, "ufl_free_indices", ())
        key = node, component, tuple(bound[i] for i in free)
        if key not in self._cache:
            self._cache[key] = self._compute_hash(node, component, bound)
        return self._cache[key]

    def _compute_hash(self, node: Any, component: tuple[int, ...], bound: dict[int, int]) -> str:
        operands = node.ufl_operands
        match node:
            case _ if node in self._names:
                return _hash([f"{self._names[node]} {component}"])
            case classes.Zero():
                return _ZERO
            case classes.ScalarValue():
                return _hash([f"{float(node):.15g}"])
            case classes.Identity():
                return _hash(["1"]) if component[0] == component[1] else _ZERO
            case classes.Variable():
                return self.hash(operands[0], component, bound)
            case classes.ListTensor():
                return self.hash(operands[component[0]], component[1:], bound)
            case classes.Indexed():
                at = (
                    int(i) if isinstance(i, FixedIndex) else bound[i.count()] for i in operands[1]
                )
                return self.hash(operands[0], tuple(at), bound)
            case classes.ComponentTensor():
                given = {i.count(): k for i, k in zip(operands[1], component, strict=True)}
                return self.hash(operands[0], (), bound | given)
            case classes.IndexSum():
                (index,) = operands[1]
                terms = [
                    self.hash(operands[0], (), bound | {index.count(): k})
                    for k in range(node.dimension())
                ]
                return _hash_sum(terms)
            case classes.Sum():
                return _hash_sum([self.hash(operand, component, bound) for operand in operands])
            case classes.Product():
                factors = [self.hash(operand, component, bound) for operand in operands]
                return _ZERO if _ZERO in factors else _hash(["Product", *sorted(factors)])
        parts = [f"{type(node).__name__} {getattr(node, 'ufl_shape', ())} {component}"]
        for operand in operands:
            shape = getattr(operand, "ufl_shape", ())
            inside = [component] if shape and shape == node.ufl_shape else np.ndindex(shape)
            parts += [self.hash(operand, at, bound) for at in inside]
        return _hash(parts)
