"""What pictures are drawn with: shapes of bodies and of Γc on the first rank, axes, colours."""

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
from fenics_contact.parallel import gather_on_first, global_sum
from fenics_contact.results import files
from fenics_contact.results.obstacles import ObstacleShape, box_about, shapes_of
from fenics_contact.surface.facets import FacetSet
from fenics_contact.types import Array, Mask

__all__ = [
    "COLOURS",
    "MARGIN",
    "Shape",
    "ShapeOf",
    "Surface",
    "add_obstacles",
    "check_near",
    "check_view",
    "deformed",
    "facets_of",
    "made_axes",
    "magnified",
    "obstacle_entry",
    "on_obstacle",
    "on_surface",
    "polygons",
    "pyplot",
    "save",
    "scale_of",
    "status_colours",
    "status_patches",
    "surface_of",
    "von_mises",
]


# Of the size of what is drawn how much is shown beyond it, with and without obstacles.
MARGIN = {True: 0.08, False: 0.03}
COLOURS = {
    "pressure": "#1f5fa8",
    "tangential": "#c8502a",
    "mesh": "#9a9a9a",
    "obstacle": "#111111",
    "open": "#d8d8d8",
}
# What legends call them, and their colours.
_STATUS = {
    Status.OPEN: ("open", COLOURS["open"]),
    Status.STICK: ("sticking", COLOURS["pressure"]),
    Status.SLIP: ("slipping", COLOURS["tangential"]),
}


def check_near(near: Any) -> None:
    """Refuse what is no distance.

    Raises:
        ValueError: It says what was given.
    """
    if near is not None:
        check_positive("near", near, "a length greater than zero", infinite=True)


def check_view(view: Any) -> None:
    """Refuse what is no elevation and azimuth.

    Raises:
        ValueError: It says what was given.
    """
    if view is None:
        return
    if np.shape(view) != (2,) or not all(is_number(angle) and np.isfinite(angle) for angle in view):
        raise ValueError(
            f"view is {view!r}; it must be elevation and azimuth in degrees, (25, -60)"
        )


def von_mises(stress: Array) -> Array:
    """√(3/2 s:s) of tensors (…, 3, 3), s their deviator: (…)."""
    mean = np.trace(stress, axis1=-2, axis2=-1)[..., None, None] / 3
    return np.asarray(np.sqrt(1.5 * np.sum((stress - mean * np.eye(3)) ** 2, axis=(-2, -1))))


@dataclass(frozen=True)
class Shape:
    """A body on the first rank.

    Attributes:
        original: Corners of all cells, in space of the boundary's facets, (n, n_corners, d).
        moved: By how much they have moved.
        stress: Von Mises stress in the middle of the cells, (n,); None where none was given.
    """

    original: Array
    moved: Array
    stress: Array | None = None

    def deformed(self, magnification: float) -> Array:
        """Corners, displaced by so many times as much."""
        return self.original + magnification * self.moved


