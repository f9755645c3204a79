"""Time series for ParaView: body, contact surface, quadrature points and rigid obstacles."""

from __future__ import annotations

import contextlib
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import basix
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from mpi4py import MPI

from fenics_contact.arguments import check_instance, is_number
from fenics_contact.compiling import compile_expression
from fenics_contact.contact.contact import Contact
from fenics_contact.contact.values import Status
from fenics_contact.parallel import collective_errors, gather_on_root
from fenics_contact.problem import ContactProblem
from fenics_contact.results import files, vtu
from fenics_contact.results.drawing import von_mises
from fenics_contact.results.obstacles import ObstacleShape, box_about
from fenics_contact.step import Step
from fenics_contact.surface.facet_values import facet_values
from fenics_contact.surface.facets import FacetSet
from fenics_contact.types import Array

__all__ = ["Writer", "facet_status"]

# Obstacles are written up to this distance from the body, relative to its size.
_OBSTACLE_MARGIN_RATIO = 0.1


class Writer:
    """Writes results of a problem as time series for ParaView, one state per call of `write`.

    The folder contains, for all ranks together,

    - ``body.pvd``: displacement and, if given, stress and von_mises;
    - ``CONTACT.pvd`` for every contact, by its name: Γc, with linear fits of the values at the
      quadrature points of each facet, and the status of most of its points;
    - ``CONTACT_points.pvd``: the quadrature points of Γc with their values;
    - ``CONTACT_obstacle.pvd``: the surface of a rigid obstacle near the body, at its present
      position, unless it is given by a gap only.

    The first two files of a contact have displacement, pressure, tangential_traction (on the body),
    gap (NaN without an opposite point), slip (committed, sum of the modes), status (`Status`) and
    normal (from body to obstacle); with finite kinematics also true_pressure, per deformed area,
    while the others are nominal; and with a deformable obstacle also paired, the fraction of points
    that have an opposite point. Body, Γc and points are written in the undeformed configuration:
    deform them by "Warp By Vector" with the displacement.

    Files are replaced only when they are complete, and need not be closed. The constructor is
    collective.

    Args:
        folder: Folder of the files, created if necessary. Existing series are continued.
        problem: The problem.
        stress: UFL tensor (d, d) or (3, 3) on the body. It is interpolated one degree below the
            displacement, from points in the interior of the cells. The von Mises stress is written
            with (3, 3) only, because it depends on the stress normal to the plane.

    Attributes:
        folder: Folder of the files.

    Raises:
        ValueError: The stress has another shape, a contact's name cannot be used in a file name, or
            an existing series cannot be read; raised on all ranks.
        OSError: The folder cannot be created or written to; raised on all ranks.
    """

    def __init__(
        self, folder: str | os.PathLike[str], problem: ContactProblem, *, stress: Any = None
    ) -> None:
        check_instance("problem", problem, ContactProblem)
        self.folder, self._problem = Path(folder), problem
        self._mesh = problem.u.function_space.mesh
        self._comm = self._mesh.comm
        self._body = _Body(problem, stress)
        self._surfaces = [_Surface(contact) for contact in problem.contacts]
        names = [series for s in self._surfaces for series in s.series]
        with_obstacle = [c for c in problem.contacts if ObstacleShape.is_known(c)]
        names += [f"{contact.name}_obstacle" for contact in with_obstacle]
        for name in names:
            if not re.fullmatch(r"[\w. +-]+", name) or [*names, "body"].count(name) > 1:
                raise ValueError(
                    f"a contact's file would be named {name}.pvd, which is no valid file name, or "
                    "that of another series; give the contact another name, Contact(name=...)"
                )
        self._series: dict[str, list[tuple[float, str]]] = {}
        self._obstacles: dict[str, ObstacleShape] = {}  # on the first rank
        with collective_errors(self._comm):
            if self._comm.rank == 0:
                self._obstacles = {f"{c.name}_obstacle": ObstacleShape(c) for c in with_obstacle}
                files.make_folder(self.folder)
                for name in ("body", *names):
                    self._series[name] = vtu.read_series(self._path(name))
        self._last = -np.inf

    def write(self, state: Step | float) -> None:
        """Add the present state to the series. Collective.

        Existing states of this and later times are replaced, and earlier ones remain: a history
        that continues from a checkpoint continues its series, on any number of ranks, and one that
        starts again replaces them. The interior displacement is recovered first, if it is out of
        date.

        Args:
            state: The `Step`, whose time is the number of the increment, and whose load parameter
                is the field "load" of the file; or a time.

        Raises:
            ValueError: ``state`` is neither, or a time that is not later than the last one written,
                or another program has written to the folder; raised on all ranks.
            OSError: A file cannot be written; existing files are unchanged. Raised on all ranks.
        """
        numbers = {}
        if isinstance(state, Step):
            time = float(state.increment)
            if state.load is not None:
                numbers["load"] = float(state.load)
        elif is_number(state) and np.isfinite(state):
            time = float(state)
        else:
            raise ValueError(f"state is {state!r}; it must be a Step, or a time (a finite number)")
        if not time > self._last:
            raise ValueError(
                f"the time is {time:g}, but the last one written is {self._last:g}; times must "
                "increase: give the step, or another number"
            )
        self._problem.complete()
        grids = {"body": self._body.grid()}
        for surface in self._surfaces:
            grids |= dict(zip(surface.series, surface.grids(), strict=True))
        gathered = {name: _gather(self._comm, grid) for name, grid in grids.items()}
        with collective_errors(self._comm):
            if self._comm.rank == 0:
                gathered |= self._obstacle_grids(gathered["body"])
                states = {name: replace(g, numbers=numbers) for name, g in gathered.items()}
                self._write_grids(time, states)
        self._last = time

    def _obstacle_grids(self, body: vtu.Grid) -> dict[str, vtu.Grid]:
        """Return surfaces of the rigid obstacles near the body. On the first rank."""
        x = body.points
        box = box_about(np.stack([x, x + body.at_nodes["displacement"]]), _OBSTACLE_MARGIN_RATIO)
        kind = vtu.CELLS["interval" if x.shape[2] == 2 else "triangle"][0]
        return {name: vtu.Grid(kind, shape(box)) for name, shape in self._obstacles.items()}

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.pvd"

    def _write_grids(self, time: float, grids: dict[str, vtu.Grid]) -> None:
        """Write the grids and the updated series. On the first rank."""
        for name in grids:
            if vtu.read_series(self._path(name)) != self._series[name]:
                raise ValueError(
                    f"{self._path(name)} has changed since this Writer wrote or read it: another "
                    "one writes to this folder; use one Writer per folder"
                )
        states, obsolete = {}, []
        with contextlib.ExitStack() as stack:  # replaces files when all are written, series last
            for name in grids:
                earlier = [state for state in self._series[name] if state[0] < time]
                states[name] = [*earlier, (time, f"{name}_{len(earlier):04d}.vtu")]
                obsolete += [file for _, file in self._series[name][len(earlier) + 1 :]]
                vtu.write_series(
                    stack.enter_context(files.atomic_write(self._path(name))), states[name]
                )
            for name, grid in grids.items():
                path = self.folder / states[name][-1][1]
                vtu.write_grid(stack.enter_context(files.atomic_write(path)), grid)
        self._series = states
        for file in obsolete:
            (self.folder / Path(file).name).unlink(missing_ok=True)


