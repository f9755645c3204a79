"""What one increment came to, in numbers and in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fenics_contact.checks.energy import Energy
from fenics_contact.checks.verdict import Attempt, Verdict
from fenics_contact.contact.values import Resultants
from fenics_contact.markup import shown
from fenics_contact.types import Array

__all__ = ["Step"]


# Of a vector's length, what of a component is the solver's tolerance.
_NOTHING = 1e-9


@dataclass(frozen=True)
class Step:
    """What one solve did.

    Attributes:
        increment: Number of the increment, from 1.
        reason: SNES reason of the last solve (positive: converged).
        iterations: SNES iterations in all, those on too few unknowns included.
        augmentations: Updates of the multipliers, the first solution included.
        method: The method that found the solution; see `ContactProblem`.
        factorisations: Sparse matrices factored; dense ones of a condensed problem do not count.
        verdict: The independent check.
        contacts: Resultants of every contact, by name.
        energy: Works and energies of the increment.
        attempts: Everything that was tried, in its order; the last is what found the solution.
        wall_seconds: Time of the solve on this rank.
        load: Load parameter, where `increments` set one.
        increment_error: Errors by the size of the increments so far, by quantity, where
            `increments` estimates them; see `ErrorBudget`.
        complete: Whether all of u is that of the increment; else `ContactProblem.complete` makes
            it so.
    """

    increment: int
    reason: int
    iterations: int
    augmentations: int
    method: str
    factorisations: int
    verdict: Verdict
    contacts: dict[str, Resultants]
    energy: Energy
    attempts: tuple[Attempt, ...]
    wall_seconds: float
    load: float | None = None
    increment_error: dict[str, float] | None = None
    complete: bool = True

    def summary(self) -> str:
        """One line for people.

        Of every contact "force" is ∫ -r_n, "friction ∫|τ|" the sum of the sizes over the points,
        and "resultant" the force on the body, in which tractions of opposite ways cancel. A contact
        whose forces are no more than the residual that passes has "no contact force"
        (`ForceBalance.is_loaded`): how many of its points stick or slip is round-off. What small
        displacements leave out is said from 1 % of force or pressure on. Where forces and areas are
        per unit thickness (`Resultants.per_thickness`) the line ends with these words.
        """
        parts = [f"increment {self.increment}"]
        if self.load is not None:
            parts.append(f"load {self.load:.6g}")
        parts.append(self._made())
        parts.append(self._residual())
        for name, r in self.contacts.items():
            if not self._is_loaded(name):
                parts.append(f"{name}: no contact force")
                continue
            normal, friction, resultant = self._forces(name)
            parts.append(
                f"{name}: force {normal}, friction ∫|τ| {friction}, resultant {resultant}, "
                f"area {r.area:.4g}, {r.stick} stick {r.slip} slip {r.open} open"
            )
        per_thickness = ["forces and areas per unit thickness"] * self._per_thickness
        return "; ".join([*parts, *self._left_out(), *per_thickness])

    def _left_out(self) -> list[str]:
        """What taking displacements as small leaves out of every contact, where it is notable."""
        found = self.verdict.kinematics.items()
        return [
            f"{name}: displacements are taken as small, else {left_out.describe()}"
            for name, left_out in found
            if left_out.is_notable
        ]

    @property
    def _per_thickness(self) -> bool:
        return any(r.per_thickness for r in self.contacts.values())

    def _residual(self) -> str:
        if not self.verdict.is_loaded:
            return "no forces"
        return f"residual {self.verdict.relative_residual:.1e} of the forces"

    def _is_loaded(self, contact: str) -> bool:
        return self.verdict.equations[contact].is_loaded

    def _forces(self, contact: str) -> tuple[str, str, str]:
        """Normal force, friction and resultant of a contact; 0 where it is not loaded."""
        r = self.contacts[contact]
        loaded = float(self._is_loaded(contact))
        normal, friction = (f"{loaded * f:.6g}" for f in (r.normal_force, r.tangential_force))
        return normal, friction, _components(loaded * r.force)

    def _made(self) -> str:
        """By which method, and in how many iterations."""
        if not self.iterations:
            return f"{self.method}: solved by its first guess"
        return f"{self.method}: {self.iterations} iteration{'s' if self.iterations > 1 else ''}"

    def _repr_html_(self) -> str:
        """The same as a table, for notebooks."""
        title = f"Increment {self.increment}"
        if self.load is not None:
            title += f", load {self.load:.6g}"
        header = ("contact", "∫ pressure", "friction ∫|τ|", "resultant on the body", "area")
        rows = [
            (
                name,
                *self._forces(name),
                f"{r.area:.4g}",
                *(str(n) if self._is_loaded(name) else "–" for n in (r.stick, r.slip, r.open)),
            )
            for name, r in self.contacts.items()
        ]
        remarks = [f"{self._made()}; {self._residual()}", *self._left_out()]
        remarks += ["Forces and areas are per unit thickness."] * self._per_thickness
        return shown(title, (*header, "stick", "slip", "open"), rows, remarks)


def _components(vector: Array) -> str:
    """In words; what is next to nothing beside the length is 0."""
    size = np.linalg.norm(vector)
    return "(" + ", ".join(f"{v if abs(v) > _NOTHING * size else 0:.6g}" for v in vector) + ")"
