"""A block is dragged along a floor with slip-strengthening friction, against a closed form."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc


@dataclass(frozen=True)
class Strengthening(fc.Coulomb):
    """A friction coefficient μ + a |Δu_t| that depends on the slip distance of the increment."""

    rate: Any = 0.0  # a, 1/mm

    def friction_bound(self, kinematics, pressure, parameters):
        """Return the size of the yield surface (stress)."""
        slip = kinematics.tangential_increment
        distance = ufl.sqrt(ufl.dot(slip, slip) + 1e-16)  # the root has no derivative at 0
        return (parameters["friction"] + parameters["rate"] * distance) * pressure


E, WEIGHT, PULL, BOTTOM, TOP = 1e6, 1.0, 0.4, 1, 2  # MPa; N/mm on a length of 1 mm
msh = mesh.create_rectangle(MPI.COMM_WORLD, [(0, 0), (1, 0.1)], (8, 1), mesh.CellType.quadrilateral)
facets = mesh.locate_entities_boundary(
    msh, 1, lambda x: np.isclose(x[1], 0) | np.isclose(x[1], 0.1)
)
y = mesh.compute_midpoints(msh, 1, facets)[:, 1]
sides = np.select([np.isclose(y, 0), np.isclose(y, 0.1)], [BOTTOM, TOP], 0)  # 0: the ends
tags = mesh.meshtags(msh, 1, facets, sides.astype(np.int32))
V = fem.functionspace(msh, ("Lagrange", 1, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
ds = ufl.Measure("ds", domain=msh, subdomain_data=tags)
F = fc.elasticity.LinearElastic(u, E, 0.3, "plane stress").residual(v)
F -= (PULL * v[0] - WEIGHT * v[1]) * ds(TOP)
law, floor = Strengthening(friction=0.3, rate=2.0), fc.HalfSpace(point=(0, 0), normal=(0, 1))
contact = fc.Contact(u, fc.ContactSurface(msh, tags, BOTTOM), floor, law)
problem = fc.ContactProblem(F, u, contacts=[contact])
problem.solve()
problem.commit()
force = contact.resultants().force
found, expected = contact.gather()["slip"], (PULL / WEIGHT - 0.3) / law.rate
if msh.comm.rank == 0:
    print(f"dragged by {found.mean():.6g} mm; (T/N - μ)/a = {expected:.6g} mm")
    assert np.allclose(force, (-PULL, WEIGHT))
    assert np.allclose(found, expected, rtol=1e-3)  # the block itself is not quite rigid
