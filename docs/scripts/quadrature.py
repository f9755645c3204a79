"""A contact ends inside a facet: quadrature on Γc against a closed form.

python docs/scripts/quadrature.py             # two degrees
python docs/scripts/quadrature.py 2 4 8 16 32    # these degrees
"""

import sys

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

import fenics_contact as fc

WIDTH, STIFFNESS, FORCE = 1.0, 10.0, 1.0  # mm, MPa/mm, N per mm
BOTTOM, TOP = 1, 2
DEGREES = [int(word) for word in sys.argv[1:]] or [2, 16]


# begin block
def footing(cells: int, degree: int, eccentricity: float) -> float:
    """Return the largest pressure below a nearly rigid block with an eccentric load."""
    msh = mesh.create_rectangle(
        MPI.COMM_WORLD, [(0, 0), (WIDTH, 0.5)], (cells, 2), mesh.CellType.quadrilateral
    )
    facets = mesh.locate_entities_boundary(msh, 1, lambda x: np.isfinite(x[0]))
    y = mesh.compute_midpoints(msh, 1, facets)[:, 1]
    where = np.select([np.isclose(y, 0), np.isclose(y, 0.5)], [BOTTOM, TOP])
    tags = mesh.meshtags(msh, 1, facets, where.astype(np.int32))
    V = fem.functionspace(msh, ("Lagrange", 1, (2,)))
    u, v = fem.Function(V), ufl.TestFunction(V)
    body = fc.elasticity.LinearElastic(u, E=1e6, nu=0.0, kind="plane strain")
    ds = ufl.Measure("ds", domain=msh, subdomain_data=tags)
    s = ufl.SpatialCoordinate(msh)[0] - WIDTH / 2
    load = FORCE / WIDTH * (1 + 12 * eccentricity / WIDTH**2 * s)
    corner = fem.locate_dofs_geometrical(
        (V.sub(0), V.sub(0).collapse()[0]), lambda x: np.isclose(x[0], 0) & np.isclose(x[1], 0)
    )[0]
    surface = fc.ContactSurface(msh, tags, BOTTOM, quadrature_degree=degree)
    soil = fc.Foundation(STIFFNESS, tension=False)
    contact = fc.Contact(u, surface, fc.HalfSpace((0, 0), (0, 1)), soil)
    problem = fc.ContactProblem(
        body.residual(v) + load * v[1] * ds(TOP),
        u,
        bcs=[fem.dirichletbc(0.0, corner, V.sub(0))],
        contacts=[contact],
    )
    problem.solve()
    edge = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[0], WIDTH) & np.isclose(x[1], 0))
    deepest = max([-u.x.array[2 * dof + 1] for dof in edge], default=0.0)
    return STIFFNESS * msh.comm.allreduce(deepest, op=MPI.MAX)


# begin compare
# The pressure is a triangle of length 3 (WIDTH / 2 - e) once e is beyond WIDTH / 6.
E_LOAD = 0.3
exact = 2 * FORCE / (3 * (WIDTH / 2 - E_LOAD))
errors = {}
for cells in (4, 16):
    for degree in DEGREES:
        errors[cells, degree] = abs(footing(cells, degree, E_LOAD) / exact - 1)
        if MPI.COMM_WORLD.rank == 0:
            print(f"{cells} facets, degree {degree}: error {errors[cells, degree]:.1e}")
if 2 in DEGREES:  # the default of linear elements
    assert errors[4, 2] < 1e-2 and errors[16, 2] < 1e-3
