"""Stiffness in other measures than stress/length."""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real

__all__ = ["NodalSprings", "RelativeStiffness"]


@dataclass(frozen=True)
class RelativeStiffness:
    """A stiffness per area as a multiple of E/h, Young's modulus over the height of the cell there.

    E comes from the bulk form itself, h is the cell's height over its facet on Γc, so that the
    penetration is about 1/factor of the elastic displacement over the first layer of cells. Between
    two bodies E is that of the softer one, whichever has Γc.

    Args to the constructor:
        factor: The multiple; by default that of the contact's ``accuracy``, or 10.
    """

    factor: float | None = None

    def __post_init__(self) -> None:
        """Refuse a factor that is no positive number."""
        if self.factor is None:
            return
        if not (isinstance(self.factor, Real) and 0.0 < self.factor < float("inf")):
            raise ValueError(f"factor is {self.factor!r}; it must be a number greater than zero")


@dataclass(frozen=True)
class NodalSprings:
    """A stiffness as one spring for each node pair of Γc, the contact springs of section 4.

    At a vertex of Γc the stiffness per area is k over the area that the vertex stands for, the
    contact's weight included: the reactions of the vertex add up to k times its displacement,
    whatever the facets around it. Wants a surface with ``quadrature_scheme="vertex"``.

    Args to the constructor:
        k: Stiffness of one spring (force/length; per thickness in 2D without weight).
    """

    k: float

    def __post_init__(self) -> None:
        """Refuse a stiffness that is no positive number."""
        if not (isinstance(self.k, Real) and 0.0 < self.k < float("inf")):
            raise ValueError(
                f"k of the NodalSprings is {self.k!r}; it must be a number greater than zero "
                "(force/length of one node pair)"
            )
