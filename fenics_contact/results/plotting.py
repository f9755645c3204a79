"""Figures of results, drawn on the first rank without a display. Needs matplotlib."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from dolfinx import fem

from fenics_contact.arguments import listed
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import collective_errors
from fenics_contact.results import drawing
from fenics_contact.results.along import along
from fenics_contact.results.obstacles import shapes_of
from fenics_contact.results.writer import facet_status
from fenics_contact.types import Array, Mask

__all__ = [
    "figure",
    "plot_along",
    "plot_deformation",
    "plot_field",
    "plot_pressure",
    "plot_status",
    "plot_tractions",
]

# Labels and kinds of units of the fields of `plot_field`.
_FIELDS = {
    "pressure": ("contact pressure", "stress"),
    "friction": ("magnitude of the tangential traction", "stress"),
    "gap": ("gap", "length"),
    "slip": ("accumulated slip", "length"),
}


def plot_deformation(
    path: str | os.PathLike[str],
    u: fem.Function,
    *,
    stress: Any = None,
    unit: str = "mm",
    stress_unit: str = "MPa",
    title: str = "",
    magnification: float = 1.0,
    contacts: Sequence[Contact] = (),
    view: tuple[float, float] | None = None,
) -> None:
    """Plot the undeformed and the deformed mesh. Collective.

    In the plane all cells are drawn, in space the boundary facets, with straight edges.

    Args:
        path: PNG or PDF file to write.
        u: Displacement.
        stress: UFL tensor (3, 3) on the body, whose von Mises stress at the midpoint of each cell
            is its colour.
        unit: Unit of length, for the axes.
        stress_unit: Unit of stress, for the colour bar.
        title: Title.
        magnification: Factor of the displacements drawn.
        contacts: Contacts whose rigid obstacles are drawn at their present positions, with
            magnified displacements.
        view: Elevation and azimuth of the camera in degrees, in space.

    Raises:
        ValueError: u is no displacement, or the stress has another shape; raised on all ranks.
        OSError: The file cannot be written and is unchanged; raised on all ranks.
    """
    shape = drawing.ShapeEvaluator(u, stress)()
    contacts = listed("contacts", contacts, Contact)
    with collective_errors(u.function_space.mesh.comm):
        if shape is not None:
            obstacles, units = shapes_of(contacts), (unit, stress_unit)
            figure = drawing.draw_deformation(shape, units, title, magnification, obstacles, view)
            drawing.save(figure, path)


def plot_field(
    path: str | os.PathLike[str],
    contact: Contact,
    field: str = "pressure",
    *,
    length: str = "mm",
    stress: str = "MPa",
    title: str = "",
    magnification: float = 1.0,
    near: float | None = None,
    view: tuple[float, float] | None = None,
) -> None:
    """Plot a field on the facets of Γc, with the deformed body. Collective.

    The value of a facet is the mean over its quadrature points. Facets are grey where pressure,
    friction or slip is zero, or the gap is unknown.

    Args:
        path: PNG or PDF file to write.
        contact: An evaluated contact.
        field: "pressure" (nominal with finite kinematics), "friction" (magnitude of the tangential
            traction), "gap", or "slip" (committed, sum of the modes).
        length: Unit of length, for the axes, gap and slip.
        stress: Unit of stress, for the colour bar.
        title: Title.
        magnification: Factor of the displacements drawn.
        near: Largest distance from loaded facets of what is drawn (length); by default everything
            is drawn.
        view: Elevation and azimuth of the camera in degrees, in space; by default Γc is in front.

    Raises:
        ValueError: There is no such field, or ``near`` is no length; raised on all ranks.
        OSError: The file cannot be written and is unchanged; raised on all ranks.
    """
    if field not in _FIELDS:
        raise ValueError(f"field is {field!r}; use one of {list(_FIELDS)}")
    drawing.check_near(near)
    at_points = _field(contact, field)
    rows = contact.quadrature.point_rows
    values, weights = at_points[rows], contact.quadrature.weights[rows]
    is_known = np.isfinite(values)
    total = np.sum(weights * is_known, axis=1)
    means = np.sum(weights * np.where(is_known, values, 0.0), axis=1)
    means = np.divide(means, total, out=np.full_like(total, np.nan), where=total > 0)
    surface = drawing.gather_surface(contact, means, magnification)
    with collective_errors(contact.surface.mesh.comm):
        if surface is None:
            return
        surface = surface.crop(near)
        figure, axes, handles = surface.create_axes(length, title, view, contact, magnification)
        from matplotlib.colors import to_rgba
        from matplotlib.patches import Patch

        means = surface.values
        low, high = (end(means, initial=0.0) for end in (np.nanmin, np.nanmax))
        colours = drawing.colour_scale(low, high)
        faces = colours.to_rgba(means)
        grey, is_grey = to_rgba(drawing.COLOURS["open"]), np.isnan(means)
        is_grey |= (means == 0.0) & (field != "gap")
        faces[is_grey] = grey
        axes.add_collection(drawing.facet_collection(surface.facets, faces))
        name, kind = _FIELDS[field]
        unit = {"stress": stress, "length": length}[kind]
        figure.colorbar(colours, ax=axes, label=f"{name} [{unit}]", shrink=0.8)
        if is_grey.any():
            label = "gap unknown" if field == "gap" else f"no {field}"
            handles.append(Patch(fc=grey, ec="#555555", label=label))
        if handles:
            figure.legend(handles=handles, loc="outside lower center", ncols=2)
        drawing.save(figure, path)


def _field(contact: Contact, name: str) -> Array:
    """Return one of `_FIELDS` at this rank's points."""
    if name == "pressure":
        return contact.pressure
    if name == "friction":
        return np.asarray(np.linalg.norm(contact.tangential_traction, axis=1))
    return contact.gap if name == "gap" else np.asarray(contact.slip.sum(axis=1))


