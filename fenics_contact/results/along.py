"""Γc of a plane body as curves, and the values at its points along them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import gather_on_first
from fenics_contact.surface.facets import FacetSet
from fenics_contact.tolerances import by_place
from fenics_contact.types import Array, Index, Mask

__all__ = ["Along", "along"]

# How far beyond the contact is shown, by the extent of the contact.
_MARGIN = 0.25
# Round-off of coordinates, by the largest, and of a facet's way along an axis, by its length.
_ROUND_OFF = 1e-9
# Largest difference between the radii of a curve that is a circle, by the mean radius.
_ROUND = 0.01


@dataclass(frozen=True)
class Along:
    """Values at the points of Γc in the order in which they lie on it, body on the left.

    Attributes:
        label: What the abscissa is, with its unit.
        abscissa: A coordinate of the points in which Γc does not turn back about the contact, by
            preference that along which the contact reaches farthest; if there is none the angle
            about the middle where Γc is round (degrees), else the arc length along the undeformed
            Γc (length), (n_points,).
        is_angle: Whether it is an angle.
        curves: Of each connected curve of Γc the points about the contact, (n_points,) each.
        values: At all points, by name: x, gap, pressure, friction (the size of the tangential
            traction), slip (sum of the modes), status.
    """

    label: str
    abscissa: Array
    is_angle: bool
    curves: list[Mask]
    values: Mapping[str, Array]


def along(contact: Contact, unit: str = "mm") -> Along | None:
    """Order the points of Γc of a plane body along it; on the first rank, else None. Collective.

    The unit is that of length, for the label.
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
    parts = gather_on_first(
        contact.surface.mesh.comm,
        facets.moved_corners(None),
        facets.corner_vertices(),
        facets.mean_normals(),
        contact.quadrature.weights[rows].sum(axis=1),
        *(values[rows] for values in fields.values()),
    )
    if parts is None:
        return None
    ends, vertices, normals, lengths = parts[:4]
    # Facets run with the body on the left, their outward normal on the right.
    edges = ends[:, 1] - ends[:, 0]
    back = edges[:, 1] * normals[:, 0] < edges[:, 0] * normals[:, 1]
    ends[back], vertices[back] = ends[back, ::-1], vertices[back, ::-1]
    at_points = dict(zip(fields, parts[4:], strict=True))
    bears = np.any(at_points["status"] != Status.OPEN, axis=1)
    chains = _chains(vertices, ends)
    chains = [(_cut(chain, bears, lengths) if ring else chain, ring) for chain, ring in chains]

    # Within a facet by the projection on its chord.
    edges = ends[:, 1] - ends[:, 0]
    arm = at_points["x"] - ends[:, :1]
    share = np.einsum("fpd,fd->fp", arm, edges) / np.sum(edges**2, axis=1)[:, None]
    sequence = np.concatenate([chain for chain, _ in chains])
    n = share.shape[1]
    facet, point = np.repeat(sequence, n), np.argsort(share, axis=1)[sequence].ravel()
    begins = np.zeros(len(ends))
    begins[sequence] = np.cumsum(lengths[sequence]) - lengths[sequence]
    arc = begins[facet] + share[facet, point] * lengths[facet]
    values = {name: array[facet, point] for name, array in at_points.items()}
    number = np.repeat(np.arange(len(chains)), [len(chain) * n for chain, _ in chains])
    closed = np.isin(facet, _with_neighbours(chains, bears)) | (not bears.any())

    axes = [
        i
        for i in np.argsort(-np.ptp(values["x"][closed], axis=0))
        if _advances(edges[:, i] / lengths, facet, number, _about(values["x"][:, i], closed))
    ]
    middle = _middle(chains, ends)
    is_angle = False
    if axes:
        abscissa, label = values["x"][:, axes[0]], f"{'xy'[axes[0]]} [{unit}]"
    elif middle is not None:
        is_angle = True
        abscissa = _angles(values["x"] - middle, number)
        label = f"angle about {_place(middle, ends)}, from the x axis [°]"
    else:
        start = ends[sequence[0], 0]
        abscissa, label = arc, f"arc length along Γc, from {_place(start, ends)} [{unit}]"
    shown = _about(abscissa, closed)
    curves = [shown & (number == n) for n in range(len(chains))]
    return Along(label, abscissa, is_angle, [curve for curve in curves if curve.any()], values)


def _place(x: Array, ends: Array) -> str:
    """A place in words, round-off as 0."""
    told = np.where(np.abs(x) > _ROUND_OFF * np.abs(ends).max(), x, 0.0)
    return f"({told[0]:.4g}, {told[1]:.4g})"


