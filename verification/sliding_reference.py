"""The independent solver for finite sliding of two bodies, and its comparison.

Rays along the present normals of the points of Γc are intersected with every opposing facet. Slip
and the rotation of surface and traction are evaluated from the displacements of both bodies; shape
functions distribute the forces to the nodes. The tangent is a finite difference by every dof. Only
the scene and DOLFINx's assembly of the bulk are shared with the package.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import matplotlib.path
import numpy as np
from mpi4py import MPI

from verification import (
    finite_reference,
    fuzz_comparison,
    fuzz_reference,
    fuzz_setup,
    sliding_scenes,
)
from verification import reference_solver as reference

__all__ = ["SlidingComparison", "SlidingContact", "SlidingProblem", "make_problem"]

Array = np.ndarray

# Step of finite differences relative to the mesh size.
_DIFFERENCE = 1e-7
# Numbers of parts into which an increment is divided, in the order of attempts.
_SLIDING_SUBDIVISIONS = (1, 8)
# Relative round-off of positions, whose differences are gaps and strains.
_COORDINATE_ROUND_OFF = 100 * np.finfo(float).eps


@dataclass(eq=False)
class SlidingState(reference.State):
    """Committed state of a contact, with vectors in the committed configuration.

    Attributes:
        jump: Remaining elastic slip with multipliers (length).
        traction: τ, or with multipliers λ_t.
        u: Committed displacement of all nodes (length).
        depth: Penetration at the commit, (n,) (length); None before the first commit.
    """

    u: Array | None = None
    depth: Array | None = None


@dataclass(eq=False)
class SlidingContact(reference.ContactModel):
    """A contact of two bodies at the deformed positions.

    Attributes:
        master: The opposing surface.
        xi: Reference coordinates of the points on Γc.
        outlines: The four sides of both bodies in the plane, slave first.
        max_distance: By facets of both sides, the largest penetration at which a point is paired,
            unless twice the committed penetration of its facet is larger (length).
    """

    master: Any = None
    xi: Any = None
    outlines: Any = None
    max_distance: Any = None

    def initial_state(self) -> SlidingState:
        """Return the state without traction and displacement."""
        zero = np.zeros_like(self.x)
        pressure = None if self.projection is None else np.zeros(len(zero))
        return SlidingState(zero, zero, pressure, None, np.zeros(self.slave.body.nodes_x.size))

    def rotation(self, u: Array, before: Array, rows: Any = slice(None)) -> tuple[Array, ...]:
        """Return present normals, the rotation of Γc since the commit, and committed normals."""
        facet, xi = self.facet[rows], self.xi[rows]
        _, old = self.slave.position(facet, xi, before)
        _, new = self.slave.position(facet, xi, u)
        n_old = self.slave.normal(facet, xi, before)
        n_new = self.slave.normal(facet, xi, u)
        # The gradient maps committed tangents and normal to the present ones.
        start = np.concatenate([old, n_old[:, None]], axis=1)
        end = np.concatenate([new, n_new[:, None]], axis=1)
        gradient = np.swapaxes(np.linalg.solve(start, end), 1, 2)
        if self.d == 2:
            c = gradient[:, 0, 0] + gradient[:, 1, 1]
            s = gradient[:, 1, 0] - gradient[:, 0, 1]
            angle = np.arctan2(s, c)
            c, s = np.cos(angle), np.sin(angle)
            return n_new, np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], 1), n_old
        rotation = gradient
        for _ in range(8):  # Newton's iteration for the polar decomposition
            rotation = 0.5 * (rotation + np.swapaxes(np.linalg.inv(rotation), 1, 2))
        return n_new, rotation, n_old

    def find_opposing_facets(self, u: Array, old: SlidingState) -> Array:
        """Return the number of the opposing facet of every point; -1 without one."""
        depth = np.zeros(len(self.slave.facets))
        if old.depth is not None:
            np.maximum.at(depth, self.facet, old.depth)
        x, _ = self.slave.position(self.facet, self.xi, u)
        n = self.slave.normal(self.facet, self.xi, u)
        count, m = len(x), len(self.master.facets)
        every = np.tile(np.arange(m), count)
        rows = np.repeat(np.arange(count), m)
        xi, far, is_met = self.master.intersect(every, x[rows], n[rows], u)
        is_met &= np.sum(self.master.deformed_normal(every, xi, u) * n[rows], axis=1) < 0
        max_distance = np.maximum(
            self.max_distance[self.facet[rows], every], 2 * depth[self.facet[rows]]
        )
        is_met &= far >= -max_distance
        distance = np.where(is_met, np.abs(far), np.inf).reshape(count, m)
        best = distance.argmin(axis=1)
        return np.where(np.isfinite(distance[np.arange(count), best]), best, -1)

    def evaluate_at(self, u: Array, old: Any) -> dict[str, Array]:
        """Return tractions and local kinematics at a displacement."""
        opposing_facets = self.find_opposing_facets(u, old)
        own, other = (
            self.slave.local(self.facet, u),
            self.master.local(np.maximum(opposing_facets, 0), u),
        )
        return self._evaluate(np.arange(len(opposing_facets)), opposing_facets, own, other, old) | {
            "u": u
        }

    def _evaluate(
        self, rows: Array, opposing_facets: Array, own: Array, other: Array, old: Any
    ) -> dict[str, Array]:
        """Evaluate a subset of points, given the nodal displacements of the cells on both sides."""
        law, facet, xi = self.law, self.facet[rows], self.xi[rows]
        own_before = self.slave.local(facet, old.u)
        n, rotation, n_old = self.rotation(own, own_before, rows)
        paired, partner = opposing_facets >= 0, np.maximum(opposing_facets, 0)
        x, _ = self.slave.position(facet, xi, own)
        at, gap = np.zeros((len(rows), self.d - 1)), np.zeros(len(rows))
        at[paired], gap[paired], _ = self.master.intersect(
            opposing_facets[paired], x[paired], n[paired], other[paired]
        )
        old_position, _ = self.master.position(partner, at, old.u)
        old_ray_end = self.slave.position(facet, xi, own_before)[0] + gap[:, None] * n_old
        slip = np.where(paired[:, None], old_position - old_ray_end, 0.0)

        def project_tangentially(vector: Array) -> Array:
            return vector - np.sum(vector * n, axis=1)[:, None] * n

        def push_forward(vector: Array) -> Array:
            return project_tangentially(np.einsum("qij,qj->qi", rotation, vector))

        step, before = push_forward(slip - old.jump[rows]), push_forward(old.traction[rows])
        pressure = None if old.pressure is None else old.pressure[rows]
        r_n = law.normal_traction(self.k_n[rows], -gap, pressure)
        tau = law.tangential_traction(self.k_t[rows], n, step, before, step, r_n, -gap, None)
        r_n, tau = np.where(paired, r_n, 0.0), np.where(paired[:, None], tau, 0.0)
        found = {"normal": n, "overclosure": -gap, "relative": slip, "slip": step}
        found |= {"tau_old": before, "pairs": opposing_facets, "slave_u": own, "master_u": other}
        found |= {"r_n": r_n, "tau": tau, "traction": r_n[:, None] * n + tau, "rotation": rotation}
        found |= {"tau_local": np.einsum("qji,qj->qi", rotation, tau)}
        weights = self.weights[rows, None]
        nodal_weights = (
            weights * self.slave.shapes(facet, xi),
            -weights * self.master.shapes(partner, at),
        )
        return found | {"nodal_weights": nodal_weights}

    def _nodes(self, opposing_facets: Array) -> tuple[Array, Array]:
        """Return the nodes of the cells of every point on both sides, (n, m) each."""
        slave, master = self.slave, self.master
        partner = np.maximum(opposing_facets, 0)
        return slave.body.nodes[slave.cells[self.facet]], master.body.nodes[master.cells[partner]]

    def force(self, found: dict[str, Array]) -> Array:
        """Return the force on the nodes of both bodies, (N,)."""
        total = np.zeros((self.interpolation.shape[1], self.d))
        for nodes, share in zip(self._nodes(found["pairs"]), found["nodal_weights"], strict=True):
            np.add.at(total, nodes, share[:, :, None] * found["traction"][:, None, :])
        return total.ravel()

    def tangent(self, found: dict[str, Array], old: Any, h: float) -> Array:
        """Return the derivative of `force` by finite differences, (N, N)."""
        opposing_facets, d = found["pairs"], self.d
        n, k = len(opposing_facets), found["slave_u"].shape[1] * d
        dofs = [
            (d * nodes[:, :, None] + np.arange(d)).reshape(n, k)
            for nodes in self._nodes(opposing_facets)
        ]
        dofs = np.concatenate(dofs, axis=1)
        rows, which = (
            g.ravel() for g in np.meshgrid(np.arange(n), np.arange(2 * k), indexing="ij")
        )
        ends = []
        for step in (h, -h):
            local = np.stack([found["slave_u"][rows], found["master_u"][rows]], axis=1)
            local.reshape(len(rows), 2 * k)[np.arange(len(rows)), which] += step
            moved = self._evaluate(rows, opposing_facets[rows], local[:, 0], local[:, 1], old)
            forces = [s[:, :, None] * moved["traction"][:, None, :] for s in moved["nodal_weights"]]
            ends.append(np.stack(forces, axis=1).reshape(n, 2 * k, 2 * k))
        change = np.swapaxes(ends[0] - ends[1], 1, 2) / (2 * h)
        matrix = np.zeros((self.interpolation.shape[1] * d,) * 2)
        np.add.at(matrix, (dofs[:, :, None], dofs[:, None, :]), change)
        return matrix

    def bonded_stiffness(self, found: dict[str, Array]) -> Array:
        """Return the stiffness of springs that bond all points to the opposing body, (N, N)."""
        interpolation = np.zeros((len(self.x), self.interpolation.shape[1]))
        rows = np.arange(len(self.x))[:, None]
        for nodes, share in zip(self._nodes(found["pairs"]), found["nodal_weights"], strict=True):
            np.add.at(interpolation, (rows, nodes), share)
        stiff = np.maximum(self.k_n, self.k_t) / self.weights
        return np.kron(interpolation.T @ (stiff[:, None] * interpolation), np.eye(self.d))

    def augment(self, found: dict[str, Array], old: Any) -> SlidingState:
        """Return the state after one augmentation."""
        pressure = self.projection @ -found["r_n"] if self.law.has_normal else 0 * found["r_n"]
        traction = self.projection @ found["tau_local"] if self.law.has_friction else old.traction
        return SlidingState(old.jump, traction, pressure, None, old.u, old.depth)

    def next_state(self, found: dict[str, Array], old: Any) -> SlidingState:
        """Return the state to commit; ``old`` has the multipliers of the solution."""
        zero, u = np.zeros_like(self.x), found["u"].copy()
        depth = np.where(found["pairs"] >= 0, np.maximum(found["overclosure"], 0.0), 0.0)
        if self.projection is None:
            return SlidingState(zero, found["tau"].copy(), None, None, u, depth)
        left = zero
        if self.law.has_friction:
            left = -self.law.elastic_slip(
                self.k_t, found["normal"], found["tau_old"] - found["tau"]
            )
        traction = np.einsum("qij,qj->qi", found["rotation"], old.traction)
        return SlidingState(left, traction, old.pressure, None, u, depth)


def _distance_to_line(x: Array, surface: Any, u: Array) -> Array:
    """Return the distance of positions (n, 2) from a deformed surface in 2D, (n,).

    Facets of degree 2 are divided into straight parts, because the distance from points on them
    would be wrong by up to half of their spacing.
    """
    n = 17
    parts = fuzz_comparison.sample_surface(surface, u, n)[0].reshape(-1, n, 2)
    start = parts[:, :-1].reshape(-1, 2)
    edge = parts[:, 1:].reshape(-1, 2) - start
    offset = x[:, None] - start
    along = np.clip(np.einsum("pij,ij->pi", offset, edge) / (edge**2).sum(axis=1), 0.0, 1.0)
    return np.linalg.norm(offset - along[..., None] * edge, axis=2).min(axis=1)


class SlidingProblem(finite_reference.FiniteProblem):
    """Two linear or nonlinear bodies with contacts between them."""

    def evaluate(self, u: Array, motion: Array, load: Any, old: list[Any]) -> list[dict]:
        """Evaluate all contacts."""
        return [c.evaluate_at(u, o) for c, o in zip(self.contacts, old, strict=True)]

    def contact_force(self, found: list[dict]) -> list[Array]:
        """Return the nodal forces of every contact on both bodies, (N,) each."""
        return [c.force(f) for c, f in zip(self.contacts, found, strict=True)]

    def shifts(self, load: Any, motion: Array) -> list[Any]:
        """Return None for every contact, as there are no rigid obstacles."""
        return [None for _ in self.contacts]

    def _tangent(
        self, v: Array, m: Array, load: Any, old: list[Any], free_dofs: Array, *, stick: bool
    ) -> Array:
        matrix = self.bulk(v)[1]
        h = _DIFFERENCE * np.ptp(self.body.nodes_x, axis=0).max()
        for c, o in zip(self.contacts, old, strict=True):
            found = c.evaluate_at(v, o)
            matrix = (
                matrix + c.bonded_stiffness(found) if stick else matrix - c.tangent(found, o, h)
            )
        return matrix[np.ix_(free_dofs, free_dofs)]


def make_problem(scene: dict[str, Any]) -> tuple[SlidingProblem, Any, Callable[[int, float], Any]]:
    """Return the independent problem, the setup, and a function of the loads. On one rank."""
    setup = sliding_scenes.SlidingSetup(scene, MPI.COMM_SELF, bulk=finite_reference.rubber_work)
    body, surface = fuzz_reference.make_body(setup)
    contacts = []
    for i, contact in enumerate(scene["contacts"]):
        slave, master = surface(11 + i), surface(21 + i)
        found, (_, xi) = fuzz_reference.make_contact(setup, contact, slave, SlidingContact, master)
        found.master, found.xi = master, xi
        found.outlines = [
            _body_sides(scene, b, surface) for b in (contact["body"], 1 - contact["body"])
        ]
        found.max_distance = np.maximum.outer(slave.cell_heights()[0], master.cell_heights()[0])
        contacts.append(found)
    loads = finite_reference.make_loads(setup)
    bulk = finite_reference.make_bulk(setup, body)
    return (
        SlidingProblem(body, contacts, bulk=bulk, subdivisions=_SLIDING_SUBDIVISIONS),
        setup,
        loads,
    )


def _body_sides(scene: dict[str, Any], body: int, surface: Any) -> list[Any]:
    sides = ("bottom", "right", "top", "left")
    return [surface(fuzz_setup.tag_of(scene, body, side)) for side in sides]


class SlidingComparison(finite_reference.FiniteComparison):
    """Compares the package's increments of two sliding bodies, whose solutions are not unique."""

    @staticmethod
    def _make_problem(scene: dict[str, Any]) -> Any:
        return make_problem(scene)

    def check_increment(self, record: dict[str, Any]) -> None:
        """Compare one committed increment."""
        u = self._nodal_values(record["u"])
        contacts = []
        for c, old, reported in zip(
            self.problem.contacts, self._state, record["contacts"], strict=True
        ):
            if c.projection is not None and c.law.has_friction:
                # The record has λ_t in the present configuration, the state in the committed one.
                back = np.empty_like(reported["lambda_t"])
                row = self._rows_of(c, reported)
                back[row] = np.einsum(
                    "qji,qj->qi", c.rotation(u, old.u)[1], reported["lambda_t"][row]
                )
                reported = reported | {"lambda_t": back}
            contacts.append(reported)
        super().check_increment(record | {"contacts": contacts})

    def _with_multipliers(self, contact: Any, old: Any, record: dict[str, Any]) -> Any:
        if contact.projection is None:
            return old
        row = self._rows_of(contact, record)
        traction = record["lambda_t"][row] if contact.law.has_friction else old.traction
        return SlidingState(old.jump, traction, record["lambda_n"][row], None, old.u, old.depth)

    def _forces(self, u: Array, load: Any, found: list[dict]) -> dict[str, Any]:
        """Add the round-off of positions, of the other body and of the previous increment."""
        forces = super()._forces(u, load, found)
        before = [] if self._before is None else self._before["bodies"]
        most = max(body["rounding"] for body in [*forces["bodies"], *before])
        nodes_x = np.abs(self.problem.body.nodes_x.ravel()) + np.abs(u)
        most += _COORDINATE_ROUND_OFF * float(
            np.linalg.norm(np.diag(self.problem.stiffness(u)) * nodes_x)
        )
        for body in forces["bodies"]:
            body["rounding"] = most
        return forces

    def _check_penetration(self, name: str, u: Array, load: Any, motion: Array, found: Any) -> None:
        """Check the penetration of both surfaces into the opposing body, in 2D."""
        for i, (c, f) in enumerate(zip(self.problem.contacts, found, strict=True)):
            if c.d != 2 or not c.law.has_normal:
                continue
            overclosure = max(float(np.max(f["overclosure"][f["pairs"] >= 0], initial=0.0)), 0.0)
            size = max(float(c.slave.lengths().max()), self._curvature_height)
            loops = [self._outline_points(sides, u) for sides in c.outlines]
            for own, (surface, opposite) in enumerate(((c.slave, c.master), (c.master, c.slave))):
                x = fuzz_comparison.sample_surface(surface, u)[0]
                inside = matplotlib.path.Path(loops[1 - own]).contains_points(x)
                depth = _distance_to_line(x[inside], opposite, u).max(initial=0.0)
                value = depth - overclosure
                self._check(
                    f"{name}, contact {i}",
                    "penetration",
                    value,
                    fuzz_comparison.MAX_PENETRATION * size,
                )

    @staticmethod
    def _outline_points(sides: list[Any], u: Array) -> Array:
        """Return the outline of a body as points, anticlockwise from its lower left corner."""
        rows = []
        for k, side in enumerate(sides):
            x, start, _ = fuzz_comparison.sample_surface(side, u)
            order = np.argsort(start[:, k % 2])
            rows.append(x[order[::-1] if k > 1 else order])
        return np.concatenate(rows)

    def _is_unique(self) -> bool:
        return False
