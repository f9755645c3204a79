"""Checks of the measures of a bulk form, and their subdomain data."""

from __future__ import annotations

from typing import Any

import dolfinx
import ufl

from fenics_contact import compat
from fenics_contact.parallel import warn

__all__ = ["check_measures", "share_subdomain_data"]

_MEASURES = {"cell": "dx", "exterior_facet": "ds", "interior_facet": "dS"}
_ALL_ENTITIES = "everywhere"  # UFL's subdomain_id of integrals without tags


def check_measures(form: ufl.Form, mesh: dolfinx.mesh.Mesh) -> None:
    """Check that all measures have tags of the right mesh and dimension. Collective.

    DOLFINx takes an integral over an unknown tag as zero, so that a load would be lost. Tags
    without entities cause a warning.

    Args:
        form: A residual.
        mesh: The mesh of the form.

    Raises:
        ValueError: A measure has no tags, two of one kind have different ones, or tags are of other
            entities or of another mesh. On all ranks.
    """
    comm, tdim = mesh.comm, mesh.topology.dim
    shared = _collect_subdomain_data(form)
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
        dim, entities = (tdim, "cells") if kind == "cell" else (tdim - 1, "facets")
        tags: Any = data
        if hasattr(tags, "dim") and not (tags.dim == dim and compat.entities_of(tags, mesh)):
            raise ValueError(
                f"F has an integral over {measure}({tag}) whose tags are on entities of dimension "
                f"{tags.dim} of {'this' if compat.entities_of(tags, mesh) else 'another'} mesh; "
                f"they must be on the {entities} of the mesh of u"
            )
        if tag == _ALL_ENTITIES:
            continue
        if data is None:
            raise ValueError(
                f"F has an integral over {measure}({tag}) whose measure has no tags, so that "
                f'it is zero; use {measure} = ufl.Measure("{measure}", domain=mesh, '
                "subdomain_data=tags)"
            )
        if not comm.allreduce(_count_tagged(data, int(tag))):
            warn(
                comm,
                f"F has an integral over {measure}({tag}), but nothing on the mesh has this "
                "tag, so that it is zero; check the tag",
            )


def share_subdomain_data(form: ufl.Form) -> ufl.Form:
    """Return the form with equal subdomain data in all integrals of a kind.

    Some releases of DOLFINx require it for the sum of a plain ``dx`` and one with tags (0.9 does
    not).
    """
    shared = _collect_subdomain_data(form)
    return ufl.Form(
        [
            integral.reconstruct(subdomain_data=shared.get(integral.integral_type()))
            for integral in form.integrals()
        ]
    )


def _collect_subdomain_data(form: ufl.Form) -> dict[str, Any]:
    """Return the first subdomain data of every kind of integral."""
    data_by_kind: dict[str, Any] = {}
    for integral in form.integrals():
        data = integral.subdomain_data()
        if data is not None:
            data_by_kind.setdefault(integral.integral_type(), data)
    return data_by_kind


def _count_tagged(data: Any, tag: int) -> int:
    """Count this rank's entities with a tag in MeshTags or (tag, entities) pairs."""
    if hasattr(data, "find"):
        return len(data.find(tag))
    return sum(len(entities) for number, entities in data if number == tag)
