"""A user-defined law: the pressure between rough surfaces grows exponentially with penetration."""

from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

PRESSURE, BOTTOM, TOP, LEFT = 10.0, 1, 2, 3  # MPa; facets


@dataclass(frozen=True)
class Rough(fc.Law):
    """Pressure p0 exp(δ/h) at the gap -δ; p0 in MPa, h in mm."""

    p0: float
    h: float

    def normal_potential(self, kinematics, parameters):
        """Return the energy per area, whose derivative with respect to δ is the pressure."""
        delta = -kinematics.gap
        return parameters["p0"] * parameters["h"] * ufl.exp(delta / parameters["h"])

    def contact_traction(self, kinematics, parameters):
        """Return the normal traction, without friction."""
        delta = -kinematics.gap
        pressure = parameters["p0"] * ufl.exp(delta / parameters["h"])
        return fc.ContactTraction(-pressure)


msh = mesh.create_unit_square(MPI.COMM_WORLD, 8, 8)
facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
x, y, _ = mesh.compute_midpoints(msh, 1, facets).T
where = np.select([np.isclose(y, 0), np.isclose(y, 1), np.isclose(x, 0)], [BOTTOM, TOP, LEFT])
tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))
V = fem.functionspace(msh, ("Lagrange", 1, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=msh, subdomain_data=tags)
F = fc.elasticity.LinearElastic(u, 2e5, 0.3, "plane stress").residual(v) + PRESSURE * v[1] * ds(TOP)
left = fem.locate_dofs_topological(V.sub(0), 1, tags.find(LEFT))
law, floor = Rough(p0=0.5, h=2e-3), fc.HalfSpace(point=(0, 0), normal=(0, 1))
contact = fc.Contact(u, fc.ContactSurface(msh, tags, BOTTOM), floor, law)
fc.ContactProblem(F, u, bcs=[fem.dirichletbc(0.0, left, V.sub(0))], contacts=[contact]).solve()
found, expected = -contact.gather()["gap"], law.h * np.log(PRESSURE / law.p0)
if msh.comm.rank == 0:
    print(f"closed up by {found.mean():.6g} mm; h ln(p/p0) = {expected:.6g} mm")
assert np.allclose(found, expected, rtol=1e-7)  # at every point; solver tolerance 1e-9
