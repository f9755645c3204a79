"""Contact stiffness relative to the elements, or per node."""

from __future__ import annotations

from dataclasses import dataclass

from fenics_contact.arguments import check_positive

__all__ = ["NodalSprings", "RelativeStiffness"]


@dataclass(frozen=True)
class RelativeStiffness:
    """A contact stiffness factor·E/h (stress/length), relative to the elements at Γc.

    `ContactProblem` measures Young's modulus E from the bulk form; h is the height of the cell over
    its facet on Γc. The penetration is then about 1/factor of the elastic displacement over the
    first layer of cells. Between two bodies E is that of the softer one.

    Args:
        factor: The multiple of E/h, > 0; by default that of the contact's `Accuracy`, or 10.

    Raises:
        ValueError: The factor is not a positive number.
    """

    factor: float | None = None

    def __post_init__(self) -> None:
        """Check that the factor is a positive number."""
        if self.factor is not None:
            check_positive("factor", self.factor)


@dataclass(frozen=True)
class NodalSprings:
    """A contact stiffness given as one spring per node of Γc.

    The stiffness per area at a vertex of Γc is k divided by the tributary area of the vertex,
    multiplied by the contact's weight: the nodal force is k times the displacement. It needs a
    `ContactSurface` with ``quadrature_scheme="vertex"``.

    Args:
        k: Stiffness of one spring, > 0 (force/length; in 2D without weight per thickness).

    Raises:
        ValueError: k is not a positive number.
    """

    k: float

    def __post_init__(self) -> None:
        """Check that the stiffness is a positive number."""
        what = "a number greater than zero (force/length of one node pair)"
        check_positive("k of the NodalSprings", self.k, what)