def plot_pressure(path: str | os.PathLike[str], contact: Contact, **options: Any) -> None:
    """Plot the contact pressure on the facets of Γc. Collective.

    Args:
        path: PNG or PDF file to write.
        contact: An evaluated contact.
        **options: Keyword arguments of `plot_field`.
    """
    plot_field(path, contact, "pressure", **options)


def plot_status(
    path: str | os.PathLike[str],
    contact: Contact,
    *,
    length: str = "mm",
    title: str = "",
    magnification: float = 1.0,
    near: float | None = None,
    view: tuple[float, float] | None = None,
) -> None:
    """Plot the contact status (open, stick, slip) of the facets of Γc. Collective.

    The status of a facet is that of most of its points.

    Args:
        path: PNG or PDF file to write.
        contact: An evaluated contact.
        length: Unit of length, for the axes.
        title: Title.
        magnification: Factor of the displacements drawn.
        near: Largest distance from loaded facets of what is drawn (length); by default everything
            is drawn.
        view: Elevation and azimuth of the camera in degrees, in space; by default Γc is in front.

    Raises:
        ValueError: ``near`` is no length; raised on all ranks.
    """
    drawing.check_near(near)
    surface = drawing.gather_surface(contact, facet_status(contact), magnification)
    with collective_errors(contact.surface.mesh.comm):
        if surface is None:
            return
        surface = surface.crop(near)
        figure, axes, handles = surface.create_axes(length, title, view, contact, magnification)
        colours = drawing.status_colours(surface.values)
        axes.add_collection(drawing.facet_collection(surface.facets, colours))
        handles = [*drawing.status_handles(), *handles]
        figure.legend(handles=handles, loc="outside lower center", ncols=4)
        drawing.save(figure, path)


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
    """Plot pressure and tangential traction over x. On the calling rank only.

    Args:
        path: PNG or PDF file to write.
        points: Result of `Contact.gather`.
        curves: Reference curves (x, stress) by label.
        lines: Reference values of stress, horizontal, by label.
        marks: Reference positions, vertical, by label.
        length: Unit of length, for the axes.
        stress: Unit of stress, for the axes.
        title: Title.
    """
    plt = drawing.pyplot()
    figure, axes = plt.subplots(figsize=(7.6, 4.8), layout="constrained")
    x, status = points["x"][:, 0], points["status"]
    in_contact = status != Status.OPEN
    # 15 % beyond the contact, but not beyond Γc.
    limit = min(1.15 * np.abs(x[in_contact]).max(initial=0.0), np.abs(x).max(initial=0.0)) or 1.0
    near = np.abs(x) <= limit
    shear = np.abs(points["tangential_traction"][:, 0])
    _draw_tractions(axes, x, points["pressure"], shear, status, [near])
    styles = ("--", ":", "-.")
    for i, (label, (xs, ys)) in enumerate((curves or {}).items()):
        axes.plot(xs, ys, styles[i % 3], color="black", linewidth=1.2, label=label)
    for i, (label, value) in enumerate((lines or {}).items()):
        axes.axhline(value, color="#555555", linewidth=0.9, linestyle=styles[i % 3], label=label)
    for i, (label, value) in enumerate((marks or {}).items()):
        axes.axvline(value, color="#2a8a3a", linewidth=0.9, linestyle=styles[i % 3], label=label)
    axes.set(xlabel=f"x [{length}]", ylabel=f"traction [{stress}]", title=title)
    axes.set_xlim(left=min(0.0, float(x.min())) if x.min() >= 0 else -limit, right=limit)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.25)
    axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    drawing.save(figure, path)


