"""Parts of figures: shapes of bodies and of Γc on the first rank, axes, colours, legends."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import basix
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from dolfinx.mesh import CellType, exterior_facet_indices

from fenics_contact.arguments import check_instance, check_positive, is_number
from fenics_contact.compiling import compile_expression
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import gather_on_root, global_sum
from fenics_contact.results import files
from fenics_contact.results.obstacles import ObstacleShape, box_about, shapes_of
from fenics_contact.surface.facets import FacetSet
from fenics_contact.types import Array, Mask

__all__ = [
    "COLOURS",
    "MARGIN",
    "Shape",
    "ShapeEvaluator",
    "Surface",
    "add_obstacles",
    "check_near",
    "check_view",
    "colour_scale",
    "create_axes",
    "draw_deformation",
    "facet_collection",
    "gather_facets",
    "gather_surface",
    "magnification_label",
    "obstacle_collection",
    "obstacle_handle",
    "polygons",
    "pyplot",
    "save",
    "status_colours",
    "status_handles",
    "von_mises",
]


# Margin of figures relative to their content, with and without obstacles.
MARGIN = {True: 0.08, False: 0.03}
COLOURS = {
    "pressure": "#1f5fa8",
    "tangential": "#c8502a",
    "mesh": "#9a9a9a",
    "obstacle": "#111111",
    "open": "#d8d8d8",
}
# Labels and colours of the contact status.
_STATUS = {
    Status.OPEN: ("open", COLOURS["open"]),
    Status.STICK: ("sticking", COLOURS["pressure"]),
    Status.SLIP: ("slipping", COLOURS["tangential"]),
}


def check_near(near: Any) -> None:
    """Raise ValueError unless ``near`` is None or a positive length."""
    if near is not None:
        check_positive("near", near, "a length greater than zero", infinite=True)


def check_view(view: Any) -> None:
    """Raise ValueError unless ``view`` is None or elevation and azimuth."""
    if view is None:
        return
    if np.shape(view) != (2,) or not all(is_number(angle) and np.isfinite(angle) for angle in view):
        raise ValueError(
            f"view is {view!r}; it must be elevation and azimuth in degrees, (25, -60)"
        )


def von_mises(stress: Array) -> Array:
    """Return √(3/2 s:s), (…), of tensors (…, 3, 3) with the deviator s."""
    mean = np.trace(stress, axis1=-2, axis2=-1)[..., None, None] / 3
    return np.asarray(np.sqrt(1.5 * np.sum((stress - mean * np.eye(3)) ** 2, axis=(-2, -1))))


@dataclass(frozen=True)
class Shape:
    """The cells of a plane body, or the boundary facets of a body in space, on the first rank.

    Attributes:
        original: Undeformed corners, (n, n_corners, d).
        displacement: Displacement of the corners, (n, n_corners, d).
        stress: Von Mises stress at the midpoint of the cells, (n,), or None.
    """

    original: Array
    displacement: Array
    stress: Array | None = None

    def deformed(self, magnification: float) -> Array:
        """Return the corners with magnified displacement."""
        return self.original + magnification * self.displacement


class ShapeEvaluator:
    """Evaluates the present `Shape` of a body when called. The constructor is collective.

    Raises:
        ValueError: u is no displacement, or the stress is no tensor (3, 3).
    """

    def __init__(self, u: fem.Function, stress: Any = None) -> None:
        check_instance("u", u, fem.Function)
        self._u, mesh = u, u.function_space.mesh
        if u.ufl_shape != (mesh.geometry.dim,):
            raise ValueError(
                f"u has shape {u.ufl_shape}; it must be a displacement of {mesh.geometry.dim} "
                "components; for a mixed function use contact.u"
            )
        self._dim, self._stress = mesh.topology.dim, None
        if stress is not None:
            tensor = ufl.as_ufl(stress)
            if tensor.ufl_shape != (3, 3):
                raise ValueError(
                    f"stress has shape {tensor.ufl_shape}; the von Mises stress needs a tensor "
                    "(3, 3), such as that of elasticity.LinearElastic"
                )
            midpoint = basix.geometry(basix.CellType[mesh.topology.cell_name()]).mean(axis=0)
            self._stress = compile_expression(tensor, midpoint[None])
        if self._dim == 3:
            mesh.topology.create_connectivity(2, 3)
            self._facets = FacetSet(u.function_space, exterior_facet_indices(mesh.topology))
            self._cells = self._facets.cells.astype(np.int32)
        else:
            space = fem.functionspace(mesh, ("Lagrange", 1, (self._dim,)))
            self._at_corners = fem.Function(space)
            quadrilateral = mesh.topology.cell_type == CellType.quadrilateral
            ring = [0, 1, 3, 2] if quadrilateral else [0, 1, 2]
            n = mesh.topology.index_map(self._dim).size_local
            self._corners = space.dofmap.list[:n][:, ring]
            self._vertices = space.tabulate_dof_coordinates()[:, : self._dim]
            self._cells = np.arange(n, dtype=np.int32)

    def __call__(self) -> Shape | None:
        """Return the shape on the first rank, None on the others. Collective."""
        mesh = self._u.function_space.mesh
        if self._dim == 3:
            original = self._facets.displaced_corners(None)
            displacement = self._facets.displaced_corners(self._u) - original
        else:
            self._at_corners.interpolate(self._u)
            original = self._vertices[self._corners]
            displacement = self._at_corners.x.array.reshape(-1, self._dim)[self._corners]
        stress: Array = np.zeros(len(self._cells))
        if self._stress is not None and len(self._cells):
            values = np.asarray(self._stress.eval(mesh, self._cells))
            stress = von_mises(values.reshape(-1, 3, 3))
        gathered = gather_on_root(mesh.comm, original, displacement, stress)
        if gathered is None:
            return None
        original, displacement, stress = gathered
        return Shape(original, displacement, None if self._stress is None else stress)


@dataclass(frozen=True)
class Surface:
    """Γc and the body, of all ranks.

    Attributes:
        body: Corners of cells, or boundary facets in space, (n, n_corners, d).
        facets: Corners of the facets of Γc.
        values: Values on the facets.
        in_contact: Which facets have a point that is not open.
        outward: Sum of the facets' normals.
    """

    body: Array
    facets: Array
    values: npt.NDArray[Any]
    in_contact: Mask
    outward: Array

    def crop(self, distance: float | None) -> Surface:
        """Return the part within a distance of the facets in contact; everything for None."""
        if distance is None or not self.in_contact.any():
            return self
        corners = self.facets[self.in_contact]
        low, high = corners.min(axis=(0, 1)) - distance, corners.max(axis=(0, 1)) + distance

        def is_near(corners: Array) -> Mask:
            midpoint = corners.mean(axis=1)
            return np.all((midpoint >= low) & (midpoint <= high), axis=1)

        near = is_near(self.facets) | self.in_contact
        return replace(
            self,
            body=self.body[is_near(self.body)],
            facets=self.facets[near],
            values=self.values[near],
            in_contact=self.in_contact[near],
        )

    def create_axes(
        self,
        unit: str,
        title: str,
        view: tuple[float, float] | None,
        contact: Contact,
        magnification: float,
    ) -> tuple[Any, Any, list[Any]]:
        """Return figure, axes and legend handles, with the body and in the plane the obstacle.

        By default Γc is in front of the body.
        """
        d = self.body.shape[2]
        if view is None and d == 3:
            view = _view_of_surface(self.outward)
        points = np.concatenate([self.body.reshape(-1, d), self.facets.reshape(-1, d)])
        obstacles = shapes_of([contact]) if d == 2 else []  # in space it would hide Γc
        margin = MARGIN[bool(obstacles)]
        figure, axes = create_axes(points[None], unit, title, view, margin)
        axes.add_collection(polygons(self.body, "#9a9a9a10", "#9a9a9a60", 0.4))
        handles = add_obstacles(axes, obstacles, box_about(points, margin), magnification)
        return figure, axes, handles


def gather_surface(
    contact: Contact, values: npt.NDArray[Any], magnification: float
) -> Surface | None:
    """Gather Γc with a value per facet on the first rank; None on the others. Collective."""
    contact.displacement.update()
    u, mesh = contact.displacement.u, contact.surface.mesh
    outward = global_sum(
        mesh.comm, FacetSet(u.function_space, contact.surface.facets).mean_normals().sum(axis=0)
    )
    shape = ShapeEvaluator(u)()
    status = contact.status[contact.quadrature.point_rows]
    in_contact = gather_on_root(mesh.comm, np.any(status != Status.OPEN, axis=1))
    gathered = gather_facets(contact, values)
    if gathered is None or in_contact is None or shape is None:
        return None
    original, displacement, values = gathered
    facets = original + magnification * displacement
    return Surface(shape.deformed(magnification), facets, values, in_contact[0], outward)


def gather_facets(
    contact: Contact, values: npt.NDArray[Any]
) -> tuple[Array, Array, npt.NDArray[Any]] | None:
    """Gather corners, displacements and values of the facets of Γc on the first rank. Collective.

    The displacement must be up to date; the values are those of this rank's facets.
    """
    u = contact.displacement.u
    facets = FacetSet(u.function_space, contact.surface.facets)
    original = facets.displaced_corners(None)
    local = original, facets.displaced_corners(u) - original, values
    gathered = gather_on_root(contact.surface.mesh.comm, *local)
    if gathered is None:
        return None
    original, displacement, values = gathered
    return original, displacement, values


def _view_of_surface(outward: Array) -> tuple[float, float]:
    """Return elevation and azimuth for an oblique view of a surface with this normal."""
    x, y, z = outward / (np.linalg.norm(outward) or 1.0)
    elevation = float(np.degrees(np.arcsin(np.clip(z, -1, 1))))
    is_horizontal = np.hypot(x, y) < 0.1
    azimuth = -60.0 if is_horizontal else float(np.degrees(np.arctan2(y, x))) + 25.0
    return float(np.clip(elevation, -55.0, 55.0)) + (
        20.0 if abs(elevation) < 20.0 else 0.0
    ), azimuth


def draw_deformation(
    shape: Shape,
    units: tuple[str, str],
    title: str,
    magnification: float,
    obstacles: Sequence[ObstacleShape],
    view: tuple[float, float] | None,
) -> Any:
    """Draw the figure of `plotting.plot_deformation`; ``units`` are those of length and stress."""
    original, deformed = shape.original, shape.deformed(magnification)
    corners = np.concatenate([original, deformed])
    margin = MARGIN[bool(obstacles)]
    figure, axes = create_axes(corners, units[0], title, view, margin)
    is_plane = original.shape[2] == 2
    if is_plane:
        axes.add_collection(polygons(original, "#ffffff00", COLOURS["mesh"], 0.4))
    else:
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        lines = list(_sharp_edges(original))
        axes.add_collection(Line3DCollection(lines, colors=COLOURS["mesh"], linewidths=0.8))
    edges, width = COLOURS["pressure"], 0.5 if is_plane else 0.3
    body = faces = "#1f5fa818" if is_plane else "#e3ebf5e8"
    if shape.stress is not None:
        colours = colour_scale(0.0, shape.stress.max(initial=0.0))
        faces, edges, width = colours.to_rgba(shape.stress), "#11111180", 0.2
        body = colours.to_rgba(shape.stress.max(initial=0.0) / 2)
        figure.colorbar(colours, ax=axes, label=f"von Mises stress [{units[1]}]", shrink=0.8)
    axes.add_collection(polygons(deformed, faces, edges, width))
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], color=COLOURS["mesh"], label="original"),
        Patch(fc=body, ec=edges, label=magnification_label(magnification)),
    ]
    handles += add_obstacles(axes, obstacles, box_about(corners, margin), magnification)
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def add_obstacles(
    axes: Any, obstacles: Sequence[ObstacleShape], box: Array, magnification: float
) -> list[Any]:
    """Draw the rigid obstacles in a box; return their legend handles."""
    surfaces = [shape(box, magnification) for shape in obstacles]
    collections = [obstacle_collection(corners) for corners in surfaces if len(corners)]
    for collection in collections:
        axes.add_collection(collection)
    return [obstacle_handle(box.shape[1])] if collections else []


def obstacle_handle(d: int) -> Any:
    """Return a legend handle for rigid obstacles in d dimensions."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    colour, label = COLOURS["obstacle"], "rigid obstacle"
    if d == 3:
        return Patch(fc=f"{colour}18", ec="none", label=label)
    return Line2D([], [], color=colour, linewidth=2.2, label=label)


