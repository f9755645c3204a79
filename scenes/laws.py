"""Laws of a user's own: exponential overclosure, friction on it or with a bound, an adhesive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import ufl

import fenics_contact as fc
from fenics_contact.laws.return_maps import positive_part


@dataclass(frozen=True)
class Overclosure(fc.Law):
    """Pressure p0 exp(δ/h) at the overclosure δ = u_n - s: asperities that touch at a distance."""

    p0: Any
    h: Any

    @property
    def positive(self):
        """Both."""
        return frozenset({"p0", "h"})

    def pressure(self, closing, parameters):
        """p0 exp(δ/h)."""
        return parameters["p0"] * ufl.exp(closing / parameters["h"])

    def contact_traction(self, kinematics, parameters):
        """The pressure, nothing along Γc."""
        closing = -kinematics.gap
        pressure = self.pressure(closing, parameters)
        return fc.ContactTraction(-pressure)

    def normal_potential(self, kinematics, parameters):
        """∫ p dδ."""
        closing = -kinematics.gap
        return parameters["h"] * self.pressure(closing, parameters)


@dataclass(frozen=True)
class Bond(fc.Law):
    """An adhesive that pulls by k_n o exp(-o/h) at the opening o, and pushes by the same."""

    k_n: Any
    h: Any

    @property
    def has_tension(self):
        """It pulls."""
        return True

    @property
    def positive(self):
        """Both."""
        return frozenset({"k_n", "h"})

    @property
    def strength(self):
        """The largest pull, at o = h."""
        return self.k_n * self.h * math.exp(-1)

    def contact_traction(self, kinematics, parameters):
        """The pull, nothing along Γc."""
        opening = kinematics.gap
        pull = parameters["k_n"] * opening * ufl.exp(-opening / parameters["h"])
        return fc.ContactTraction(pull)

    def normal_potential(self, kinematics, parameters):
        """∫ pull do."""
        k_n, h = parameters["k_n"], parameters["h"]
        opening = kinematics.gap
        return -k_n * h * (h + opening) * ufl.exp(-opening / h)


@dataclass(frozen=True)
class Asperities(fc.FrictionLaw):
    """Coulomb's friction on a pressure p0 (exp(δ/h) - 1) of the penetration δ alone."""

    friction: Any
    p0: Any
    h: Any
    k_t: Any

    @property
    def positive(self):
        """All but friction."""
        return frozenset({"p0", "h", "k_t"})

    def contact_traction(self, kinematics, parameters):
        """The pressure, and friction up to μ times it."""
        penetration = positive_part(-kinematics.gap)
        pressure = parameters["p0"] * (ufl.exp(penetration / parameters["h"]) - 1)
        bound = self.friction_bound(kinematics, pressure, parameters)
        traction, slip = self.return_map(kinematics, bound, parameters)
        return fc.ContactTraction(-pressure, traction, bound, slip)

    def normal_potential(self, kinematics, parameters):
        """∫ p dδ."""
        p0, h = parameters["p0"], parameters["h"]
        penetration = positive_part(-kinematics.gap)
        return p0 * h * (ufl.exp(penetration / h) - 1) - p0 * penetration


@dataclass(frozen=True)
class Saturating(fc.FrictionLaw):
    """Friction that a weak layer bounds: τ ≤ s (1 - exp(-μ p/s)), nearly Coulomb's for p ≪ s/μ."""

    friction: Any
    strength: Any
    k_n: Any
    k_t: Any

    def friction_bound(self, kinematics, pressure, parameters):
        """The bound."""
        s = parameters["strength"]
        return s * (1 - ufl.exp(-parameters["friction"] * pressure / s))

    def contact_traction(self, kinematics, parameters):
        """Unilateral contact, and friction up to the bound."""
        pressure = parameters["k_n"] * positive_part(-kinematics.gap)
        bound = self.friction_bound(kinematics, pressure, parameters)
        traction, slip = self.return_map(kinematics, bound, parameters)
        slip = tuple(ufl.conditional(ufl.gt(pressure, 0), mode, 0) for mode in slip)
        return fc.ContactTraction(-pressure, traction, bound, slip)