class _Body:
    """Grid of the body with displacement and stress. The constructor is collective."""

    def __init__(self, problem: ContactProblem, stress: Any) -> None:
        self._displacement = problem.displacement
        self._mesh = mesh = problem.u.function_space.mesh
        d, name = mesh.geometry.dim, mesh.topology.cell_name()
        kind, degree = basix.CellType[name], problem.displacement.degree
        order = min(degree, 2)
        self._cell_type = vtu.CELLS[name][order - 1]
        nodes = vtu.nodes(name, order)
        vectors = ufl.SpatialCoordinate(mesh), problem.displacement.expression
        parts = [e[i] for e in vectors for i in range(d)]
        self._n_nodes, self._motion = len(nodes), compile_expression(ufl.as_vector(parts), nodes)
        self._stress: fem.Expression | None = None
        if stress is None:
            return
        stress = ufl.as_ufl(stress)
        if stress.ufl_shape not in ((d, d), (3, 3)):
            raise ValueError(
                f"stress has shape {stress.ufl_shape}; it must be ({d}, {d}) or (3, 3)"
            )
        # Interior points: the stress may be undefined on an axis or at a tip.
        inside = basix.create_element(
            basix.ElementFamily.P,
            kind,
            degree - 1,
            basix.LagrangeVariant.gl_isaac,
            discontinuous=True,
        )
        self._shape = stress.ufl_shape
        self._basis = inside.tabulate(0, nodes)[0, :, :, 0]
        self._stress = compile_expression(stress, inside.points)

    def grid(self) -> vtu.Grid:
        """Return the present grid of this rank's cells."""
        mesh, d = self._mesh, self._mesh.geometry.dim
        cells = np.arange(mesh.topology.index_map(mesh.topology.dim).size_local, dtype=np.int32)
        motion = self._motion.eval(mesh, cells).reshape(len(cells), self._n_nodes, 2 * d)
        fields = {"displacement": motion[:, :, d:]}
        if self._stress is not None:
            inside = self._stress.eval(mesh, cells).reshape(
                len(cells), self._basis.shape[1], *self._shape
            )
            stress = np.einsum("np,cpij->cnij", self._basis, inside)
            fields["stress"] = stress
            if self._shape == (3, 3):
                fields["von_mises"] = von_mises(stress)
        return vtu.Grid(self._cell_type, motion[:, :, :d], fields)