def plot_along(
    path: str | os.PathLike[str],
    contact: Contact,
    *,
    length: str = "mm",
    stress: str = "MPa",
    title: str = "",
) -> None:
    """Plot tractions, gap and slip along Γc of a plane body. Collective.

    The abscissa is the coordinate of largest extent of the contact if Γc is monotonic in it, the
    angle if Γc is circular, and otherwise the arc length, all on the undeformed Γc. The range is
    somewhat larger than the contact. Each connected curve of Γc has its own line.

    Args:
        path: PNG or PDF file to write.
        contact: An evaluated contact of a plane body.
        length: Unit of length, for the axes.
        stress: Unit of stress, for the axes.
        title: Title.

    Raises:
        ValueError: The body is not plane; raised on all ranks.
        OSError: The file cannot be written and is unchanged; raised on all ranks.
    """
    if contact.points.shape[1] != 2:
        raise ValueError(f"{contact.name}: plot_along needs a plane body; in space use plot_field")
    curve_data = along(contact, length)
    with collective_errors(contact.surface.mesh.comm):
        if curve_data is None:
            return
        plt, x, values = drawing.pyplot(), curve_data.abscissa, curve_data.values
        lower = {"gap": ("gap", "pressure")}
        if np.any(values["slip"]):
            lower["slip"] = ("accumulated slip", "tangential")
        figure, rows = plt.subplots(
            1 + len(lower),
            sharex=True,
            figsize=(7.6, 3.6 + 2.2 * len(lower)),
            height_ratios=[3.0, *(2.0 for _ in lower)],
            layout="constrained",
        )
        _draw_tractions(
            rows[0], x, values["pressure"], values["friction"], values["status"], curve_data.curves
        )
        rows[0].set(ylabel=f"traction [{stress}]", title=title)
        for axes, (name, (label, colour)) in zip(rows[1:], lower.items(), strict=True):
            for curve in curve_data.curves:
                style = {"color": drawing.COLOURS[colour], "label": label}
                axes.plot(x[curve], values[name][curve], ".-", **style)
            axes.set(ylabel=f"{label} [{length}]")
        rows[-1].set(xlabel=curve_data.label)
        if curve_data.is_angle:
            rows[-1].locator_params(axis="x", steps=[1, 1.5, 3, 4.5, 9, 10])
        rows[0].legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
        for axes in rows:
            axes.axhline(0.0, color="#555555", linewidth=0.6)  # keeps round-off out of the limits
            axes.grid(alpha=0.25)
        drawing.save(figure, path)


def _draw_tractions(
    axes: Any, x: Array, pressure: Array, shear: Array, status: Array, parts: Sequence[Mask]
) -> None:
    """Draw pressure, shear, and sticking and slipping points, on several parts of Γc."""
    blue, red = drawing.COLOURS["pressure"], drawing.COLOURS["tangential"]
    has_labels = True
    for part in parts:
        curves = [(pressure, ".-", blue, "pressure", part)]
        if np.any(shear):
            curves.append((shear, "-", red, "|tangential traction|", part))
            for state, marker, name in (
                (Status.STICK, "o", "sticking points"),
                (Status.SLIP, "x", "slipping points"),
            ):
                curves.append((shear, marker, red, name, part & (status == state)))
        for values, style, colour, name, mask in curves:
            label = name if has_labels else None
            size = 4 if values is shear else 6
            axes.plot(x[mask], values[mask], style, color=colour, markersize=size, label=label)
        has_labels = False


@contextmanager
def figure(
    path: str | os.PathLike[str], columns: int = 1, size: tuple[float, float] = (6.4, 4.8)
) -> Iterator[Any]:
    """Create a figure that is written at the end of the ``with`` block. On the calling rank only.

    Args:
        path: PNG or PDF file to write.
        columns: Number of axes in a row.
        size: Width and height of each, in inches.

    Yields:
        The axes, or an array of axes if there are several.
    """
    plt = drawing.pyplot()
    fig, axes = plt.subplots(1, columns, figsize=(columns * size[0], size[1]), layout="constrained")
    try:
        yield axes
        drawing.save(fig, path)
    finally:
        plt.close(fig)
