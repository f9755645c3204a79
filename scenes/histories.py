"""Load histories for restarts from checkpoints, and comparisons of their states."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.histories.restart import committed_rows
from fenics_contact.types import Array
from scenes.blocks import RIGHT, TOP, block
from scenes.comparison import is_close, nodal_values, owned_values, point_values
from scenes.elasticity import strain
from scenes.two_blocks import SlidingBlock

COMM = MPI.COMM_WORLD

# ---- scenes --------------------------------------------------------------------------------------


class History:
    """A load history: press until t = 1, slide until 2, slide back until 4."""

    tolerance = 1e-7  # relative difference of two solutions of the same increments
    problem: fc.ContactProblem

    def load(self, t: float) -> None:
        """Set the loads at the time t."""
        raise NotImplementedError

    def increments(self, end: float = 4.0, start: float = 0.0, **options: Any) -> Iterable[fc.Step]:
        """Return the increments from ``start`` to ``end``, by default with t increased by 0.5."""
        options.setdefault("steps", round(abs(end - start) / 0.5))
        return fc.increments(self.problem, self.load, start, end, **options)


class BlockOnBallHistory(History):
    """A block on a ball, by default with friction; its top or the ball has a prescribed motion."""

    def __init__(
        self,
        law: Any = None,
        *,
        cell: str = "quadrilateral",
        obstacle: str = "fixed",
        bulk: str = "linear",
        wall: bool = False,
        surface: dict | None = None,
        contact: dict | None = None,
        n: int = 4,
        E: float = 1000.0,
        radius: float = 2.0,
        tilt: float = 0.0,
        degree: int = 1,
        names: tuple[str, str] = ("floor", "wall"),
        prescribed_components: Sequence[int] | None = None,
        **options: Any,
    ) -> None:
        """Create the unloaded problem.

        ``prescribed_components`` are the components of the displacement that are prescribed on the
        top, by default all.
        """
        scene = self.scene = block(cell, degree, n=n, E=E, surface=surface)
        mesh, d = scene.mesh, scene.dim
        law = law or fc.Coulomb(0.3, k_n=2e4, k_t=1e4)
        self.push = [fem.Constant(mesh, 0.0) for _ in range(d)]
        self.shift = fem.Constant(mesh, np.zeros(d))
        self.force = fem.Constant(mesh, 0.0)
        self.plastic = fem.Function(fem.functionspace(mesh, ("DG", 0)), name="plastic")
        self.loading = obstacle
        displacement: Any = None
        if obstacle == "moving":
            displacement = self.shift
        elif obstacle == "force":
            self.along = fem.Constant(mesh, 0.0)
            displacement = fc.Motion(
                force=(*(None,) * (d - 1), self.force),
                displacement=(self.along, *(0.0,) * (d - 2), None),
            )
        center = np.full(d, 0.5)
        center[-1] = -radius
        center[0] += tilt
        ball = fc.Ball(center, radius, displacement=displacement)
        bcs = [
            scene.dirichlet_bc(TOP, i, self.push[i])
            for i in (range(d) if prescribed_components is None else prescribed_components)
        ]
        F = scene.F
        if bulk != "linear":
            eps = strain(scene.u) - self.plastic * ufl.Identity(d)
            v = ufl.TestFunction(scene.u.function_space)
            stiffening = 1e3 if bulk == "nonlinear" else 900.0
            if bulk != "linear with plastic":
                F += scene.E * stiffening * ufl.tr(eps) ** 3 * ufl.tr(strain(v)) * ufl.dx
            F += scene.E * ufl.tr(eps) * ufl.tr(strain(v)) * ufl.dx
        contacts = [scene.contact(law, obstacle=ball, name=names[0], **(contact or {}))]
        if wall:
            side = fc.ContactSurface(mesh, scene.tags, RIGHT)
            at = np.full(d, 0.5)
            at[0] = 1.01
            rigid = fc.HalfSpace(at, scene.vector(side=-1.0))
            contacts.append(fc.Contact(scene.u, side, rigid, law, name=names[1]))
        self.problem = fc.ContactProblem(F, scene.u, bcs=bcs, contacts=contacts, **options)

    def load(self, t: float) -> None:
        """Set the displacement of the top or of the ball, or the force on the ball."""
        down, along = 0.03 * min(t, 1.0), np.interp(t, [1, 2, 4], [0, 0.1, -0.1])
        if self.loading == "fixed":
            self.push[-1].value, self.push[0].value = -down, along
        elif self.loading == "moving":
            self.shift.value[-1], self.shift.value[0] = down, -along
        else:
            self.force.value, self.along.value = 20 * min(t, 1.0), -along


class BlockOnRamp(SlidingBlock, History):
    """A block dragged up the ramp of another body, with updated pairs and a prescribed top."""

    def __init__(
        self,
        law: Any = None,
        *,
        cell: str = "quadrilateral",
        n: tuple[int, int] = (10, 4),
        start: float = 1.1,
        **options: Any,
    ) -> None:
        """Create the unloaded problem."""
        law = law or fc.Coulomb(0.3, k_n=1e7, k_t=1e7)
        super().__init__(cell, law, start=start, slope=0.1, n=n, **options)

    def load(self, t: float) -> None:
        """Press, drag over one and a half facets of the base, and drag back by half a facet."""
        self.top_displacement[-1].value = -0.004 * min(t, 1.0)
        self.top_displacement[0].value = np.interp(t, [1, 3, 4], [0, 0.6, 0.4])


# ---- states --------------------------------------------------------------------------------------


def collect_state(history: History) -> dict[str, Array]:
    """Return all data of a state, in an order independent of the distribution to ranks."""
    problem = history.problem
    found = {"u": _nodal(problem, problem.u), "increment": np.array([problem.increment])}
    field = fem.Function(problem.u.function_space)
    state, _, internal, external, *_ = committed_rows(problem)
    for name, row in (("state", state), ("internal", internal), ("external", external)):
        owned_values(field)[:] = row[: problem.full.unknowns.n_dofs]
        found[f"committed {name}"] = _nodal(problem, field)
    found["state of obstacles"] = problem.full.unknowns.motions(state)
    energy = problem.state.energy
    found["springs"] = np.array([COMM.allreduce(sum(map(np.sum, energy.springs)))])
    if problem.solver.condensed:
        found["retained dofs"] = problem.solver.system.unknowns.retained
    for c, slip_distances in zip(problem.contacts, energy.contacts, strict=True):
        found[f"{c.name} history"] = point_values(c, c.history.rows())
        found[f"{c.name} jump"] = point_values(c, c.contact_kinematics.committed_jump)
        found[f"{c.name} slip distances"] = point_values(c, np.hstack(slip_distances))
        if c.multipliers is not None:
            found[f"{c.name} multipliers"] = point_values(c, c.multipliers.fields.rows())
        for name, values in c.values.arrays.items():
            found[f"{c.name} {name}"] = point_values(c, np.column_stack([values]))
        found[f"{c.name} status"] = point_values(c, c.status)
        r = c.resultants()
        found[f"{c.name} counts"] = np.array([r.open, r.stick, r.slip, c.pairs.n_unpaired])
        found[f"{c.name} forces"] = np.r_[r.force, r.normal_force, r.tangential_force]
    return found


def _nodal(problem: fc.ContactProblem, field: fem.Function) -> Array:
    """Return nodal values of a field in the space of u, ordered by position."""
    if not problem.displacement.is_mixed:
        return nodal_values(field)
    parts = range(field.function_space.num_sub_spaces)
    return np.concatenate([nodal_values(field.sub(i).collapse()).ravel() for i in parts])


def find_differences(a: History, b: History, tolerance: float) -> list[str]:
    """Return the names of the data that differ between two states.

    With tolerance 0 all data are compared bit for bit, otherwise displacements, contact histories,
    jumps and resultant forces.
    """
    one, other = collect_state(a), collect_state(b)
    assert one.keys() == other.keys()
    if tolerance == 0.0:
        return [n for n in one if not np.array_equal(one[n], other[n], equal_nan=True)]
    # Differences are relative to the largest value; round-off may change the status of a point.
    compared = [n for n in one if n.split()[-1] in ("u", "state", "history", "jump", "forces")]
    return [n for n in compared if not is_close(one[n], other[n], tolerance)]


def have_equal_energies(a: fc.Step, b: fc.Step, tolerance: float) -> bool:
    """Return whether the energies of two steps agree, at best to a round-off of 1e-12."""
    size = abs(b.energy.work) + abs(b.energy.elastic)
    names = ("work", "elastic", "springs", "dissipation", "remainder")
    pairs = [(getattr(a.energy, n), getattr(b.energy, n)) for n in names]
    return all(is_close(x, y, max(tolerance, 1e-12), scale=size) for x, y in pairs)


def assert_restart_equals_uninterrupted(
    make: Callable[[], History],
    folder: Path,
    *,
    stop: int,
    tolerance: float | None = None,
    modify: Callable[[History], None] | None = None,
    **options: Any,
) -> None:
    """Assert that a history restarted after ``stop`` increments equals an uninterrupted one."""
    uninterrupted, interrupted, restarted, finished = (make() for _ in range(4))
    tolerance = uninterrupted.tolerance if tolerance is None else tolerance
    tolerance = 0.0 if COMM.size == 1 else tolerance
    for history in (uninterrupted, interrupted, restarted, finished) if modify else ():
        modify(history)
    expected = list(uninterrupted.increments(checkpoint=folder / "whole.npz", **options))
    path = folder / "broken.npz"
    n = 0
    for _ in interrupted.increments(checkpoint=path, **options):
        n += 1
        if n == stop:
            break
    rest = list(restarted.increments(checkpoint=path, **options))
    assert 0 < len(rest) < len(expected)
    for step, reference in zip(rest, expected[-len(rest) :], strict=True):
        assert step.increment == reference.increment
        assert step.load == reference.load
        assert step.complete == reference.complete
        assert have_equal_energies(step, reference, tolerance)
        if reference.increment_error:
            for name, error in reference.increment_error.items():
                assert is_close(step.increment_error[name], error, max(tolerance, 1e-9))
        for name, r in reference.contacts.items():
            scale = np.abs(r.force).max()
            found = step.contacts[name].force
            assert is_close(found, r.force, tolerance, scale=scale), step.increment
    assert find_differences(restarted, uninterrupted, tolerance) == []
    # A finished history is restored at its end, including results and status.
    assert not list(finished.increments(checkpoint=path, **options))
    assert find_differences(finished, restarted, 0.0 if COMM.size == 1 else 1e-12) == []
    slips = ([c.resultants().slip for c in m.problem.contacts] for m in (finished, restarted))
    assert len({tuple(found) for found in slips}) == 1