class _Surface:
    """Grids of Γc and of its quadrature points. The constructor is collective.

    Attributes:
        series: Names of the two series.
    """

    def __init__(self, contact: Contact) -> None:
        self.series = (contact.name, f"{contact.name}_points")
        self._contact = contact
        surface, displacement = contact.surface, contact.displacement
        self._u = displacement.u
        facets = FacetSet(self._u.function_space, surface.facets)
        name = surface.submesh.topology.cell_name()
        order = min(displacement.degree, 2)
        self._cell_type = vtu.CELLS[name][order - 1]
        nodes = vtu.nodes(name, order)
        n = len(surface.facets)
        self._facets, self._shape = facets, (n, len(nodes), surface.mesh.geometry.dim)
        self._nodes = np.repeat(np.arange(n), len(nodes)), np.tile(nodes, (n, 1))
        self._rows = contact.quadrature.point_rows

    def grids(self) -> tuple[vtu.Grid, vtu.Grid]:
        """Return the present grids of this rank's facets and points. Collective."""
        contact, rows = self._contact, self._rows
        contact.displacement.update()
        x, _ = self._facets.positions(*self._nodes)
        x_deformed, _ = self._facets.positions(*self._nodes, self._u)
        nodes = x.reshape(self._shape)
        at_points = self._values()
        measure = contact.quadrature.weights[rows]
        at_nodes = {
            name: facet_values(contact.points[rows], measure, values[rows], nodes)
            for name, values in at_points.items()
        }
        at_nodes = {"displacement": (x_deformed - x).reshape(self._shape)} | at_nodes
        in_facets: dict[str, npt.NDArray[Any]] = {"status": facet_status(contact)}
        fields: dict[str, npt.NDArray[Any]] = {"displacement": contact.pairs.own_displacement()}
        fields |= {**at_points, "status": contact.status}
        if not contact.contact_kinematics.is_rigid:
            in_facets["paired"] = np.mean(contact.pairs.paired[rows], axis=1)
            fields["paired"] = contact.pairs.paired.astype(np.float64)
        order = np.ravel(rows)  # facet by facet
        points = {name: values[order][:, None] for name, values in fields.items()}
        return (
            vtu.Grid(self._cell_type, nodes, at_nodes, in_facets),
            vtu.Grid(vtu.CELLS["point"][0], contact.points[order][:, None], points),
        )

    def _values(self) -> dict[str, Array]:
        """Return the values at the points, by name. Collective."""
        contact = self._contact
        values = {"pressure": contact.pressure + 0.0}  # no -0
        if contact.contact_kinematics.is_finite:
            values["true_pressure"] = contact.pressure / contact.area_stretch()
        return values | {
            "tangential_traction": contact.tangential_traction,
            "gap": contact.gap,
            "slip": contact.slip.sum(axis=1),
            "normal": contact.values.normal,
        }


def facet_status(contact: Contact) -> npt.NDArray[np.int8]:
    """Return the `Status` of most of the points of every facet of this rank, (n_facets,)."""
    status = contact.status[contact.quadrature.point_rows]
    return np.stack([np.sum(status == s, axis=1) for s in Status]).argmax(axis=0).astype(np.int8)


def _gather(comm: MPI.Comm, grid: vtu.Grid) -> vtu.Grid:
    """Return the grid of all ranks on the first one, this rank's on the others. Collective."""
    rows = grid.points, *grid.at_nodes.values(), *grid.in_cells.values()
    gathered = gather_on_root(comm, *rows)
    if gathered is None:
        return grid
    points, *fields = gathered
    at_nodes = dict(zip(grid.at_nodes, fields, strict=False))
    in_cells = dict(zip(grid.in_cells, fields[len(at_nodes) :], strict=True))
    return replace(grid, points=points, at_nodes=at_nodes, in_cells=in_cells)
