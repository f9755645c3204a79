"""Values at the points of Γc of a plane body, ordered along its curves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import gather_on_root
from fenics_contact.surface.facets import FacetSet
from fenics_contact.tolerances import sort_by_coordinates
from fenics_contact.types import Array, Index, Mask

__all__ = ["Along", "along"]

# Range shown beyond the contact, relative to the extent of the contact.
_MARGIN_RATIO = 0.25
# Round-off relative to the largest coordinate, and of projected facets relative to their length.
_ROUND_OFF_RATIO = 1e-9
# Largest variation of the radius of a circular curve, relative to the mean radius.
_RADIUS_VARIATION_RATIO = 0.01


@dataclass(frozen=True)
class Along:
    """Values at the points of Γc, ordered along it with the body on the left.

    Attributes:
        label: Quantity and unit of the abscissa.
        abscissa: The coordinate of largest extent of the contact in which Γc is monotonic near the
            contact; else the angle about the centre of a circular Γc (degrees), or else the arc
            length along the undeformed Γc (length), (n_points,).
        is_angle: Whether the abscissa is an angle.
        curves: For each connected curve of Γc, which points are near the contact, (n_points,) each.
        values: Values at all points, by name: x, gap, pressure, friction (magnitude of the
            tangential traction), slip (sum of the modes), status.
    """

    label: str
    abscissa: Array
    is_angle: bool
    curves: list[Mask]
    values: Mapping[str, Array]


def along(contact: Contact, unit: str = "mm") -> Along | None:
    """Order the points of Γc of a plane body; on the first rank, else None. Collective.

    The label states the unit of length.
    """
    facets = FacetSet(contact.displacement.u.function_space, contact.surface.facets)
    rows = contact.quadrature.point_rows
    fields = {
        "x": contact.points,
        "gap": contact.gap,
        "pressure": contact.pressure,
        "friction": np.linalg.norm(contact.tangential_traction, axis=1),
        "slip": contact.slip.sum(axis=1),
        "status": contact.status,
    }
    parts = gather_on_root(
        contact.surface.mesh.comm,
        facets.displaced_corners(None),
        facets.corner_vertices(),
        facets.mean_normals(),
        contact.quadrature.weights[rows].sum(axis=1),
        *(values[rows] for values in fields.values()),
    )
    if parts is None:
        return None
    ends, vertices, normals, lengths = parts[:4]
    # Orient facets with the body on the left, the outward normal on the right.
    edges = ends[:, 1] - ends[:, 0]
    flip = edges[:, 1] * normals[:, 0] < edges[:, 0] * normals[:, 1]
    ends[flip], vertices[flip] = ends[flip, ::-1], vertices[flip, ::-1]
    at_points = dict(zip(fields, parts[4:], strict=True))
    in_contact = np.any(at_points["status"] != Status.OPEN, axis=1)
    chains = _chains(vertices, ends)
    chains = [(_cut(chain, in_contact, lengths) if ring else chain, ring) for chain, ring in chains]

    # Order the points of a facet by their projection onto its chord.
    edges = ends[:, 1] - ends[:, 0]
    arm = at_points["x"] - ends[:, :1]
    fraction = np.einsum("fpd,fd->fp", arm, edges) / np.sum(edges**2, axis=1)[:, None]
    sequence = np.concatenate([chain for chain, _ in chains])
    n = fraction.shape[1]
    facet, point = np.repeat(sequence, n), np.argsort(fraction, axis=1)[sequence].ravel()
    arc_at_start = np.zeros(len(ends))
    arc_at_start[sequence] = np.cumsum(lengths[sequence]) - lengths[sequence]
    arc = arc_at_start[facet] + fraction[facet, point] * lengths[facet]
    values = {name: array[facet, point] for name, array in at_points.items()}
    number = np.repeat(np.arange(len(chains)), [len(chain) * n for chain, _ in chains])
    near = np.isin(facet, _contact_facets(chains, in_contact)) | (not in_contact.any())

    axes = [
        i
        for i in np.argsort(-np.ptp(values["x"][near], axis=0))
        if _is_monotonic(edges[:, i] / lengths, facet, number, _in_range(values["x"][:, i], near))
    ]
    centre = _common_centre(chains, ends)
    is_angle = False
    if axes:
        abscissa, label = values["x"][:, axes[0]], f"{'xy'[axes[0]]} [{unit}]"
    elif centre is not None:
        is_angle = True
        abscissa = _angles(values["x"] - centre, number)
        label = f"angle about {_format_point(centre, ends)}, from the x axis [°]"
    else:
        start = ends[sequence[0], 0]
        abscissa, label = arc, f"arc length along Γc, from {_format_point(start, ends)} [{unit}]"
    shown = _in_range(abscissa, near)
    curves = [shown & (number == n) for n in range(len(chains))]
    return Along(label, abscissa, is_angle, [curve for curve in curves if curve.any()], values)


def _format_point(x: Array, ends: Array) -> str:
    """Format coordinates, with round-off set to zero."""
    x = np.where(np.abs(x) > _ROUND_OFF_RATIO * np.abs(ends).max(), x, 0.0)
    return f"({x[0]:.4g}, {x[1]:.4g})"


def _chains(vertices: Index, ends: Array) -> list[tuple[Index, bool]]:
    """Return connected curves, open ones first, as facets and whether they are closed.

    Facets have first and last vertices (n_facets, 2) with coordinates (n_facets, 2, 2).
    """
    order = sort_by_coordinates(ends[:, 0])
    leaving: dict[int, list[int]] = {}
    for facet in order[::-1]:
        leaving.setdefault(int(vertices[facet, 0]), []).append(int(facet))
    starts = order[~np.isin(vertices[order, 0], vertices[:, 1])]
    remaining, chains = set(range(len(vertices))), []
    for first in [*starts, *order]:
        chain: list[int] = []
        start = vertex = int(vertices[first, 0])
        while int(first) in remaining or chain:
            following = [facet for facet in leaving.get(vertex, []) if facet in remaining]
            if not following:
                break
            chain.append(following[-1])
            remaining.discard(chain[-1])
            vertex = int(vertices[chain[-1], 1])
        if chain:
            chains.append((np.array(chain), vertex == start))
    return chains


def _cut(ring: Index, in_contact: Mask, lengths: Array) -> Index:
    """Cut a closed curve in the middle of its longest part without contact; return its facets."""
    loaded = np.flatnonzero(in_contact[ring])
    if not len(loaded):
        return ring
    ring = np.roll(ring, -int(loaded[0]))
    ends = np.cumsum(lengths[ring])
    loaded = np.append(np.flatnonzero(in_contact[ring]), len(ring))
    open_length = ends[loaded[1:] - 1] - ends[loaded[:-1]]
    longest = int(np.argmax(open_length))
    cut = ends[loaded[longest]] + open_length[longest] / 2
    return np.roll(ring, -int(np.searchsorted(ends, cut)))


def _contact_facets(chains: list[tuple[Index, bool]], in_contact: Mask) -> Index:
    """Return the facets in contact and their neighbours."""
    facets = []
    for chain, ring in chains:
        loaded = in_contact[chain]
        before, after = np.roll(loaded, 1), np.roll(loaded, -1)
        if not ring:
            before[0] = after[-1] = False
        facets.append(chain[loaded | before | after])
    return np.concatenate(facets)


def _in_range(abscissa: Array, near: Mask) -> Mask:
    """Return which points are within the range of ``near`` points, extended by the margin."""
    low, high = abscissa[near].min(), abscissa[near].max()
    margin = _MARGIN_RATIO * (high - low)
    return np.asarray((abscissa >= low - margin) & (abscissa <= high + margin))


def _is_monotonic(slope: Array, facet: Index, number: Index, shown: Mask) -> bool:
    """Return whether every curve is monotonic along an axis at the shown points.

    ``slope`` is the cosine of the angle between facets and the axis, (n_facets,).
    """
    signs = np.where(np.abs(slope) > _ROUND_OFF_RATIO, np.sign(slope), 0)[facet]
    kinds = (np.unique(signs[shown & (number == n)]) for n in np.unique(number[shown]))
    return all(len(kind) == 1 and kind[0] != 0 for kind in kinds)


def _common_centre(chains: list[tuple[Index, bool]], ends: Array) -> Array | None:
    """Return the centre of concentric circular curves, (2,), or None if they are not circular.

    It is the least-squares solution c of |x|² = 2 c·x + k, with one k per curve.
    """
    points = [ends[chain].reshape(-1, 2) for chain, _ in chains]
    x = np.concatenate(points)
    curve = np.repeat(np.arange(len(points)), [len(p) for p in points])
    origin = x.mean(axis=0)
    matrix: Any = np.column_stack([2 * (x - origin), np.eye(len(points))[curve]])
    solution, _, rank, _ = np.linalg.lstsq(matrix, np.sum((x - origin) ** 2, axis=1))
    if rank < matrix.shape[1]:
        return None
    centre = origin + solution[:2]
    radii = [np.linalg.norm(p - centre, axis=1) for p in points]
    if any(np.ptp(r) > _RADIUS_VARIATION_RATIO * r.mean() for r in radii):
        return None
    return centre


def _angles(arm: Array, number: npt.NDArray[Any]) -> Array:
    """Return angles of vectors in degrees, continuous on each curve, with its middle in ±180°."""
    angles = np.degrees(np.arctan2(arm[:, 1], arm[:, 0]))
    for n in np.unique(number):
        curve = number == n
        unwrapped = np.unwrap(angles[curve], period=360.0)
        midrange = (unwrapped.min() + unwrapped.max()) / 2
        angles[curve] = unwrapped - 360.0 * np.round(midrange / 360.0)
    return angles
