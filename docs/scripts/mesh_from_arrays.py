"""A mesh of another program is read from an Abaqus file, from arrays and from XDMF."""

from pathlib import Path

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.io import XDMFFile
from mpi4py import MPI

import fenics_contact as fc

try:
    import meshio
except ImportError:
    meshio = None

comm = MPI.COMM_WORLD
SOFT, STIFF, FLOOR, TOP = 1, 2, 1, 2
# begin file
INP = """*NODE
1, 0., 0., 0.
2, 1., 0., 0.
3, 2., 0., 0.
4, 0., 1., 0.
5, 1., 1., 0.
6, 2., 1., 0.
7, 0., 2., 0.
8, 1., 2., 0.
9, 2., 2., 0.
*ELEMENT, TYPE=CPS4, ELSET=SOFT
1, 1, 2, 5, 4
2, 2, 3, 6, 5
*ELEMENT, TYPE=CPS4, ELSET=STIFF
3, 4, 5, 8, 7
4, 5, 6, 9, 8
*NSET, NSET=FLOOR
1, 2, 3
*NSET, NSET=TOP
7, 8, 9
"""


# begin meshio
def read_abaqus(path):
    """Return points, cells, cell tags and node sets of quadrilaterals in 2D."""
    read = meshio.read(path)
    sets = {SOFT: read.cell_sets["SOFT"], STIFF: read.cell_sets["STIFF"]}
    cells, tags = [], []
    for number, block in enumerate(read.cells):
        if block.type == "quad":
            cells.append(block.data)
            tags.append(np.zeros(len(block.data), dtype=np.int32))
            for tag, members in sets.items():
                tags[-1][np.asarray(members[number], dtype=int)] = tag
    return read.points[:, :2], np.concatenate(cells), np.concatenate(tags), read.point_sets


# begin facets
EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0]])  # of a quadrilateral in the order of VTK


def boundary_facets(cells, nodes):
    """Return the exterior facets all of whose vertices are in a set of nodes."""
    facets = np.sort(cells[:, EDGES].reshape(-1, 2), axis=1)
    facets, count = np.unique(facets, axis=0, return_counts=True)
    return facets[(count == 1) & np.isin(facets, nodes).all(axis=1)]


# begin arrays
points = cells = tags = facets = None
if comm.rank == 0:
    points = [[x, y] for y in (0.0, 1.0, 2.0) for x in (0.0, 1.0, 2.0)]
    cells = np.array([[0, 1, 4, 3], [1, 2, 5, 4], [3, 4, 7, 6], [4, 5, 8, 7]])
    tags = [SOFT, SOFT, STIFF, STIFF]
    facets = {FLOOR: [[0, 1], [1, 2]], TOP: [[6, 7], [7, 8]]}
msh, cell_tags, facet_tags = fc.mesh_from_arrays(
    comm, points, cells, cell_type="quadrilateral", facets=facets, cell_tags=tags
)
# begin check
if comm.rank == 0:
    sets = {"FLOOR": [0, 1, 2], "TOP": [6, 7, 8]}
    if meshio is not None:
        Path("part.inp").write_text(INP)
        *found, sets = read_abaqus("part.inp")
        assert all(map(np.array_equal, found, (points, cells, tags)))
    assert np.array_equal(boundary_facets(cells, sets["FLOOR"]), facets[FLOOR])
    assert np.array_equal(boundary_facets(cells, sets["TOP"]), facets[TOP])

# begin xdmf
msh.name, cell_tags.name, facet_tags.name = "part", "cells", "facets"
with XDMFFile(comm, "part.xdmf", "w") as file:
    file.write_mesh(msh)
    file.write_meshtags(cell_tags, msh.geometry)
    file.write_meshtags(facet_tags, msh.geometry)
with XDMFFile(comm, "part.xdmf", "r") as file:
    msh = file.read_mesh(name="part")
    msh.topology.create_connectivity(1, 2)
    cell_tags = file.read_meshtags(msh, name="cells")
    facet_tags = file.read_meshtags(msh, name="facets")

# begin problem
E, PRESSURE, K_N = {SOFT: 10.0, STIFF: 1000.0}, 0.5, 1e4  # MPa, MPa, MPa/mm
V = fem.functionspace(msh, ("Lagrange", 1, (2,)))
u, v = fem.Function(V), ufl.TestFunction(V)
dx = ufl.Measure("dx", domain=msh, subdomain_data=cell_tags)
ds = ufl.Measure("ds", domain=msh, subdomain_data=facet_tags)
F = PRESSURE * v[1] * ds(TOP)
for tag, modulus in E.items():
    F += fc.elasticity.LinearElastic(u, modulus, 0.0, "plane strain").residual(v, dx(tag))
floor, surface = fc.HalfSpace((0, 0), (0, 1)), fc.ContactSurface(msh, facet_tags, FLOOR)
contact = fc.Contact(u, surface, floor, fc.Coulomb(0.3, k_n=K_N))
fc.ContactProblem(F, u, contacts=[contact]).solve()
shortening = -comm.allreduce(u.x.array[1::2].min(), op=MPI.MIN)
expected = PRESSURE * (1 / E[SOFT] + 1 / E[STIFF] + 1 / K_N)
if comm.rank == 0:
    print(f"top moves by {shortening:.6g} mm, springs in series {expected:.6g} mm")
assert np.isclose(shortening, expected, rtol=1e-8)
