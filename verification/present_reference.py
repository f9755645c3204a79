"""The second solution where two bodies deform and slide far, and the judge that asks it.

Every point of Γc looks along its present normal through all facets of the opposite surface, one by
one; slip, the turn of the surface and of the committed traction are made anew from both
displacements; forces go to both bodies by the shape functions there. Derivatives of the forces are
differences, node by node. Shared are DOLFINx's assembly of the bulk, and the numbers of the scene.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import matplotlib.path
import numpy as np
import scipy.spatial
from mpi4py import MPI

from verification import finite_reference, fuzz_judge, fuzz_made, fuzz_models, present_scenes
from verification import reference_solver as reference

__all__ = ["PresentContact", "PresentJudge", "PresentProblem", "model"]

Array = np.ndarray

# Steps of differences, by the size of the mesh.
_DIFFERENCE = 1e-7
# Parts into which an increment is cut, tried in turn: that of the package is long enough, mostly.
_PARTS = (1, 8)
# Round-off of places, by the diagonal of K: differences of them are gaps, and strains.
_PLACES = 100 * np.finfo(float).eps


@dataclass(eq=False)
class PresentState(reference.State):
    """History of points; vectors in the bodies as they were committed.

    Attributes:
        jump: What of the slip has not been taken back by friction, with multipliers (length).
        traction: τ, or with multipliers λ_t.
        u: The displacement committed.
        depth: In the opposite then, (n,) (length); None before the first commit.
    """

    u: Array | None = None
    depth: Array | None = None


@dataclass(eq=False)
class PresentContact(reference.ContactModel):
    """Γc and the opposite surface at the present places.

    Attributes:
        there: The opposite surface.
        xi: Reference coordinates of the points on Γc.
        outlines: In the plane, of the bodies with Γc and opposite: their four sides in turn.
        reach: How far behind a point its partner may be, by pairs of facets (length); or twice as
            deep as points of its facet have been.
    """

    there: Any = None
    xi: Any = None
    outlines: Any = None
    reach: Any = None

    def start(self) -> PresentState:
        """No traction, no displacement."""
        zero = np.zeros_like(self.x)
        pressure = None if self.project is None else np.zeros(len(zero))
        return PresentState(zero, zero, pressure, None, np.zeros(self.here.body.places.size))

    def turned(self, u: Array, before: Array, rows: Any = slice(None)) -> tuple[Array, ...]:
        """Present normals, the turn of the surface since, and the normals then."""
        facet, xi = self.facet[rows], self.xi[rows]
        _, old = self.here.place(facet, xi, before)
        _, new = self.here.place(facet, xi, u)
        n_old = self.here.normal(facet, xi, before)
        n_new = self.here.normal(facet, xi, u)
        # The gradient takes the tangents then, and the normal, to those now.
        start = np.concatenate([old, n_old[:, None]], axis=1)
        end = np.concatenate([new, n_new[:, None]], axis=1)
        gradient = np.swapaxes(np.linalg.solve(start, end), 1, 2)
        if self.d == 2:
            c = gradient[:, 0, 0] + gradient[:, 1, 1]
            s = gradient[:, 1, 0] - gradient[:, 0, 1]
            angle = np.arctan2(s, c)
            c, s = np.cos(angle), np.sin(angle)
            return n_new, np.stack([np.stack([c, -s], 1), np.stack([s, c], 1)], 1), n_old
        turn = gradient
        for _ in range(8):  # Newton's iteration for the polar decomposition
            turn = 0.5 * (turn + np.swapaxes(np.linalg.inv(turn), 1, 2))
        return n_new, turn, n_old

    def partners(self, u: Array, old: PresentState) -> Array:
        """The facet that every point looks at, -1 without."""
        deep = np.zeros(len(self.here.facets))
        if old.depth is not None:
            np.maximum.at(deep, self.facet, old.depth)
        x, _ = self.here.place(self.facet, self.xi, u)
        n = self.here.normal(self.facet, self.xi, u)
        count, m = len(x), len(self.there.facets)
        every = np.tile(np.arange(m), count)
        rows = np.repeat(np.arange(count), m)
        xi, far, met = self.there.meet(every, x[rows], n[rows], u)
        met &= np.sum(self.there.normal_moved(every, xi, u) * n[rows], axis=1) < 0
        reach = np.maximum(self.reach[self.facet[rows], every], 2 * deep[self.facet[rows]])
        met &= far >= -reach
        distance = np.where(met, np.abs(far), np.inf).reshape(count, m)
        best = distance.argmin(axis=1)
        return np.where(np.isfinite(distance[np.arange(count), best]), best, -1)

    def respond_at(self, u: Array, old: Any) -> dict[str, Array]:
        """Tractions, and what they follow from, at a displacement."""
        hit = self.partners(u, old)
        own, other = self.here.local(self.facet, u), self.there.local(np.maximum(hit, 0), u)
        return self._respond(np.arange(len(hit)), hit, own, other, old) | {"u": u}

    def _respond(
        self, rows: Array, hit: Array, own: Array, other: Array, old: Any
    ) -> dict[str, Array]:
        """Of some points, by the displacements of the nodes of the cells on both sides."""
        law, facet, xi = self.law, self.facet[rows], self.xi[rows]
        own_before = self.here.local(facet, old.u)
        n, turn, n_old = self.turned(own, own_before, rows)
        met, partner = hit >= 0, np.maximum(hit, 0)
        x, _ = self.here.place(facet, xi, own)
        at, gap = np.zeros((len(rows), self.d - 1)), np.zeros(len(rows))
        at[met], gap[met], _ = self.there.meet(hit[met], x[met], n[met], other[met])
        was, _ = self.there.place(partner, at, old.u)
        looked = self.here.place(facet, xi, own_before)[0] + gap[:, None] * n_old
        way = np.where(met[:, None], was - looked, 0.0)

        def across(vector: Array) -> Array:
            return vector - np.sum(vector * n, axis=1)[:, None] * n

        def ahead(vector: Array) -> Array:
            return across(np.einsum("qij,qj->qi", turn, vector))

        step, before = ahead(way - old.jump[rows]), ahead(old.traction[rows])
        pressure = None if old.pressure is None else old.pressure[rows]
        r_n = law.normal(self.k_n[rows], -gap, pressure)
        tau = law.tangential(self.k_t[rows], n, step, before, step, r_n, -gap, None)
        r_n, tau = np.where(met, r_n, 0.0), np.where(met[:, None], tau, 0.0)
        found = {"normal": n, "closing": -gap, "relative": way, "step": step, "before": before}
        found |= {"r_n": r_n, "tau": tau, "traction": r_n[:, None] * n + tau, "turn": turn}
        found |= {"framed": np.einsum("qji,qj->qi", turn, tau), "hit": hit, "own": own}
        weights = self.weights[rows, None]
        shares = weights * self.here.shapes(facet, xi), -weights * self.there.shapes(partner, at)
        return found | {"other": other, "shares": shares}

    def _nodes(self, hit: Array) -> tuple[Array, Array]:
        """Of the cells on both sides, (n, m) each."""
        here, there = self.here, self.there
        partner = np.maximum(hit, 0)
        return here.body.nodes[here.cells[self.facet]], there.body.nodes[there.cells[partner]]

    def force(self, found: dict[str, Array]) -> Array:
        """On the nodes of both bodies, (N,)."""
        total = np.zeros((self.interpolation.shape[1], self.d))
        for nodes, share in zip(self._nodes(found["hit"]), found["shares"], strict=True):
            np.add.at(total, nodes, share[:, :, None] * found["traction"][:, None, :])
        return total.ravel()

    def tangent(self, found: dict[str, Array], old: Any, reach: float) -> Array:
        """Derivative of `force`, by differences point by point, (N, N)."""
        hit, d = found["hit"], self.d
        n, k = len(hit), found["own"].shape[1] * d
        dofs = [(d * nodes[:, :, None] + np.arange(d)).reshape(n, k) for nodes in self._nodes(hit)]
        dofs = np.concatenate(dofs, axis=1)
        rows, which = (
            g.ravel() for g in np.meshgrid(np.arange(n), np.arange(2 * k), indexing="ij")
        )
        ends = []
        for step in (reach, -reach):
            local = np.stack([found["own"][rows], found["other"][rows]], axis=1)
            local.reshape(len(rows), 2 * k)[np.arange(len(rows)), which] += step
            moved = self._respond(rows, hit[rows], local[:, 0], local[:, 1], old)
            forces = [s[:, :, None] * moved["traction"][:, None, :] for s in moved["shares"]]
            ends.append(np.stack(forces, axis=1).reshape(n, 2 * k, 2 * k))
        change = np.swapaxes(ends[0] - ends[1], 1, 2) / (2 * reach)
        matrix = np.zeros((self.interpolation.shape[1] * d,) * 2)
        np.add.at(matrix, (dofs[:, :, None], dofs[:, None, :]), change)
        return matrix

    def held(self, found: dict[str, Array]) -> Array:
        """That of springs that hold all points to their partners every way, (N, N)."""
        across = np.zeros((len(self.x), self.interpolation.shape[1]))
        rows = np.arange(len(self.x))[:, None]
        for nodes, share in zip(self._nodes(found["hit"]), found["shares"], strict=True):
            np.add.at(across, (rows, nodes), share)
        stiff = np.maximum(self.k_n, self.k_t) / self.weights
        return np.kron(across.T @ (stiff[:, None] * across), np.eye(self.d))

    def augment(self, found: dict[str, Array], old: Any) -> PresentState:
        """One round: the multipliers that the tractions found make."""
        pressure = self.project @ -found["r_n"] if self.law.has_normal else 0 * found["r_n"]
        traction = self.project @ found["framed"] if self.law.slips else old.traction
        return PresentState(old.jump, traction, pressure, None, old.u, old.depth)

    def next_state(self, found: dict[str, Array], old: Any) -> PresentState:
        """History of the next increment; ``old`` with the multipliers it was found with."""
        zero, u = np.zeros_like(self.x), found["u"].copy()
        depth = np.where(found["hit"] >= 0, np.maximum(found["closing"], 0.0), 0.0)
        if self.project is None:
            return PresentState(zero, found["tau"].copy(), None, None, u, depth)
        left = zero
        if self.law.slips:
            left = -self.law.stretch(self.k_t, found["normal"], found["before"] - found["tau"])
        traction = np.einsum("qij,qj->qi", found["turn"], old.traction)
        return PresentState(left, traction, old.pressure, None, u, depth)


class PresentProblem(finite_reference.FiniteProblem):
    """Two bodies that may be nonlinear, and contacts between them."""

    def respond(self, u: Array, motion: Array, load: Any, old: list[Any]) -> list[dict]:
        """Tractions of every contact."""
        return [c.respond_at(u, o) for c, o in zip(self.contacts, old, strict=True)]

    def contact_force(self, found: list[dict]) -> list[Array]:
        """Force of every contact on the bodies, (N,) each."""
        return [c.force(f) for c, f in zip(self.contacts, found, strict=True)]

    def shifts(self, load: Any, motion: Array) -> list[Any]:
        """Nothing moves but the bodies."""
        return [None for _ in self.contacts]

    def _tangent(
        self, v: Array, m: Array, load: Any, old: list[Any], kept: Array, *, closed: bool
    ) -> Array:
        matrix = self.bulk(v)[1]
        reach = _DIFFERENCE * np.ptp(self.body.places, axis=0).max()
        for c, o in zip(self.contacts, old, strict=True):
            found = c.respond_at(v, o)
            matrix = matrix + c.held(found) if closed else matrix - c.tangent(found, o, reach)
        return matrix[np.ix_(kept, kept)]


def model(scene: dict[str, Any]) -> tuple[PresentProblem, Any, Callable[[int, float], Any]]:
    """The second problem, and its loads by stage and load parameter. On one rank."""
    made = present_scenes.PresentMade(scene, MPI.COMM_SELF, bulk=finite_reference.rubber)
    body, surface = fuzz_models.body_of(made)
    contacts = []
    for i, contact in enumerate(scene["contacts"]):
        here, there = surface(11 + i), surface(21 + i)
        found, (_, xi) = fuzz_models.contact_of(made, contact, here, PresentContact, there)
        found.there, found.xi = there, xi
        found.outlines = [
            _outline(scene, b, surface) for b in (contact["body"], 1 - contact["body"])
        ]
        found.reach = np.maximum.outer(here.heights()[0], there.heights()[0])
        contacts.append(found)
    loads = finite_reference.loads_of(made)
    bulk = finite_reference.bulk_of(made, body)
    return PresentProblem(body, contacts, bulk=bulk, parts=_PARTS), made, loads


def _outline(scene: dict[str, Any], body: int, surface: Any) -> list[Any]:
    sides = ("bottom", "right", "top", "left")
    return [surface(fuzz_made.tag_of(scene, body, side)) for side in sides]


class PresentJudge(finite_reference.FiniteJudge):
    """Takes the package's increments one by one; see `FiniteJudge`. No solution is unique."""

    @staticmethod
    def _model(scene: dict[str, Any]) -> Any:
        return model(scene)

    def take(self, record: dict[str, Any]) -> None:
        """Judge one committed increment."""
        u = self._numbered(record["u"])
        contacts = []
        for c, old, told in zip(self.problem.contacts, self._old, record["contacts"], strict=True):
            if c.project is not None and c.law.slips:
                # The file has them in the bodies as they are now; the increment began before.
                back = np.empty_like(told["lambda_t"])
                row = self._rows(c, told)
                back[row] = np.einsum("qji,qj->qi", c.turned(u, old.u)[1], told["lambda_t"][row])
                told = told | {"lambda_t": back}
            contacts.append(told)
        super().take(record | {"contacts": contacts})

    def _with_multipliers(self, contact: Any, old: Any, record: dict[str, Any]) -> Any:
        if contact.project is None:
            return old
        row = self._rows(contact, record)
        traction = record["lambda_t"][row] if contact.law.slips else old.traction
        return PresentState(old.jump, traction, record["lambda_n"][row], None, old.u, old.depth)

    def _forces(self, u: Array, load: Any, found: list[dict]) -> dict[str, Any]:
        """Round-off is that of places, too; of what a body touches; of where it began."""
        forces = super()._forces(u, load, found)
        before = [] if self._before is None else self._before["bodies"]
        most = max(body["rounding"] for body in [*forces["bodies"], *before])
        places = np.abs(self.problem.body.places.ravel()) + np.abs(u)
        most += _PLACES * float(np.linalg.norm(np.diag(self.problem.stiffness(u)) * places))
        for body in forces["bodies"]:
            body["rounding"] = most
        return forces

    def _check_geometry(self, name: str, u: Array, load: Any, motion: Array, found: Any) -> None:
        """Depth of either surface inside of the other body, in the plane; see `Judge`."""
        for i, (c, f) in enumerate(zip(self.problem.contacts, found, strict=True)):
            if c.d != 2 or not c.law.has_normal:
                continue
            borne = max(float(np.max(f["closing"][f["hit"] >= 0], initial=0.0)), 0.0)
            size = max(float(c.here.lengths().max()), self._bulge)
            loops = [self._loop(sides, u) for sides in c.outlines]
            for own, (surface, opposite) in enumerate(((c.here, c.there), (c.there, c.here))):
                x = fuzz_judge.along(surface, u)[0]
                inside = matplotlib.path.Path(loops[1 - own]).contains_points(x)
                wall = scipy.spatial.cKDTree(fuzz_judge.along(opposite, u, 65)[0])
                deep = np.where(inside, wall.query(x)[0], 0.0).max()
                value = deep - borne
                self._check(
                    f"{name}, contact {i}", "penetration", value, fuzz_judge.UNRESISTED * size
                )

    @staticmethod
    def _loop(sides: list[Any], u: Array) -> Array:
        """Places around a body, anticlockwise from its lower left corner."""
        rows = []
        for k, side in enumerate(sides):
            x, start, _ = fuzz_judge.along(side, u)
            order = np.argsort(start[:, k % 2])
            rows.append(x[order[::-1] if k > 1 else order])
        return np.concatenate(rows)

    def _unique(self) -> bool:
        return False
