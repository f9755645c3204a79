"""Equivalent bulk forms of random scenes.

Each form is equal to that with piecewise constant coefficients (`SceneSetup.F`), which the
independent solver uses. Cells are tagged by body and by its lower or upper half.
"""

from __future__ import annotations

from typing import Any

import dolfinx
import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.types import Array

__all__ = ["make_form"]


def make_form(setup: Any) -> ufl.Form:
    """Return the residual in the form that the scene requires. Collective."""
    kind = setup.scene.get("form", "plain")
    if kind == "plain":
        return setup.F
    mesh, (cells, moduli) = setup.mesh, _materials(setup)
    n_own = mesh.topology.index_map(mesh.topology.dim).size_local
    data: Any = cells
    if kind == "pairs":
        own = {tag: cells.find(tag) for tag in moduli}
        data = [(tag, found[found < n_own]) for tag, found in own.items()]
    dx = ufl.Measure("dx", mesh, subdomain_data=data)
    if kind in ("loads", "beside"):
        F = setup.bulk(setup.E, dx if kind == "loads" else ufl.dx(mesh))
    else:
        measures = {tag: dx(tag) for tag in moduli}
        if kind == "measures":
            measures = {
                tag: ufl.Measure("dx", mesh, subdomain_data=data, subdomain_id=tag)
                for tag in moduli
            }
        bulk = setup.bulk_of_energy if kind == "energy" else setup.bulk
        F = sum(bulk(fem.Constant(mesh, E), measures[tag]) for tag, E in moduli.items())
    return F - setup.loads(dx(tuple(moduli)), ufl.ds(mesh, subdomain_data=setup.tags))


def _materials(setup: Any) -> tuple[dolfinx.mesh.MeshTags, dict[int, float]]:
    """Return the cell tags, and Young's modulus by tag (stress). Collective."""
    mesh, d = setup.mesh, setup.d
    every = np.arange(len(setup.cell_body), dtype=np.int32)
    height: Array = dolfinx.mesh.compute_midpoints(mesh, d, every).reshape(-1, 3)[:, d - 1]
    middle = [(b["origin"][-1] + 0.5 * b["size"][-1]) * setup.length for b in setup.scene["bodies"]]
    tags = (1 + 2 * setup.cell_body + (height > np.array(middle)[setup.cell_body])).astype(np.int32)
    present = sorted(set().union(*setup.comm.allgather(tags.tolist())))
    cells = dolfinx.mesh.meshtags(mesh, d, every, tags)
    return cells, {tag: float(setup.moduli[(tag - 1) // 2]) for tag in present}
