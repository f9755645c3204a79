"""Pictures, drawn on the first rank, without a screen. Needs matplotlib."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from dolfinx.mesh import CellType, exterior_facet_indices

from fenics_contact.arguments import check_instance
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import collective_errors, global_sum
from fenics_contact.results import files
from fenics_contact.results.writer import facet_status
from fenics_contact.surface.facets import FacetSet
from fenics_contact.types import Array

__all__ = ["figure", "plot_deformation", "plot_pressure", "plot_status", "plot_tractions"]


_COLOURS = {
    "pressure": "#1f5fa8",
    "tangential": "#c8502a",
    "mesh": "#9a9a9a",
    "open": "#d8d8d8",
}


def plot_deformation(
    path: str | os.PathLike[str],
    u: fem.Function,
    *,
    unit: str = "mm",
    title: str = "",
    magnification: float = 1.0,
    support: Sequence[Sequence[float]] | None = None,
    view: tuple[float, float] | None = None,
) -> None:
    """Draw the original and the deformed mesh over each other. Collective.

    In the plane all cells, in space the facets of the boundary; edges are drawn straight.

    Args:
        path: PNG or PDF to write.
        u: Displacement.
        unit: Unit of length, for the axes.
        title: Title.
        magnification: Factor by which the displacement is drawn.
        support: End points of a line to draw as the rigid support, shape (2, gdim).
        view: In space where to look from: elevation and azimuth in degrees.

    Raises:
        ValueError: u is no displacement.
    """
    check_instance("u", u, fem.Function)
    d = u.function_space.mesh.geometry.dim
    if u.ufl_shape != (d,):
        raise ValueError(
            f"u has shape {u.ufl_shape}; give a displacement of {d} components, of a mixed "
            "function that of its Contact, contact.u"
        )
    original, deformed = _shapes(u, magnification)
    with collective_errors(u.function_space.mesh.comm):
        if original is None or deformed is None:
            return
        true = magnification == 1.0
        label = "deformed (true scale)" if true else f"displacement × {magnification:g}"
        figure, axes = _axes(np.concatenate([original, deformed]), unit, title, view)
        plane = original.shape[2] == 2  # in space what is behind is hidden
        axes.add_collection(_polygons(original, "#ffffff00", _COLOURS["mesh"], 0.4))
        faces = "#1f5fa818" if plane else "#e3ebf5e8"
        axes.add_collection(_polygons(deformed, faces, _COLOURS["pressure"], 0.5 if plane else 0.3))
        from matplotlib.lines import Line2D

        handles = [
            Line2D([], [], color=_COLOURS["mesh"], label="original"),
            Line2D([], [], color=_COLOURS["pressure"], label=label),
        ]
        if support is not None:
            ends = np.asarray(support)
            handles += axes.plot(
                ends[:, 0], ends[:, 1], color="black", linewidth=2, label="rigid support"
            )
            axes.autoscale()
            axes.margins(0.03)
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
        _save(figure, path)


def plot_pressure(
    path: str | os.PathLike[str],
    contact: Contact,
    *,
    length: str = "mm",
    stress: str = "MPa",
    title: str = "",
    magnification: float = 1.0,
    view: tuple[float, float] | None = None,
) -> None:
    """Draw the pressure on the facets of Γc, and the deformed body about it. Collective.

    Every facet has the mean of its points, nominal with finite kinematics; open ones are grey.

    Args:
        path: PNG or PDF to write.
        contact: Evaluated.
        length: Unit of length, for the axes.
        stress: Unit of stress, for the colours.
        title: Title.
        magnification: Factor by which the displacement is drawn.
        view: In space where to look from, elevation and azimuth in degrees; by default so that Γc
            is in front.
    """
    rows, weights = contact.quadrature.point_rows(), contact.quadrature.weights
    pressure = np.sum((weights * contact.pressure)[rows], axis=1) / weights[rows].sum(axis=1)
    drawn = _surface(contact, pressure, magnification)
    with collective_errors(contact.surface.mesh.comm):
        if drawn is None:
            return
        figure, axes = drawn.axes(length, title, view)
        pressure = drawn.values
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize, to_rgba

        low, high = min(0.0, pressure.min()), max(0.0, pressure.max())
        colours = ScalarMappable(Normalize(low, high if high > low else low + 1.0), "viridis_r")
        faces = colours.to_rgba(pressure)
        faces[pressure == 0.0] = to_rgba(_COLOURS["open"])
        axes.add_collection(_on_surface(drawn.facets, faces))
        figure.colorbar(colours, ax=axes, label=f"contact pressure [{stress}]", shrink=0.8)
        _save(figure, path)


def plot_status(
    path: str | os.PathLike[str],
    contact: Contact,
    *,
    length: str = "mm",
    title: str = "",
    magnification: float = 1.0,
    view: tuple[float, float] | None = None,
) -> None:
    """Draw where Γc is open, sticks and slips, and the deformed body about it. Collective.

    Every facet has the status of most of its points.

    Args:
        path: PNG or PDF to write.
        contact: Evaluated.
        length: Unit of length, for the axes.
        title: Title.
        magnification: Factor by which the displacement is drawn.
        view: As for `plot_pressure`.
    """
    drawn = _surface(contact, facet_status(contact), magnification)
    with collective_errors(contact.surface.mesh.comm):
        if drawn is None:
            return
        figure, axes = drawn.axes(length, title, view)
        from matplotlib.patches import Patch

        colours = np.array([_COLOURS[name] for name in ("open", "pressure", "tangential")])
        axes.add_collection(_on_surface(drawn.facets, list(colours[drawn.values])))
        names = {Status.OPEN: "open", Status.STICK: "sticking", Status.SLIP: "slipping"}
        patches = [Patch(fc=colours[s], ec="#555555", label=name) for s, name in names.items()]
        figure.legend(handles=patches, loc="outside lower center", ncols=3)
        _save(figure, path)


def plot_tractions(
    path: str | os.PathLike[str],
    points: Mapping[str, Array],
    *,
    curves: Mapping[str, tuple[Array, Array]] | None = None,
    lines: Mapping[str, float] | None = None,
    marks: Mapping[str, float] | None = None,
    length: str = "mm",
    stress: str = "MPa",
    title: str = "",
) -> None:
    """Draw pressure and tangential traction over x. On the calling rank only.

    Args:
        path: PNG or PDF to write.
        points: What `Contact.gather` returns.
        curves: Reference curves (x, stress) by label.
        lines: Reference values of stress, horizontal, by label.
        marks: Reference positions, vertical, by label.
        length: Unit of length, for the axes.
        stress: Unit of stress, for the axes.
        title: Title.
    """
    plt = _pyplot()
    figure, axes = plt.subplots(figsize=(7.6, 4.8), layout="constrained")
    x, status = points["x"][:, 0], points["status"]
    closed = status != Status.OPEN
    # Somewhat beyond the contact, but not beyond Γc.
    reach = min(1.15 * np.abs(x[closed]).max(initial=0.0), np.abs(x).max(initial=0.0)) or 1.0
    near = np.abs(x) <= reach
    axes.plot(x[near], points["pressure"][near], ".-", color=_COLOURS["pressure"], label="pressure")
    # The shear on the body, along x: the direction in which the support holds it.
    shear = points["tangential_traction"][:, 0]
    if np.any(shear):
        size = np.abs(shear)
        axes.plot(
            x[near], size[near], "-", color=_COLOURS["tangential"], label="|tangential traction|"
        )
        for state, marker, name in (
            (Status.STICK, "o", "sticking"),
            (Status.SLIP, "x", "slipping"),
        ):
            mask = near & (status == state)
            axes.plot(
                x[mask],
                size[mask],
                marker,
                color=_COLOURS["tangential"],
                markersize=4,
                label=f"{name} points",
            )
    styles = ("--", ":", "-.")
    for i, (label, (xs, ys)) in enumerate((curves or {}).items()):
        axes.plot(xs, ys, styles[i % 3], color="black", linewidth=1.2, label=label)
    for i, (label, value) in enumerate((lines or {}).items()):
        axes.axhline(value, color="#555555", linewidth=0.9, linestyle=styles[i % 3], label=label)
    for i, (label, value) in enumerate((marks or {}).items()):
        axes.axvline(value, color="#2a8a3a", linewidth=0.9, linestyle=styles[i % 3], label=label)
    axes.set(xlabel=f"x [{length}]", ylabel=f"traction [{stress}]", title=title)
    axes.set_xlim(left=min(0.0, float(x.min())) if x.min() >= 0 else -reach, right=reach)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.25)
    axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    _save(figure, path)


@contextmanager
def figure(
    path: str | os.PathLike[str], columns: int = 1, size: tuple[float, float] = (6.4, 4.8)
) -> Iterator[Any]:
    """Axes of a picture of one's own, written at the end of the block. On the calling rank only.

    Args:
        path: PNG or PDF to write.
        columns: Number of axes beside each other.
        size: Width and height of each, in inches.

    Yields:
        The axes, or an array of them if there are several.
    """
    plt = _pyplot()
    drawn, axes = plt.subplots(
        1, columns, figsize=(columns * size[0], size[1]), layout="constrained"
    )
    try:
        yield axes
        _save(drawn, path)
    finally:
        plt.close(drawn)


@dataclass(frozen=True)
class _Surface:
    """Γc and the body about it, of all ranks.

    Attributes:
        body: Corners of cells, or facets of the boundary, (n, n_corners, d).
        facets: Those of the facets of Γc.
        values: Of the facets.
        outward: Sum of their normals.
    """

    body: Array
    facets: Array
    values: npt.NDArray[Any]
    outward: Array

    def axes(self, unit: str, title: str, view: tuple[float, float] | None) -> tuple[Any, Any]:
        """A figure with the body in it, seen so that Γc is in front unless a view is given."""
        if view is None and self.body.shape[2] == 3:
            view = _towards(self.outward)
        figure, axes = _axes(self.body, unit, title, view)
        axes.add_collection(_polygons(self.body, "#9a9a9a10", "#9a9a9a60", 0.4))
        return figure, axes


def _surface(contact: Contact, values: npt.NDArray[Any], magnification: float) -> _Surface | None:
    """Γc with a value for every facet, on the first rank; None on the others. Collective."""
    contact.displacement.follow()
    u, mesh = contact.displacement.u, contact.surface.mesh
    facets = FacetSet(u.function_space, contact.surface.facets)
    outward = global_sum(mesh.comm, facets.mean_normals().sum(axis=0))
    _, body = _shapes(u, magnification)
    gathered = mesh.comm.gather((_moved(facets, u, magnification), values))
    if gathered is None or body is None:
        return None
    at, values = (np.concatenate(part) for part in zip(*gathered, strict=True))
    return _Surface(body, at, values, outward)


def _towards(outward: Array) -> tuple[float, float]:
    """Elevation and azimuth from which a surface with this normal is seen, somewhat aslant."""
    x, y, z = outward / (np.linalg.norm(outward) or 1.0)
    elevation = float(np.degrees(np.arcsin(np.clip(z, -1, 1))))
    flat = np.hypot(x, y) < 0.1
    azimuth = -60.0 if flat else float(np.degrees(np.arctan2(y, x))) + 25.0
    return float(np.clip(elevation, -55.0, 55.0)) + (
        20.0 if abs(elevation) < 20.0 else 0.0
    ), azimuth


def _moved(facets: FacetSet, u: fem.Function, magnification: float) -> Array:
    """Corners of facets in the order of their rings, displaced, (n_facets, n_corners, d)."""
    original = facets.moved_corners(None)
    return original + magnification * (facets.moved_corners(u) - original)


def _shapes(u: fem.Function, magnification: float) -> tuple[Array | None, Array | None]:
    """Corners of all cells, in space of the boundary's facets, as they were and as they are.

    Collective.

    Returns:
        (n, n_corners, d) each on the first rank, None on the others.
    """
    mesh = u.function_space.mesh
    d = mesh.topology.dim
    if d == 3:
        mesh.topology.create_connectivity(2, 3)
        exterior = exterior_facet_indices(mesh.topology)
        facets = FacetSet(u.function_space, exterior)
        shapes = facets.moved_corners(None), _moved(facets, u, magnification)
    else:
        corners = fem.functionspace(mesh, ("Lagrange", 1, (d,)))
        at_corners = fem.Function(corners)
        at_corners.interpolate(u)
        order = [0, 1, 3, 2] if mesh.topology.cell_type == CellType.quadrilateral else [0, 1, 2]
        cells = corners.dofmap.list[: mesh.topology.index_map(d).size_local][:, order]
        original = corners.tabulate_dof_coordinates()[:, :d][cells]
        moved = at_corners.x.array.reshape(-1, d)[cells]
        shapes = original, original + magnification * moved
    gathered = mesh.comm.gather(shapes)
    if gathered is None:
        return None, None
    original, deformed = (np.concatenate(part) for part in zip(*gathered, strict=True))
    return original, deformed


def _axes(
    places: Array, unit: str, title: str, view: tuple[float, float] | None
) -> tuple[Any, Any]:
    """A figure and axes of equal scale that hold all places, (n, m, d)."""
    plt, d = _pyplot(), places.shape[2]
    places = places.reshape(-1, d)
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.03 * (high - low).max()
    low, high = low - margin, high + margin
    labels = dict(
        zip(("xlabel", "ylabel", "zlabel"), (f"{a} [{unit}]" for a in "xyz"), strict=True)
    )
    limits = zip(("xlim", "ylim", "zlim"), zip(low, high, strict=True), strict=False)
    if d == 2:
        del labels["zlabel"]
        height = np.clip(6.0 * (high - low)[1] / (high - low)[0], 1.0, 8.0)
        figure, axes = plt.subplots(figsize=(6.8, height + 1.4), layout="constrained")
        axes.set(**labels, **dict(limits), title=title, aspect="equal")
        return figure, axes
    figure = plt.figure(figsize=(7.2, 6.0), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    axes.set(**labels, **dict(limits), title=title)
    axes.set_box_aspect(high - low, zoom=0.85)
    axes.locator_params(nbins=4)
    elevation, azimuth = (25.0, -60.0) if view is None else view
    axes.view_init(elevation, azimuth)
    return figure, axes


def _polygons(corners: Array, faces: Any, edges: str, width: float) -> Any:
    """Cells in the plane or facets in space."""
    from matplotlib.collections import PolyCollection
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    kind = PolyCollection if corners.shape[2] == 2 else Poly3DCollection
    return kind(list(corners), facecolors=faces, edgecolors=edges, linewidths=width)


def _on_surface(facets: Array, colours: Any) -> Any:
    """Facets of Γc with a colour each: lines in the plane."""
    from matplotlib.collections import LineCollection

    if facets.shape[2] == 3:
        return _polygons(facets, colours, "#555555", 0.3)
    return LineCollection(list(facets), colors=colours, linewidths=5.0)


def _save(figure: Any, path: str | os.PathLike[str]) -> None:
    """Write a figure; the file is complete or as before."""
    try:
        with files.replacing(path) as temporary:
            figure.savefig(temporary, dpi=150)
    finally:
        _pyplot().close(figure)


def _pyplot() -> Any:
    """Import pyplot when a picture is drawn: importing the package stays cheap."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot

    return matplotlib.pyplot
