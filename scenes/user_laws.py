"""User-defined laws: exponential overclosure, friction on it or with a bound, an adhesive."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import ufl

import fenics_contact as fc
from fenics_contact.laws.return_maps import positive_part


@dataclass(frozen=True)
class Overclosure(fc.Law):
    """Pressure p0 exp(δ/h) of asperities at the overclosure δ = -g_N, also at positive gaps."""

    p0: Any
    h: Any

    @property
    def positive(self):
        """The names of the positive parameters, p0 and h."""
        return frozenset({"p0", "h"})

    def pressure(self, closing, parameters):
        """Return the pressure p0 exp(δ/h)."""
        return parameters["p0"] * ufl.exp(closing / parameters["h"])

    def contact_traction(self, kinematics, parameters):
        """Return the pressure without a tangential traction."""
        closing = -kinematics.gap
        pressure = self.pressure(closing, parameters)
        return fc.ContactTraction(-pressure)

    def normal_potential(self, kinematics, parameters):
        """Return the potential ∫ p dδ."""
        closing = -kinematics.gap
        return parameters["h"] * self.pressure(closing, parameters)


@dataclass(frozen=True)
class Adhesive(fc.Law):
    """An adhesive with the normal traction k_n o exp(-o/h) at the opening or penetration o."""

    k_n: Any
    h: Any

    @property
    def has_tension(self):
        """Whether the law has tension: yes."""
        return True

    @property
    def positive(self):
        """The names of the positive parameters, k_n and h."""
        return frozenset({"k_n", "h"})

    @property
    def strength(self):
        """The largest tension, at o = h."""
        return self.k_n * self.h * math.exp(-1)

    def contact_traction(self, kinematics, parameters):
        """Return the tension without a tangential traction."""
        opening = kinematics.gap
        pull = parameters["k_n"] * opening * ufl.exp(-opening / parameters["h"])
        return fc.ContactTraction(pull)

    def normal_potential(self, kinematics, parameters):
        """Return the potential, the integral of the tension over the opening."""
        k_n, h = parameters["k_n"], parameters["h"]
        opening = kinematics.gap
        return -k_n * h * (h + opening) * ufl.exp(-opening / h)


@dataclass(frozen=True)
class AsperityFriction(fc.FrictionLaw):
    """Coulomb friction with the pressure p0 (exp(δ/h) - 1) at the penetration δ ≥ 0."""

    friction: Any
    p0: Any
    h: Any
    k_t: Any

    @property
    def positive(self):
        """The names of the positive parameters: all but the friction coefficient."""
        return frozenset({"p0", "h", "k_t"})

    def contact_traction(self, kinematics, parameters):
        """Return the pressure, and friction up to μ times the pressure."""
        penetration = positive_part(-kinematics.gap)
        pressure = parameters["p0"] * (ufl.exp(penetration / parameters["h"]) - 1)
        bound = self.friction_bound(kinematics, pressure, parameters)
        traction, slip = self.return_map(kinematics, bound, parameters)
        return fc.ContactTraction(-pressure, traction, bound, slip)

    def normal_potential(self, kinematics, parameters):
        """Return the potential ∫ p dδ."""
        p0, h = parameters["p0"], parameters["h"]
        penetration = positive_part(-kinematics.gap)
        return p0 * h * (ufl.exp(penetration / h) - 1) - p0 * penetration


@dataclass(frozen=True)
class SaturatingFriction(fc.FrictionLaw):
    """Friction with the saturating bound s (1 - exp(-μ p/s)), nearly Coulomb's for p ≪ s/μ."""

    friction: Any
    strength: Any
    k_n: Any
    k_t: Any

    def friction_bound(self, kinematics, pressure, parameters):
        """Return the bound s (1 - exp(-μ p/s)) of the tangential traction."""
        s = parameters["strength"]
        return s * (1 - ufl.exp(-parameters["friction"] * pressure / s))

    def contact_traction(self, kinematics, parameters):
        """Return the traction of unilateral contact with friction up to the bound."""
        pressure = parameters["k_n"] * positive_part(-kinematics.gap)
        bound = self.friction_bound(kinematics, pressure, parameters)
        traction, slip = self.return_map(kinematics, bound, parameters)
        slip = tuple(ufl.conditional(ufl.gt(pressure, 0), mode, 0) for mode in slip)
        return fc.ContactTraction(-pressure, traction, bound, slip)