def obstacle_collection(corners: Array) -> Any:
    """Return a collection of segments or transparent triangles of an obstacle, (n, d, d)."""
    from matplotlib.collections import LineCollection

    if corners.shape[2] == 3:
        return polygons(corners, COLOURS["obstacle"] + "18", "none", 0.0)
    lines = LineCollection(list(corners), colors=COLOURS["obstacle"], linewidths=2.2, zorder=1.5)
    lines.set_capstyle("round")  # the zorder: below Γc
    return lines


def magnification_label(magnification: float) -> str:
    """Return the label of the deformed body in legends."""
    return "deformed (true scale)" if magnification == 1.0 else f"displacement × {magnification:g}"


def _sharp_edges(facets: Array) -> Array:
    """Return the edges between facets (n, n_corners, 3) at an angle of more than 30°, (m, 2, 3)."""
    corners = facets.reshape(-1, 3)
    size = float(np.ptp(corners, axis=0).max()) or 1.0
    _, first, number = np.unique(
        np.round(corners / size, 9), axis=0, return_index=True, return_inverse=True
    )
    number = number.reshape(facets.shape[:2])
    ends = np.sort(np.stack([number, np.roll(number, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    edges, edge = np.unique(ends, axis=0, return_inverse=True)
    normals = np.cross(facets[:, 1] - facets[:, 0], facets[:, 2] - facets[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.repeat(normals, facets.shape[1], axis=0)
    # The sum of n nᵀ over the facets of an edge is independent of their orientation. Its largest
    # eigenvalue is 1 + |cos(angle)|, or 1 for an edge with one facet.
    tensor = np.zeros((len(edges), 3, 3))
    np.add.at(tensor, edge.ravel(), normals[:, :, None] * normals[:, None, :])
    largest = np.linalg.eigvalsh(tensor)[:, -1]
    return corners[first[edges[largest < 1 + np.cos(np.pi / 6)]]]


def create_axes(
    points: Array,
    unit: str,
    title: str,
    view: tuple[float, float] | None,
    margin: float = MARGIN[False],
) -> tuple[Any, Any]:
    """Create a figure and axes of equal scale for points (n, m, d) and a margin."""
    plt, d = pyplot(), points.shape[2]
    low, high = box_about(points, margin)
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
    for axis, start, end in zip((axes.xaxis, axes.yaxis, axes.zaxis), low, high, strict=True):
        if end - start < 0.2 * (high - low).max():  # space for one label only
            axis.set_ticks([float(f"{(start + end) / 2:.3g}")])
    elevation, azimuth = (25.0, -60.0) if view is None else view
    axes.view_init(elevation, azimuth)
    return figure, axes


def polygons(corners: Array, faces: Any, edges: str, width: float) -> Any:
    """Return a collection of cells in the plane or facets in space."""
    from matplotlib.collections import PolyCollection
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    kind = PolyCollection if corners.shape[2] == 2 else Poly3DCollection
    return kind(list(corners), facecolors=faces, edgecolors=edges, linewidths=width)


def facet_collection(facets: Array, colours: Any) -> Any:
    """Return a collection of facets of Γc, with one colour each; lines in the plane."""
    from matplotlib.collections import LineCollection

    if facets.shape[2] == 3:
        return polygons(facets, colours, "#555555", 0.3)
    return LineCollection(list(facets), colors=colours, linewidths=5.0)


def status_colours(status: npt.NDArray[Any]) -> list[str]:
    """Return the colours of facets by their contact status."""
    return [_STATUS[Status(value)][1] for value in status]


def status_handles() -> list[Any]:
    """Return legend handles for the contact status."""
    from matplotlib.patches import Patch

    return [Patch(fc=colour, ec="#555555", label=name) for name, colour in _STATUS.values()]


def colour_scale(low: float, high: float) -> Any:
    """Return the colour scale of values from ``low`` to ``high``, for faces and colour bars."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    return ScalarMappable(Normalize(low, high if high > low else low + 1.0), "viridis_r")


def save(figure: Any, path: str | os.PathLike[str]) -> None:
    """Write a figure atomically, and close it."""
    try:
        with files.atomic_write(path) as temporary:
            figure.savefig(temporary, dpi=150)
    finally:
        pyplot().close(figure)


def pyplot() -> Any:
    """Import and return pyplot, without a display; late, to keep the import of the package fast."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot

    return matplotlib.pyplot