def _chains(vertices: Index, ends: Array) -> list[tuple[Index, bool]]:
    """Facets one after another, and whether the last leads to the first; open curves first.

    Args:
        vertices: Where facets begin and end, by number, (n_facets, 2).
        ends: The same places, (n_facets, 2, 2).
    """
    order = by_place(ends[:, 0])
    leaving: dict[int, list[int]] = {}
    for facet in order[::-1]:
        leaving.setdefault(int(vertices[facet, 0]), []).append(int(facet))
    starts = order[~np.isin(vertices[order, 0], vertices[:, 1])]
    left, found = set(range(len(vertices))), []
    for first in [*starts, *order]:
        chain: list[int] = []
        begins = at = int(vertices[first, 0])
        while int(first) in left or chain:
            following = [facet for facet in leaving.get(at, []) if facet in left]
            if not following:
                break
            chain.append(following[-1])
            left.discard(chain[-1])
            at = int(vertices[chain[-1], 1])
        if chain:
            found.append((np.array(chain), at == begins))
    return found


def _cut(ring: Index, bears: Mask, lengths: Array) -> Index:
    """Facets of a closed curve from the middle of the longest stretch that bears nothing."""
    borne = np.flatnonzero(bears[ring])
    if not len(borne):
        return ring
    ring = np.roll(ring, -int(borne[0]))
    ends = np.cumsum(lengths[ring])
    marks = np.append(np.flatnonzero(bears[ring]), len(ring))
    stretch = ends[marks[1:] - 1] - ends[marks[:-1]]
    widest = int(np.argmax(stretch))
    place = ends[marks[widest]] + stretch[widest] / 2
    return np.roll(ring, -int(np.searchsorted(ends, place)))


def _with_neighbours(chains: list[tuple[Index, bool]], bears: Mask) -> Index:
    """Facets that bear, and those before and after them."""
    found = []
    for chain, ring in chains:
        borne = bears[chain]
        before, after = np.roll(borne, 1), np.roll(borne, -1)
        if not ring:
            before[0] = after[-1] = False
        found.append(chain[borne | before | after])
    return np.concatenate(found)


def _about(abscissa: Array, closed: Mask) -> Mask:
    """Points in contact, and those somewhat beyond it."""
    low, high = abscissa[closed].min(), abscissa[closed].max()
    margin = _MARGIN * (high - low)
    return np.asarray((abscissa >= low - margin) & (abscissa <= high + margin))


def _advances(slope: Array, facet: Index, number: Index, shown: Mask) -> bool:
    """Whether the facets of shown points advance along an axis all one way on every curve.

    Args:
        slope: Of facets the share of their length that is along the axis, (n_facets,).
        facet: Of points, (n_points,).
        number: Of the curves of points, (n_points,).
        shown: Which points are shown, (n_points,).
    """
    signs = np.where(np.abs(slope) > _ROUND_OFF, np.sign(slope), 0)[facet]
    kinds = (np.unique(signs[shown & (number == n)]) for n in np.unique(number[shown]))
    return all(len(kind) == 1 and kind[0] != 0 for kind in kinds)


def _middle(chains: list[tuple[Index, bool]], ends: Array) -> Array | None:
    """The common centre of curves that are circles about it, (2,); None: they are none.

    By least squares of |x|² = 2 c·x + k, k of every curve its own.
    """
    places = [ends[chain].reshape(-1, 2) for chain, _ in chains]
    x = np.concatenate(places)
    curve = np.repeat(np.arange(len(places)), [len(p) for p in places])
    origin = x.mean(axis=0)
    matrix: Any = np.column_stack([2 * (x - origin), np.eye(len(places))[curve]])
    found, _, rank, _ = np.linalg.lstsq(matrix, np.sum((x - origin) ** 2, axis=1))
    if rank < matrix.shape[1]:
        return None
    middle = origin + found[:2]
    radii = [np.linalg.norm(place - middle, axis=1) for place in places]
    if any(np.ptp(r) > _ROUND * r.mean() for r in radii):
        return None
    return middle


def _angles(arm: Array, number: npt.NDArray[Any]) -> Array:
    """Angles of arms in degrees, without a jump on any curve, the middle of each within ±180°."""
    angles = np.degrees(np.arctan2(arm[:, 1], arm[:, 0]))
    for n in np.unique(number):
        curve = number == n
        unwrapped = np.unwrap(angles[curve], period=360.0)
        middle = (unwrapped.min() + unwrapped.max()) / 2
        angles[curve] = unwrapped - 360.0 * np.round(middle / 360.0)
    return angles
