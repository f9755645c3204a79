"""The bulk forms of random scenes, in the ways in which their users write them.

Each is the form of the scene with coefficients by cell and plain measures (`Made.F`), which the
second solution is made of. Cells are tagged by their body and, in it, by their half.
"""

from __future__ import annotations

from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.types import Array

__all__ = ["written"]


def written(made: Any) -> ufl.Form:
    """The residual of a `Made` scene as the scene says. Collective."""
    way = made.scene.get("form", "plain")
    if way == "plain":
        return made.F
    mesh, (cells, moduli) = made.mesh, _materials(made)
    n_own = mesh.topology.index_map(mesh.topology.dim).size_local
    data: Any = cells
    if way == "pairs":
        own = {tag: cells.find(tag) for tag in moduli}
        data = [(tag, found[found < n_own]) for tag, found in own.items()]
    dx = ufl.Measure("dx", mesh, subdomain_data=data)
    if way in ("loads", "beside"):
        F = made.bulk(made.E, dx if way == "loads" else ufl.dx(mesh))
    else:
        measures = {tag: dx(tag) for tag in moduli}
        if way == "measures":
            measures = {
                tag: ufl.Measure("dx", mesh, subdomain_data=data, subdomain_id=tag)
                for tag in moduli
            }
        bulk = made.bulk_of_energy if way == "energy" else made.bulk
        F = sum(bulk(fem.Constant(mesh, E), measures[tag]) for tag, E in moduli.items())
    return F - made.loads(dx(tuple(moduli)), ufl.ds(mesh, subdomain_data=made.tags))


def _materials(made: Any) -> tuple[dolfinx.mesh.MeshTags, dict[int, float]]:
    """Tags of the cells, and Young's modulus by tag (stress). Collective."""
    mesh, d = made.mesh, made.d
    every = np.arange(len(made.box), dtype=np.int32)
    height: Array = dolfinx.mesh.compute_midpoints(mesh, d, every).reshape(-1, 3)[:, d - 1]
    middle = [(b["origin"][-1] + 0.5 * b["size"][-1]) * made.length for b in made.scene["bodies"]]
    tags = (1 + 2 * made.box + (height > np.array(middle)[made.box])).astype(np.int32)
    present = sorted(set().union(*made.comm.allgather(tags.tolist())))
    cells = dolfinx.mesh.meshtags(mesh, d, every, tags)
    return cells, {tag: float(made.moduli[(tag - 1) // 2]) for tag in present}