class ShapeOf:
    """Makes `Shape` of a displacement and a stress, as they are when it is called.

    The constructor finds the facets, and compiles. It is collective.

    Args:
        stress: UFL tensor (3, 3); None: there is none.

    Raises:
        ValueError: u is no displacement; or the stress has another shape: without the stress
            across a plane body that of von Mises is not known.
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
            middle = basix.geometry(basix.CellType[mesh.topology.cell_name()]).mean(axis=0)
            self._stress = compile_expression(tensor, middle[None])
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
            self._places = space.tabulate_dof_coordinates()[:, : self._dim]
            self._cells = np.arange(n, dtype=np.int32)

    def __call__(self) -> Shape | None:
        """On the first rank all of it; None on the others. Collective."""
        mesh = self._u.function_space.mesh
        if self._dim == 3:
            original = self._facets.moved_corners(None)
            moved = self._facets.moved_corners(self._u) - original
        else:
            self._at_corners.interpolate(self._u)
            original = self._places[self._corners]
            moved = self._at_corners.x.array.reshape(-1, self._dim)[self._corners]
        stress: Array = np.zeros(len(self._cells))
        if self._stress is not None and len(self._cells):
            values = np.asarray(self._stress.eval(mesh, self._cells))
            stress = von_mises(values.reshape(-1, 3, 3))
        gathered = gather_on_first(mesh.comm, original, moved, stress)
        if gathered is None:
            return None
        original, moved, stress = gathered
        return Shape(original, moved, None if self._stress is None else stress)


@dataclass(frozen=True)
class Surface:
    """Γc and the body about it, of all ranks.

    Attributes:
        body: Corners of cells, or facets of the boundary, (n, n_corners, d).
        facets: Those of the facets of Γc.
        values: Of the facets.
        bears: Which of them have a point that is not open.
        outward: Sum of their normals.
    """

    body: Array
    facets: Array
    values: npt.NDArray[Any]
    bears: Mask
    outward: Array

    def around(self, reach: float | None) -> Surface:
        """What of it is no farther than that from the facets that bear; None: all of it."""
        if reach is None or not self.bears.any():
            return self
        places = self.facets[self.bears]
        low, high = places.min(axis=(0, 1)) - reach, places.max(axis=(0, 1)) + reach

        def near(corners: Array) -> Mask:
            middle = corners.mean(axis=1)
            return np.all((middle >= low) & (middle <= high), axis=1)

        kept = near(self.facets) | self.bears
        return replace(
            self,
            body=self.body[near(self.body)],
            facets=self.facets[kept],
            values=self.values[kept],
            bears=self.bears[kept],
        )

    def axes(
        self,
        unit: str,
        title: str,
        view: tuple[float, float] | None,
        contact: Contact,
        magnification: float,
    ) -> tuple[Any, Any, list[Any]]:
        """A figure with the body in it, seen so that Γc is in front unless a view is given.

        In the plane with the contact's obstacle; in space it would hide Γc. The last are entries of
        a legend.
        """
        d = self.body.shape[2]
        if view is None and d == 3:
            view = _towards(self.outward)
        places = np.concatenate([self.body.reshape(-1, d), self.facets.reshape(-1, d)])
        shown = shapes_of([contact]) if d == 2 else []
        margin = MARGIN[bool(shown)]
        figure, axes = made_axes(places[None], unit, title, view, margin)
        axes.add_collection(polygons(self.body, "#9a9a9a10", "#9a9a9a60", 0.4))
        handles = add_obstacles(axes, shown, box_about(places, margin), magnification)
        return figure, axes, handles


def surface_of(contact: Contact, values: npt.NDArray[Any], magnification: float) -> Surface | None:
    """Γc with a value for every facet, on the first rank; None on the others. Collective."""
    contact.displacement.follow()
    u, mesh = contact.displacement.u, contact.surface.mesh
    outward = global_sum(
        mesh.comm, FacetSet(u.function_space, contact.surface.facets).mean_normals().sum(axis=0)
    )
    shape = ShapeOf(u)()
    status = contact.status[contact.quadrature.point_rows]
    bearing = gather_on_first(mesh.comm, np.any(status != Status.OPEN, axis=1))
    gathered = facets_of(contact, values)
    if gathered is None or bearing is None or shape is None:
        return None
    original, moved, values = gathered
    at = original + magnification * moved
    return Surface(shape.deformed(magnification), at, values, bearing[0], outward)


def facets_of(
    contact: Contact, values: npt.NDArray[Any]
) -> tuple[Array, Array, npt.NDArray[Any]] | None:
    """Corners of the facets of Γc, their displacement and values, on the first rank. Collective.

    The displacement is up to date; the values are of this rank's facets.
    """
    u = contact.displacement.u
    facets = FacetSet(u.function_space, contact.surface.facets)
    original = facets.moved_corners(None)
    mine = original, facets.moved_corners(u) - original, values
    gathered = gather_on_first(contact.surface.mesh.comm, *mine)
    if gathered is None:
        return None
    original, moved, values = gathered
    return original, moved, values


def _towards(outward: Array) -> tuple[float, float]:
    """Elevation and azimuth from which a surface with this normal is seen, somewhat aslant."""
    x, y, z = outward / (np.linalg.norm(outward) or 1.0)
    elevation = float(np.degrees(np.arcsin(np.clip(z, -1, 1))))
    flat = np.hypot(x, y) < 0.1
    azimuth = -60.0 if flat else float(np.degrees(np.arctan2(y, x))) + 25.0
    return float(np.clip(elevation, -55.0, 55.0)) + (
        20.0 if abs(elevation) < 20.0 else 0.0
    ), azimuth


def deformed(
    shape: Shape,
    units: tuple[str, str],
    title: str,
    magnification: float,
    obstacles: Sequence[ObstacleShape],
    view: tuple[float, float] | None,
) -> Any:
    """The figure of `plotting.plot_deformation`; units are those of length and stress."""
    original, moved = shape.original, shape.deformed(magnification)
    places = np.concatenate([original, moved])
    margin = MARGIN[bool(obstacles)]
    figure, axes = made_axes(places, units[0], title, view, margin)
    plane = original.shape[2] == 2  # in space what is behind is hidden
    if plane:
        axes.add_collection(polygons(original, "#ffffff00", COLOURS["mesh"], 0.4))
    else:
        from mpl_toolkits.mplot3d.art3d import Line3DCollection

        lines = Line3DCollection(list(_ridges(original)), colors=COLOURS["mesh"], linewidths=0.8)
        axes.add_collection(lines)
    edges, width = COLOURS["pressure"], 0.5 if plane else 0.3
    body = faces = "#1f5fa818" if plane else "#e3ebf5e8"
    if shape.stress is not None:
        colours = scale_of(0.0, shape.stress.max(initial=0.0))
        faces, edges, width = colours.to_rgba(shape.stress), "#11111180", 0.2
        body = colours.to_rgba(shape.stress.max(initial=0.0) / 2)
        figure.colorbar(colours, ax=axes, label=f"von Mises stress [{units[1]}]", shrink=0.8)
    axes.add_collection(polygons(moved, faces, edges, width))
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], color=COLOURS["mesh"], label="original"),
        Patch(fc=body, ec=edges, label=magnified(magnification)),
    ]
    handles += add_obstacles(axes, obstacles, box_about(places, margin), magnification)
    figure.legend(handles=handles, loc="outside lower center", ncols=3)
    return figure


def add_obstacles(
    axes: Any, obstacles: Sequence[ObstacleShape], box: Array, magnification: float
) -> list[Any]:
    """Draw rigid obstacles where they are within a box; entries of a legend for them."""
    surfaces = [shape(box, magnification) for shape in obstacles]
    drawn = [on_obstacle(corners) for corners in surfaces if len(corners)]
    for each in drawn:
        axes.add_collection(each)
    return [obstacle_entry(box.shape[1])] if drawn else []


def obstacle_entry(d: int) -> Any:
    """Entry of a legend for rigid obstacles in d dimensions."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    colour, label = COLOURS["obstacle"], "rigid obstacle"
    if d == 3:
        return Patch(fc=f"{colour}18", ec="none", label=label)
    return Line2D([], [], color=colour, linewidth=2.2, label=label)


