"""The measures of a bulk form: over which tags they are, and how DOLFINx takes them together."""

from __future__ import annotations

from typing import Any

import dolfinx
import ufl

from fenics_contact import compat
from fenics_contact.parallel import warn

__all__ = ["check_measures", "share_subdomain_data"]

_MEASURES = {"cell": "dx", "exterior_facet": "ds", "interior_facet": "dS"}
_EVERYWHERE = "everywhere"  # UFL's word for an integral over all cells, or all facets of a kind


def check_measures(form: ufl.Form, mesh: dolfinx.mesh.Mesh) -> None:
    """Refuse measures without the tags that they are over, or with tags of others. Collective.

    It warns of tags of nothing. An integral over a tag that is not known is zero without a word
    from DOLFINx: a load that is not there.

    Args:
        form: A residual.
        mesh: That it is on.

    Raises:
        ValueError: A measure has no tags, two of one kind have different ones, or tags are of
            other entities or of another mesh. On all ranks.
    """
    comm, tdim = mesh.comm, mesh.topology.dim
    shared = _subdomain_data(form)
    for integral in form.integrals():
        kind, data = integral.integral_type(), integral.subdomain_data()
        tag = integral.subdomain_id()
        measure = _MEASURES.get(kind, kind)
        if data is not None and data is not shared[kind]:
            raise ValueError(
                f"F has integrals over {measure} with two different subdomain_data, but DOLFINx "
                "accepts one per kind of measure: merge the tags into one MeshTags (or list), and "
                f'use {measure} = ufl.Measure("{measure}", domain=mesh, subdomain_data=tags) for '
                "all of them"
            )
        dim, what = (tdim, "cells") if kind == "cell" else (tdim - 1, "facets")
        tags: Any = data
        if hasattr(tags, "dim") and not (tags.dim == dim and compat.entities_of(tags, mesh)):
            raise ValueError(
                f"F has an integral over {measure}({tag}) whose tags are on entities of dimension "
                f"{tags.dim} of {'this' if compat.entities_of(tags, mesh) else 'another'} mesh; "
                f"they must be on the {what} of the mesh of u"
            )
        if tag == _EVERYWHERE:
            continue
        if data is None:
            raise ValueError(
                f"F has an integral over {measure}({tag}) whose measure has no tags, so that "
                f'it is zero; use {measure} = ufl.Measure("{measure}", domain=mesh, '
                "subdomain_data=tags)"
            )
        if not comm.allreduce(_n_tagged(data, int(tag))):
            warn(
                comm,
                f"F has an integral over {measure}({tag}), but nothing on the mesh has this "
                "tag, so that it is zero; check the tag",
            )


def share_subdomain_data(form: ufl.Form) -> ufl.Form:
    """Return the same form with the tags of each kind of measure in all integrals of that kind.

    DOLFINx takes the sum of a plain ``dx`` and one with tags in some releases (0.9 does not); an
    integral over all cells is the same with the tags as without.
    """
    shared = _subdomain_data(form)
    return ufl.Form(
        [
            integral.reconstruct(subdomain_data=shared.get(integral.integral_type()))
            for integral in form.integrals()
        ]
    )


def _subdomain_data(form: ufl.Form) -> dict[str, Any]:
    """The tags of every kind of integral that has any, of the first one that has them."""
    found: dict[str, Any] = {}
    for integral in form.integrals():
        data = integral.subdomain_data()
        if data is not None:
            found.setdefault(integral.integral_type(), data)
    return found


def _n_tagged(data: Any, tag: int) -> int:
    """How many of this rank's entities have a tag: of MeshTags, or of (tag, entities) pairs."""
    if hasattr(data, "find"):
        return len(data.find(tag))
    return sum(len(entities) for number, entities in data if number == tag)
