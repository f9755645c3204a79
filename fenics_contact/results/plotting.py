"""Pictures, drawn on the first rank. Needs matplotlib."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from dolfinx import fem
from dolfinx.mesh import CellType

from fenics_contact.contact.values import Status
from fenics_contact.results import files
from fenics_contact.types import Array

__all__ = ["figure", "plot_deformation", "plot_tractions"]


_COLOURS = {"pressure": "#1f5fa8", "tangential": "#c8502a", "mesh": "#9a9a9a"}


def plot_deformation(
    path: str | os.PathLike[str],
    u: fem.Function,
    *,
    unit: str = "mm",
    title: str = "",
    magnification: float = 1.0,
    support: Sequence[Sequence[float]] | None = None,
) -> None:
    """Draw the original and the deformed mesh of a plane problem over each other. Collective.

    Args:
        path: PNG or PDF to write.
        u: Displacement, gdim 2.
        unit: Unit of length, for the axes.
        title: Title.
        magnification: Factor by which the displacement is drawn.
        support: End points of a line to draw as the rigid support, shape (2, 2).

    Raises:
        ValueError: The problem is not plane.
    """
    mesh = u.function_space.mesh
    if mesh.geometry.dim != 2:
        raise ValueError(
            f"plot_deformation draws plane problems; this mesh is in {mesh.geometry.dim}D"
        )
    corners = fem.functionspace(mesh, ("Lagrange", 1, (2,)))
    at_corners = fem.Function(corners)
    at_corners.interpolate(u)
    order = [0, 1, 3, 2] if mesh.topology.cell_type == CellType.quadrilateral else [0, 1, 2]
    cells = corners.dofmap.list[: mesh.topology.index_map(2).size_local][:, order]
    original = corners.tabulate_dof_coordinates()[:, :2][cells]
    deformed = original + magnification * at_corners.x.array.reshape(-1, 2)[cells]
    gathered = mesh.comm.gather((original, deformed))
    if gathered is None:
        return
    original, deformed = (np.concatenate(part) for part in zip(*gathered, strict=True))

    plt = _pyplot()
    from matplotlib.collections import PolyCollection

    extent = np.ptp(np.concatenate([original, deformed]), axis=(0, 1))
    height = np.clip(6.0 * extent[1] / extent[0], 1.0, 8.0)
    figure, axes = plt.subplots(figsize=(6.8, height + 1.4), layout="constrained")
    axes.add_collection(
        PolyCollection(original, facecolors="none", edgecolors=_COLOURS["mesh"], linewidths=0.4)
    )
    axes.add_collection(
        PolyCollection(
            deformed, facecolors="#1f5fa818", edgecolors=_COLOURS["pressure"], linewidths=0.5
        )
    )
    axes.plot([], [], color=_COLOURS["mesh"], label="original")
    true = magnification == 1.0
    label = "deformed (true scale)" if true else f"displacement × {magnification:g}"
    axes.plot([], [], color=_COLOURS["pressure"], label=label)
    if support is not None:
        ends = np.asarray(support)
        axes.plot(ends[:, 0], ends[:, 1], color="black", linewidth=2, label="rigid support")
    axes.set(xlabel=f"x [{unit}]", ylabel=f"y [{unit}]", title=title, aspect="equal")
    axes.autoscale_view()
    axes.margins(0.03)
    figure.legend(loc="outside lower center", ncols=3)
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