def on_obstacle(corners: Array) -> Any:
    """Segments of an obstacle, or triangles through which the body can be seen, (n, d, d)."""
    from matplotlib.collections import LineCollection

    if corners.shape[2] == 3:
        return polygons(corners, COLOURS["obstacle"] + "18", "none", 0.0)
    lines = LineCollection(list(corners), colors=COLOURS["obstacle"], linewidths=2.2, zorder=1.5)
    lines.set_capstyle("round")  # the zorder: below Γc
    return lines


def magnified(magnification: float) -> str:
    """What a legend calls the deformed body."""
    true = magnification == 1.0
    return "deformed (true scale)" if true else f"displacement × {magnification:g}"


def _ridges(facets: Array) -> Array:
    """Ends of the edges at which facets in space, (n, n_corners, 3), meet at more than 30°."""
    corners = facets.reshape(-1, 3)
    size = float(np.ptp(corners, axis=0).max()) or 1.0
    _, first, number = np.unique(
        np.round(corners / size, 9), axis=0, return_index=True, return_inverse=True
    )
    number = number.reshape(facets.shape[:2])
    ends = np.sort(np.stack([number, np.roll(number, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    edges, edge = np.unique(ends, axis=0, return_inverse=True)
    across = np.cross(facets[:, 1] - facets[:, 0], facets[:, 2] - facets[:, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normal = np.repeat(across, facets.shape[1], axis=0)
    # Two facets of any orientation: n n^T of both differ by their angle alone.
    spread = np.zeros((len(edges), 3, 3))
    np.add.at(spread, edge.ravel(), normal[:, :, None] * normal[:, None, :])
    # The largest eigenvalue is 1 + |cos| of the angle; 1 of an edge with one facet.
    largest = np.linalg.eigvalsh(spread)[:, -1]
    return corners[first[edges[largest < 1 + np.cos(np.pi / 6)]]]


def made_axes(
    places: Array,
    unit: str,
    title: str,
    view: tuple[float, float] | None,
    margin: float = MARGIN[False],
) -> tuple[Any, Any]:
    """A figure and axes of equal scale that hold all places, (n, m, d), and a margin."""
    plt, d = pyplot(), places.shape[2]
    low, high = box_about(places, margin)
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
        if end - start < 0.2 * (high - low).max():  # no room for more than one number
            axis.set_ticks([float(f"{(start + end) / 2:.3g}")])
    elevation, azimuth = (25.0, -60.0) if view is None else view
    axes.view_init(elevation, azimuth)
    return figure, axes


def polygons(corners: Array, faces: Any, edges: str, width: float) -> Any:
    """Cells in the plane or facets in space."""
    from matplotlib.collections import PolyCollection
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    kind = PolyCollection if corners.shape[2] == 2 else Poly3DCollection
    return kind(list(corners), facecolors=faces, edgecolors=edges, linewidths=width)


def on_surface(facets: Array, colours: Any) -> Any:
    """Facets of Γc with a colour each: lines in the plane."""
    from matplotlib.collections import LineCollection

    if facets.shape[2] == 3:
        return polygons(facets, colours, "#555555", 0.3)
    return LineCollection(list(facets), colors=colours, linewidths=5.0)


def status_colours(status: npt.NDArray[Any]) -> list[str]:
    """Of facets that are open, stick or slip."""
    return [_STATUS[Status(each)][1] for each in status]


def status_patches() -> list[Any]:
    """Entries of a legend for them."""
    from matplotlib.patches import Patch

    return [Patch(fc=colour, ec="#555555", label=name) for name, colour in _STATUS.values()]


def scale_of(low: float, high: float) -> Any:
    """Colours of values from ``low`` to ``high``, for faces and for a bar."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    return ScalarMappable(Normalize(low, high if high > low else low + 1.0), "viridis_r")


def save(figure: Any, path: str | os.PathLike[str]) -> None:
    """Write a figure; the file is complete or as before."""
    try:
        with files.atomic_write(path) as temporary:
            figure.savefig(temporary, dpi=150)
    finally:
        pyplot().close(figure)


def pyplot() -> Any:
    """Import pyplot when a picture is drawn: importing the package stays cheap."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot

    return matplotlib.pyplot
