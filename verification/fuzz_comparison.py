"""Comparison of the package's increments with the independent solver (`reference_solver`).

The comparison uses two histories. The first evaluates equations, laws and results at the
displacements of the package, and does not require a unique solution. The second is solved
independently: a difference from it is an error if the laws permit one solution only, otherwise
"another" solution.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse.csgraph
import scipy.spatial
import scipy.spatial.distance

from verification import fuzz_reference, fuzz_scenes
from verification import reference_solver as reference

__all__ = ["MAX_PENETRATION", "Comparison", "sample_surface"]

Array = np.ndarray

# Residual relative to the solver's tolerance. SNES stops below 1, the verdict accepts 2; here
# norms are those of single bodies.
_RESIDUAL_RATIO = 30.0
# Round-off of a displacement increment, relative to the previous displacement.
_DISPLACEMENT_ROUND_OFF = 16 * np.finfo(float).eps
# Round-off of K u.
_RESIDUAL_ROUND_OFF = 1000 * np.finfo(float).eps
# Relative difference of sums over the quadrature points for the same u.
_SUM_TOLERANCE = 1e-9
# Relative difference of integrals between curved facets, divided by the square of their slope.
# Measured: 3 for bodies bent by 2e-6 to 2e-4.
_CURVED_INTEGRATION_ERROR = 5.0
# Relative difference of the smoothed E/h on distorted quadrilaterals with rational integrands.
# Measured: 1.4e-8 of the pressure.
_SMOOTHED_MODULUS_ERROR, _STIFFNESS_NAMES = 1e-7, ("k_n", "k_t")
# Largest penetration with multipliers, relative to the size of Γc.
_MULTIPLIER_PENETRATION = 1e-2
# Error of initial positioning relative to the size of the bodies, and its round-off.
_POSITION_TOLERANCE, _POSITION_ROUND_OFF = 1e-6, 1e-13
# Penetration between quadrature points minus that at the points, relative to the facet length. The
# package accepts 20 % if the points predict it, and 2 % for the quadrature.
MAX_PENETRATION = 0.2
# Relative change of the contact force with geometry at the deformed positions; the package refuses
# a first-order estimate above 20 %.
_FORCE_CHANGE, _REFUSED_FORCE_CHANGE = 0.5, 0.2
# Distance relative to the mesh size beyond which a solution is on another branch.
_BRANCH_DISTANCE = 0.1
# Depth of the surface of a narrow rod between points, relative to the facet length.
_ROD_DEPTH = 0.07
# Number of parts of an increment in which the path of a rod is evaluated.
_N_ROD_SUBSTEPS = 64
# Relative difference of forces from the nearest exact solution, and from the independent history;
# and from the latter if friction multipliers are not unique at the edge of Γc.
_NEAREST_FORCE_TOLERANCE, _INDEPENDENT_FORCE_TOLERANCE = 1e-5, 1e-4
_NONUNIQUE_FORCE_TOLERANCE = 1e-2


def sample_surface(surface: Any, u: Array, n: int = 9) -> tuple[Array, Array, Array]:
    """Return deformed and undeformed positions of points on a surface, and their facets."""
    grid = np.linspace(0, 1, n if surface.d == 2 else 5)
    at = np.stack([g.ravel() for g in np.meshgrid(*[grid] * (surface.d - 1))], axis=1)
    if surface.simplex:
        at = at[at.sum(axis=1) <= 1 + 1e-12]
    facet = np.repeat(np.arange(len(surface.facets)), len(at))
    xi = np.tile(at, (len(surface.facets), 1))
    return surface.position(facet, xi, u)[0], surface.position(facet, xi)[0], facet


class Comparison:
    """Compares the package's increments with the independent solver, one by one.

    Attributes:
        failed_checks: Descriptions of failed checks.
        other_solutions: Differences that the laws permit, because the solution is not unique.
        not_compared: Increments and checks in which the independent solver has failed.
        error_ratios: By check, the largest ratio of error to tolerance.
    """

    def __init__(self, scene: dict[str, Any]) -> None:
        """Create the independent problem twice, for both histories."""
        self.scene = scene
        self.failed_checks: list[str] = []
        self.other_solutions: list[str] = []
        self.not_compared: list[str] = []
        self.error_ratios: dict[str, float] = {}
        # The error of integrals between curved facets is proportional to the square of their slope.
        paired = any(c["obstacle"]["kind"] == "body" for c in scene["contacts"])
        slope = 4 * sum(map(abs, scene.get("bend", [0.0])))
        self._integration_error = _CURVED_INTEGRATION_ERROR * slope**2 if paired else 0.0
        scaled = any(
            (c["law"].get(k) or [""])[0] == "scaled"
            for c in scene["contacts"]
            for k in _STIFFNESS_NAMES
        )
        if scaled and scene["cell"] == "hexahedron" and any(b["jitter"] for b in scene["bodies"]):
            self._integration_error += _SMOOTHED_MODULUS_ERROR
        self.problem, setup, self._load = self._make_problem(scene)
        self._curvature_height = sum(map(abs, scene.get("bend", []))) * setup.length
        self._translation = setup.length * float(np.abs(scene.get("translation", [0.0])).max())
        self._earlier_penetration: dict[int, float] = {}  # largest one by contact
        self._other = self._make_problem(scene)[0]
        self.problem.largest_translation = self._other.largest_translation = self._translation
        self._moduli = setup.moduli
        n, m = self.problem.body.nodes_x.size, len(self.problem.free_motions())
        self._u, self._motion = np.zeros(n), np.zeros(m)
        self._other_u, self._other_motion = np.zeros(n), np.zeros(m)
        self._state = [c.initial_state() for c in self.problem.contacts]
        self._other_state = [c.initial_state() for c in self._other.contacts]
        self._before: dict[str, Any] | None = None
        self._rod_states: dict[int, tuple[Array, Array, Array]] = {}  # by contact
        self._other_failed = False
        self._tree = None

    @staticmethod
    def _make_problem(scene: dict[str, Any]) -> Any:
        return fuzz_reference.make_problem(scene)

    # ---- increments ------------------------------------------------------------------------------

    def check_increment(self, record: dict[str, Any]) -> None:
        """Check one committed increment."""
        name = f"stage {record['stage']} at {record['load']:.4g}"
        problem, load = self.problem, self._load(record["stage"], record["load"])
        self._change_friction(record["stage"])
        self._repeat_pair_updates(record)
        self._check_slip_resets(name, record, load)
        u = self._nodal_values(record["u"])
        motion = np.array([record["contacts"][c]["motion"][i] for c, i in problem.free_motions()])
        old = [
            self._with_multipliers(c, o, r)
            for c, o, r in zip(problem.contacts, self._state, record["contacts"], strict=True)
        ]
        found = problem.evaluate(u, motion, load, old)
        for c, f, r in zip(problem.contacts, found, record["contacts"], strict=True):
            self._resolve_status(c, f, r)
        now = self._forces(u, load, found)
        rtol = record["rtol"]

        miss = np.abs(u[load.fixed] - load.values).max(initial=0.0)
        allowed = (
            1e-12 * max(np.abs(u).max(), 1e-300) + _DISPLACEMENT_ROUND_OFF * np.abs(self._u).max()
        )
        self._check(name, "conditions", miss, allowed)
        self._check_equations(name, now, rtol)
        for i, (c, f, r) in enumerate(
            zip(problem.contacts, found, record["contacts"], strict=True)
        ):
            self._check_results(f"{name}, contact {i}", c, f, r)
            self._check_multipliers(f"{name}, contact {i}", c, f, r, load.fixed)
        self._check_opposite_penetration(name, u, found, now)
        self._check_penetration(name, u, load, motion, found)
        self._check_kinematics(name, u, motion, load, old, now)
        self._check_energy(name, record, u, motion, load, found, now)
        self._check_nearest(name, record, u, motion, load, old, found, now)
        self._check_independent(name, record, load, now)

        self._state = [
            c.next_state(f, o) for c, f, o in zip(problem.contacts, found, old, strict=True)
        ]
        now |= {"u": u, "motion": motion, "load": load, "found": found}
        # Before the update of pairs, in which points may lose the energy of their springs.
        now["springs"] = sum(
            c.stored_energy(f) for c, f in zip(problem.contacts, found, strict=True)
        )
        self._update_pairs(problem, self._state, u, record)
        self._before, self._u, self._motion = now, u, motion

    def try_next_load(self, stage: int, t: float) -> str:
        """Solve the next increment with the independent solver only.

        Returns:
            "not solved apart"; "solved apart"; or "rightly" with the geometrical checks that the
            solution fails, which justify a refusal.
        """
        load = self._load(stage, t)
        self._change_friction(stage)
        try:
            u, motion, old = self.problem.solve(self._u, self._motion, load, self._state)
        except (reference.NotSolved, np.linalg.LinAlgError):
            return "not solved apart"
        before, self.failed_checks, self.error_ratios = (
            (self.failed_checks, self.error_ratios),
            [],
            {},
        )
        found = self.problem.evaluate(u, motion, load, old)
        now = self._forces(u, load, found)
        self._check_opposite_penetration("", u, found, now)
        self._check_penetration("", u, load, motion, found)
        self._check_kinematics("", u, motion, load, old, now)
        limits = {"kinematics": _REFUSED_FORCE_CHANGE / _FORCE_CHANGE}
        error = sorted(n for n, ratio in self.error_ratios.items() if ratio > limits.get(n, 1.0))
        self.failed_checks, self.error_ratios = before
        return f"rightly: {', '.join(error)}" if error else "solved apart"

    def _change_friction(self, stage: int) -> None:
        """Set the friction coefficients of a stage in both histories."""
        for i, friction in enumerate(fuzz_scenes.frictions(self.scene, stage)):
            if friction is not None:
                for history in (self.problem, self._other):
                    history.contacts[i].law.friction = friction

    def _check(self, where: str, what: str, value: float, allowed: float, text: str = "") -> bool:
        with np.errstate(all="ignore"):
            ratio = float(value / allowed) if allowed > 0 else (0.0 if value == 0 else np.inf)
        if not np.isfinite(value):
            ratio = np.inf
        self.error_ratios[what] = max(self.error_ratios.get(what, 0.0), ratio)
        if ratio > 1.0:
            self.failed_checks.append(f"{what}: {where}: {value:.3g} above {allowed:.3g}{text}")
        return ratio <= 1.0

    def _nodal_values(self, rows: Array) -> Array:
        """Return the displacement at the nodes of the independent problem."""
        d, body = self.problem.body.d, self.problem.body
        size = np.ptp(body.nodes_x, axis=0).max()
        far = 10 * size
        mine = np.column_stack([body.body_numbers * far, body.nodes_x])
        distance, row = scipy.spatial.cKDTree(
            np.column_stack([rows[:, 0] * far, rows[:, 1 : d + 1]])
        ).query(mine)
        assert distance.max() < 1e-9 * size
        return rows[row, d + 1 :].ravel().copy()

    def _check_slip_resets(self, name: str, record: dict[str, Any], load: Any) -> None:
        """Set the slip reference at the state recorded by the package, and check the state.

        At first touch the largest overclosure of coupled bodies is zero. Positioned bodies have
        moved rigidly, into contact, and without deeper penetration. Points with a new reference
        were unloaded.
        """
        problem, old = self.problem, list(self._state)
        # Bodies are positioned on obstacles at their committed positions.
        load = self._before["load"] if self._before else self._load(0, 0.0)
        size = np.ptp(problem.body.nodes_x, axis=0).max()
        before, groups = self._u, self._groups()
        touching = np.full(len(groups), -np.inf)  # by group, largest overclosure at first touch
        for i, record_i in enumerate(record["contacts"]):
            reported, model = record_i["slip_reset"], problem.contacts[i]
            if reported is None:
                continue
            u = self._nodal_values(reported["u"])
            if reported["rigid"]:
                then, now = (problem.evaluate(v, self._motion, load, old) for v in (before, u))
                # Groups of coupled bodies are positioned one after the other.
                mine = [(n, c) for n, c in enumerate(problem.contacts) if groups[n] == groups[i]]
                depth, deeper = (
                    max(at[n]["overclosure"][c.paired].max(initial=-np.inf) for n, c in mine)
                    for at in (then, now)
                )
                found = now[i]
                strain = self._non_rigid_part(u - before, before, load)
                allowed = (
                    _POSITION_TOLERANCE * np.abs(u - before).max() + _POSITION_ROUND_OFF * size
                )
                self._check(name, "positioning rigid", strain, allowed)
                deeper_by = deeper - max(depth, 0.0)
                self._check(name, "positioning depth", deeper_by, _POSITION_TOLERANCE * size)
                self._check(name, "positioning gap", -deeper, _POSITION_TOLERANCE * size)
            else:
                found = self._first_touch(model, record_i, u, old[i])
                overclosure = found["overclosure"][model.paired].max()
                touching[groups[i]] = max(touching[groups[i]], overclosure)
            unloaded = reported["unloaded"][self._rows_of(model, record_i)]
            if self._before is not None:
                traction = np.abs(self._before["found"][i]["r_n"])
                rounding = sum(b["rounding"] for b in self._before["bodies"])
                force = model.weights @ (traction * unloaded)
                self._check(name, "positioning load", force, rounding)
            self._state[i] = model.reset_slip(found, old[i], unloaded)
            own, state = self._other.contacts[i], self._other_state[i]
            if reported["rigid"]:
                self._other_u = u  # initial guess
                other = self._other.evaluate(u, self._other_motion, load, self._other_state)[i]
            else:
                other = self._first_touch(own, record_i, u, state)
            self._other_state[i] = own.reset_slip(other, state, unloaded)
        for miss in np.abs(touching[touching > -np.inf]):
            self._check(name, "first touch", float(miss), _POSITION_TOLERANCE * size)

    def _groups(self) -> Array:
        """Return the number of the group of coupled bodies of every contact."""
        contacts, n = self.scene["contacts"], len(self.scene["bodies"])
        bodies = [(c["body"], c["obstacle"].get("body", c["body"])) for c in contacts]
        graph = scipy.sparse.coo_matrix((np.ones(len(bodies)), np.transpose(bodies)), (n, n))
        _, group = scipy.sparse.csgraph.connected_components(graph, directed=False)
        return np.asarray(group[[body for body, _ in bodies]])

    def _first_touch(
        self, model: Any, record: dict[str, Any], u: Array, old: Any
    ) -> dict[str, Any]:
        """Evaluate a contact at the first touch, which may be within an obstacle's motion."""
        if hasattr(model, "evaluate_at"):
            return model.evaluate_at(u, old)
        jump = record["slip_reset"]["jump"][self._rows_of(model, record)]
        return model.evaluate(jump, model.initial_position(), old)

    def _non_rigid_part(self, displacement: Array, before: Array, load: Any) -> float:
        """Return the largest non-rigid part of a displacement of free nodes (length)."""
        body, d = self.problem.body, self.problem.body.d
        free = np.ones(displacement.size, dtype=bool)
        free[load.fixed] = False
        free = free.reshape(-1, d).all(axis=1)
        error = [0.0]
        for b in range(body.body_numbers.max() + 1):
            own = free & (body.body_numbers == b)
            if not own.any():
                continue
            x, w = (body.nodes_x + before.reshape(-1, d))[own], displacement.reshape(-1, d)[own]
            if self.scene.get("bulk", "linear") == "linear":  # rigid for small rotations
                x = body.nodes_x[own]
                i, j = np.triu_indices(len(x), 1)
                stretch = np.sum((x[i] - x[j]) * (w[i] - w[j]), axis=1) / np.ptp(x, axis=0).max()
            else:
                start, end = (scipy.spatial.distance.pdist(y) for y in (x, x + w))
                stretch = end - start
            error.append(np.abs(stretch).max(initial=0.0))
        return float(max(error))

    def _with_multipliers(self, contact: Any, old: Any, record: dict[str, Any]) -> Any:
        if contact.projection is None:
            return old
        row = self._rows_of(contact, record)
        traction = old.traction
        if contact.law.has_friction:
            traction = record["lambda_t"][row]
        return reference.State(old.jump, traction, record["lambda_n"][row])

    def _resolve_status(self, contact: Any, found: dict, record: dict[str, Any]) -> None:
        """Adopt the package's τ at points whose gap is zero up to round-off.

        τ of a foundation without tension is discontinuous there, and both values are solutions.
        """
        if contact.law.kind != "foundation" or contact.law.tension:
            return
        doubtful = contact.k_n * np.abs(found["overclosure"]) <= self._roundoff(contact, found)
        doubtful &= contact.paired
        n = found["normal"]
        across = found["relative"] - np.sum(found["relative"] * n, axis=1)[:, None] * n
        reported = np.linalg.norm(record["tangential"][self._rows_of(contact, record)], axis=1) > 0
        tau = np.where(reported[:, None], -contact.k_t[:, None] * across, 0.0)
        found["tau"] = np.where(doubtful[:, None], tau, found["tau"])
        found["traction"] = found["r_n"][:, None] * n + found["tau"]

    def _rows_of(self, contact: Any, record: dict[str, Any]) -> Array:
        distance, row = scipy.spatial.cKDTree(record["points"]).query(contact.x)
        assert distance.max() < 1e-9 * (np.ptp(contact.x, axis=0).max() or 1.0)
        return row

    def _forces(self, u: Array, load: Any, found: list[dict]) -> dict[str, Any]:
        """Return residual, forces and round-off of every body, and forces of every contact."""
        problem = self.problem
        total, motion = problem.residual(u, load, found)
        parts = np.repeat(problem.body.body_numbers, problem.body.d)
        forces = problem.contact_force(found)
        fixed = np.zeros(len(u), dtype=bool)
        fixed[load.fixed] = True
        moved = np.abs(u)
        if self.scene.get("bulk") == "rubber":
            # I + ∇u has the round-off of 1 even for u = 0.
            cells = min(min(body["n"]) for body in self.scene["bodies"])
            moved = moved + np.ptp(problem.body.nodes_x, axis=0).max() / cells
        rounding = _RESIDUAL_ROUND_OFF * (np.abs(problem.stiffness(u)) @ moved)
        for c, f in zip(problem.contacts, found, strict=True):
            each = np.abs(c.interpolation).T @ (c.weights * self._roundoff(c, f))
            rounding += np.repeat(each, c.d)
        bodies = []
        for b in range(parts.max() + 1):
            own = parts == b
            sizes = [np.linalg.norm(load.force[own & ~fixed]), np.linalg.norm(total[own & fixed])]
            sizes += [np.linalg.norm(f[own]) for f in forces]
            bodies.append(
                {
                    "residual": float(np.linalg.norm(total[own & ~fixed])),
                    "size": float(max(sizes)),
                    "rounding": float(np.linalg.norm(rounding[own])),
                }
            )
        contacts = []
        for c, f in zip(problem.contacts, found, strict=True):
            w = c.weights * c.paired
            contacts.append(
                {
                    "force": w @ f["traction"],
                    "normal": float(w @ -f["r_n"]),
                    "tangential": float(w @ np.linalg.norm(f["tau"], axis=1)),
                    "size": float(w @ np.linalg.norm(f["traction"], axis=1)),
                }
            )
        return {
            "bodies": bodies,
            "contacts": contacts,
            "determined": self._unique_forces(problem, found, forces, load),
            "total": total,
            "motion rest": motion,
        }

    def _force_size(self, now: dict[str, Any], kind: str, i: int) -> float:
        """Return the larger force on a body or contact of those before and after the increment."""
        sizes = [now[kind][i]["size"]]
        if self._before is not None:
            sizes.append(self._before[kind][i]["size"])
        return max(sizes)

    def _check_equations(self, name: str, now: dict[str, Any], rtol: float) -> None:
        for b, body in enumerate(now["bodies"]):
            size = self._force_size(now, "bodies", b)
            rounding = body["rounding"]
            if self._before is not None:  # the displacement keeps the round-off of a removed load
                rounding = max(rounding, self._before["bodies"][b]["rounding"])
            allowed = (_RESIDUAL_RATIO * rtol + self._integration_error) * size + rounding
            text = f"; forces {size:.3g}"
            self._check(f"{name}, body {b}", "equations", body["residual"], allowed, text)
        if len(now["motion rest"]):
            size = max(self._force_size(now, "contacts", i) for i in range(len(now["contacts"])))
            rest = float(np.abs(now["motion rest"]).max())
            rounding = max(b["rounding"] for b in now["bodies"])
            self._check(name, "obstacle", rest, _RESIDUAL_RATIO * rtol * size + rounding)

    def _check_results(self, name: str, contact: Any, found: dict, record: dict[str, Any]) -> None:
        """Compare reported forces, area and tractions with those evaluated from u."""
        w = contact.weights
        r_n, tau = found["r_n"], found["tau"]
        size = float(w @ np.linalg.norm(found["traction"], axis=1))
        # The integration error between curved facets also affects the slip, by which the committed
        # τ may be cancelled.
        before = np.linalg.norm(found["tau_old"], axis=1)
        slip_error = self._integration_error * float(w @ before)
        rounding = self._roundoff(contact, found)
        same = _SUM_TOLERANCE + self._integration_error
        allowed = same * size + rounding * w.sum()
        self._check(
            name,
            "reported force",
            np.abs(record["force"] - w @ found["traction"]).max(),
            allowed + slip_error,
        )
        self._check(name, "reported N", abs(record["normal_force"] + w @ r_n), allowed)
        tangential = w @ np.linalg.norm(tau, axis=1)
        self._check(
            name, "reported T", abs(record["tangential_force"] - tangential), allowed + slip_error
        )
        is_closed = contact.law.tension | (r_n < 0)
        doubtful = np.abs(r_n) <= rounding
        low, high = w @ (is_closed & ~doubtful), w @ (is_closed | doubtful)
        if contact.law.tension:
            low = 0.0 if not contact.paired.all() else low
        error = max(low - record["area"], record["area"] - high, 0.0)
        self._check(name, "reported area", error, 1e-9 * w.sum())
        # Points at the same position (vertex quadrature) are summed.
        tree = scipy.spatial.cKDTree(contact.x)
        near = 1e-9 * (np.ptp(contact.x, axis=0).max() or 1.0)
        group = np.array([min(tree.query_ball_point(x, near)) for x in contact.x])
        their = group[tree.query(record["points"])[1]]

        def sum_points(where: Array, rows: Array) -> Array:
            total = np.zeros((len(w), rows.shape[1]))
            np.add.at(total, where, rows)
            return total

        own = w[:, None] * np.column_stack([np.ones(len(w)), -r_n, tau])
        reported = [np.ones(len(their)), record["pressure"], record["tangential"]]
        difference = sum_points(group, own)
        difference -= sum_points(their, record["measure"][:, None] * np.column_stack(reported))
        peak = np.abs(found["traction"]).max(initial=0.0)
        traction = np.abs(difference[:, 1:]).max()
        allowed = (same * peak + rounding) * w.max() + slip_error
        self._check(name, "reported traction", traction, allowed)
        self._check(name, "weights", np.abs(difference[:, 0]).max(), 1e-9 * w.max())

    def _roundoff(self, contact: Any, found: dict) -> float:
        """Return the round-off of u_n - s and of u_t, times the stiffness (stress)."""
        nodes_x = np.abs(found["overclosure"]).max() + np.abs(found["relative"]).max()
        reach = np.abs(contact.x).max() + nodes_x + 4 * self._translation + 2 * contact.radius
        stiff = contact.k_n.max() + contact.k_t.max()
        return float(8 * np.finfo(float).eps * stiff * reach)

    @staticmethod
    def _controllable_part(contact: Any, normal: Array, change: Array, fixed: Array) -> Array:
        """Project a change of λ_t, (n, d), onto the tangential displacements of free dofs.

        With linear elements the multiplier space is too rich next to Dirichlet nodes.
        """
        across = np.eye(contact.d) - normal[:, :, None] * normal[:, None, :]
        basis = np.einsum("qj,qkl->qkjl", contact.interpolation, across)
        basis = basis.reshape(change.size, -1)
        free = np.ones(basis.shape[1], dtype=bool)
        free[fixed] = False
        basis = basis[:, free & basis.any(axis=0)]
        weight = np.sqrt(np.repeat(contact.weights, contact.d))
        state = np.linalg.lstsq(weight[:, None] * basis, weight * change.ravel(), rcond=1e-12)[0]
        return np.asarray(basis @ state).reshape(change.shape)

    def _check_multipliers(
        self, name: str, contact: Any, found: dict, record: dict, fixed: Array
    ) -> None:
        """Check the projected penalty part of the tractions, and the penetration."""
        if contact.projection is None:
            return
        row = self._rows_of(contact, record)
        scale = max(np.abs(found["r_n"]).max(), np.abs(found["tau"]).max(initial=0.0))
        for old in (self._before or {}).get("found", []):
            scale = max(scale, np.abs(old["r_n"]).max(), np.abs(old["tau"]).max(initial=0.0))
        left = 0.0
        if contact.law.has_normal:
            left = np.abs(contact.projection @ -found["r_n"] - record["lambda_n"][row]).max()
        if contact.law.has_friction:
            tau = found.get("tau_local", found["tau"])  # in the frame of a rotating obstacle
            change = contact.projection @ tau - record["lambda_t"][row]
            if self.scene["degree"] == 1:
                change = self._controllable_part(contact, found["normal"], change, fixed)
            left = max(left, np.abs(change).max())
        allowed = 2 * record["tolerance"] * scale + 4 * self._roundoff(contact, found)
        self._check(name, "multipliers", left, allowed)
        if contact.law.has_normal:
            # On a facet that overhangs the obstacle, points beyond its edge distort the projection.
            depth = np.minimum(contact.projection @ found["overclosure"], found["overclosure"])
            depth = np.where(found["r_n"] < 0, depth, 0.0).max()
            # Γc may be a single point.
            size = (
                np.ptp(contact.x, axis=0).max() or np.ptp(self.problem.body.nodes_x, axis=0).max()
            )
            # Linear multipliers do not resolve the curvature of a coarse facet.
            bulges = self._flatness(self.scene["contacts"][self.problem.contacts.index(contact)])
            self._check(
                name, "multiplier penetration", depth, _MULTIPLIER_PENETRATION * size + bulges
            )

    def _flatness(self, given: dict[str, Any]) -> float:
        """Return the deviation of the facets of both surfaces of a contact from planes (length)."""
        return float(self._curvature_height / self.scene["bodies"][given["body"]]["n"][0] ** 2)

    def _check_opposite_penetration(
        self, name: str, u: Array, found: list[dict], now: dict[str, Any]
    ) -> None:
        """Check that the opposing surface has not passed through Γc between its points."""
        for i, contact in enumerate(self.problem.contacts):
            if contact.opposite_penetration is None or not contact.law.has_normal:
                continue
            pushed = float(contact.k_n.mean() * contact.opposite_penetration(u))
            # Coarse bodies overlap between the points by elastic deformation, in proportion to the
            # force of this contact or of the one with exchanged sides.
            same = [j for j in range(len(found)) if self._surfaces(j) == self._surfaces(i)]
            allowed = 1e4 * max(now["contacts"][j]["normal"] for j in same)
            # Unloaded curved surfaces overlap by a fraction of their deviation from each other,
            # which few points, and the vertices of a facet, do not resolve.
            differ = 0.1 * max(
                self._curvature_height, *(float(np.ptp(found[j]["overclosure"])) for j in same)
            )
            differ += 0.02 * float(contact.slave.lengths().max())
            if self.scene["contacts"][i].get("scheme") == "vertex":
                differ += self._curvature_height
            allowed += float(contact.k_n.mean() * contact.weights.sum()) * differ
            allowed += 1e3 * sum(b["rounding"] for b in now["bodies"])
            # With fewer points than nodes, or on an overhang, penetration between the points may
            # remain after unloading.
            few = self.scene["contacts"][i].get("quadrature", np.inf) < 2 * self.scene["degree"]
            if few or not contact.paired.all():
                allowed += self._earlier_penetration.get(i, 0.0)
                self._earlier_penetration[i] = max(pushed, self._earlier_penetration.get(i, 0.0))
            self._check(f"{name}, contact {i}", "passed through", pushed, allowed)

    def _check_penetration(
        self, name: str, u: Array, load: Any, motion: Array, found: list[dict]
    ) -> None:
        """Check the penetration of rigid obstacles between the points at deformed positions."""
        shifts = self.problem.shifts(load, motion)
        for i, (c, f, shift) in enumerate(zip(self.problem.contacts, found, shifts, strict=True)):
            if c.deformed_gap is None or not c.law.has_normal or c.law.tension:
                continue
            x, _, facet = sample_surface(c.slave, u)
            depth = -c.deformed_gap(x, shift)[0]
            corners = c.slave.corner_vertices
            traction = np.zeros(corners.max() + 1)
            np.maximum.at(traction, corners[c.facet], np.maximum(f["overclosure"], 0.0)[:, None])
            depth_at_points = traction[corners].max(axis=1)[facet]
            bulge = self._flatness(self.scene["contacts"][i])
            relative_depth = (depth - depth_at_points - bulge) / c.slave.lengths()[facet]
            self._check(
                f"{name}, contact {i}", "penetration", relative_depth.max(), MAX_PENETRATION
            )
            if c.centreline is not None and c.d == 2:
                self._check_rod_crossing(f"{name}, contact {i}", i, u, c.centreline_at(shift))

    def _check_rod_crossing(self, name: str, i: int, u: Array, spine: Array) -> None:
        """Check that the centreline of a rod has not crossed Γc in any of the increments.

        Its points move on straight paths. Entry through another side of the body is no failure.
        Γc must be a graph over x.
        """
        contact = self.problem.contacts[i]
        if i not in self._rod_states:
            began = contact.centreline_at(contact.initial_position())
            self._rod_states[i] = (0.0 * u, began, np.zeros(len(began), dtype=int))
        before, start, state = self._rod_states[i]
        first, at, _ = sample_surface(contact.slave, before)
        last = sample_surface(contact.slave, u)[0]
        order = np.argsort(at[:, 0])
        height = np.zeros(len(spine))
        for fraction in np.linspace(0, 1, _N_ROD_SUBSTEPS + 1):
            x = (first + fraction * (last - first))[order]
            q = start + fraction * (spine - start)
            height = q[:, 1] - np.interp(q[:, 0], x[:, 0], x[:, 1])
            over = (q[:, 0] > x[:, 0].min()) & (q[:, 0] < x[:, 0].max())
            # 0: not over Γc; -1: below it; 1: has crossed it; 2: has entered by another side.
            inside = np.where(state == -1, 1, np.where(state == 0, 2, state))
            state = np.where(over, np.where(height > 0, inside, -1), 0)
        self._rod_states[i] = (u, spine, state)
        through = np.where(state == 1, height, 0.0).max()
        facet = float(contact.slave.lengths().max())
        wide = np.ptp(spine[:, 0]) > 2 * facet
        allowed = 0.02 * facet if wide else _ROD_DEPTH * facet + contact.radius
        self._check(name, "crossed", through, allowed)

    def _check_kinematics(
        self, name: str, u: Array, motion: Array, load: Any, old: list[Any], now: dict[str, Any]
    ) -> None:
        """Check that geometry at the deformed positions changes normal forces by at most 50 %."""
        problem = self.problem
        saved = [(c.gap_function, c.interpolation, c.paired) for c in problem.contacts]
        shifts = problem.shifts(load, motion)
        changed = False
        try:
            for c, shift in zip(problem.contacts, shifts, strict=True):
                jump, paired = c.jump(u), c.paired
                gap, normal = c.gap_and_normal(shift)
                if c.deformed_gap is not None:
                    x = c.x + jump
                    changed |= self._geometry_changes(
                        c, jump, shift, *c.deformed_gap(x, shift), gap, normal
                    )

                    def deformed_gap(s: Array, c: Any = c, x: Array = x, jump: Array = jump) -> Any:
                        gap, normal = c.deformed_gap(x, s)
                        return gap + np.sum(jump * normal, axis=1), normal

                    c.gap_function = deformed_gap
                elif c.current_pairs is not None and c.update_pairs is None:
                    c.interpolation, gap, c.paired = c.current_pairs(u)
                    both = paired & c.paired
                    error = np.abs((c.jump(u) - jump)[both]).max(initial=0.0)
                    near = error <= 1e-9 * np.ptp(c.slave.body.nodes_x, axis=0).max()
                    changed |= not near or bool((paired != c.paired).any())
                    c.gap_function = lambda s, gap=gap, normal=normal: (gap, normal + 0 * s)
            if not changed:
                return
            near, moved = problem.equilibrate(u, motion, load, old, 1e-9)
            if (
                np.abs(near - u).max()
                > _BRANCH_DISTANCE * np.ptp(problem.body.nodes_x, axis=0).max()
            ):
                raise reference.NotSolved(
                    "the solution with deformed geometry is on another branch"
                )
            forces = self._forces(near, load, problem.evaluate(near, moved, load, old))["contacts"]
        except (reference.NotSolved, np.linalg.LinAlgError) as failure:
            self.not_compared.append(f"{name}: kinematics: {failure}")
            return
        finally:
            for c, (gap_function, interpolation, paired) in zip(
                problem.contacts, saved, strict=True
            ):
                c.gap_function, c.interpolation, c.paired = gap_function, interpolation, paired
        for i in range(len(forces)):
            # Of two contacts with exchanged sides only the sum of the forces is unique.
            same = [j for j in range(len(forces)) if self._surfaces(j) == self._surfaces(i)]
            size = max(max(self._force_size(now, "contacts", j), forces[j]["size"]) for j in same)
            error = abs(sum(forces[j]["normal"] - now["contacts"][j]["normal"] for j in same))
            allowed = _FORCE_CHANGE * size + 30 * max(b["rounding"] for b in now["bodies"])
            self._check(f"{name}, contact {i}", "kinematics", error, allowed)

    @staticmethod
    def _geometry_changes(
        c: Any, jump: Array, shift: Array, far: Array, normal: Array, gap: Array, old: Array
    ) -> bool:
        """Whether distance or normal change at the deformed positions."""
        error = np.abs(far - gap + np.sum(jump * old, axis=1)).max()
        size = np.ptp(c.slave.body.nodes_x, axis=0).max()
        return bool(error > 1e-9 * size or np.abs(normal - old).max() > 1e-6)

    def _surfaces(self, i: int) -> set[tuple[Any, Any]]:
        """Return body and side of both surfaces of a contact."""
        given = self.scene["contacts"][i]
        obstacle = given["obstacle"]
        return {(given["body"], given["side"]), (obstacle.get("body"), obstacle.get("side"))}

    def _check_energy(
        self,
        name: str,
        record: dict[str, Any],
        u: Array,
        motion: Array,
        load: Any,
        found: list[dict],
        now: dict[str, Any],
    ) -> None:
        """Compare work and energies of the increment with those of the package."""
        problem, before = self.problem, self._before
        stiff = problem.body.stiffness
        displacement = u - self._u
        outside = load.force.copy()
        outside[load.fixed] += now["total"][load.fixed]
        inside = stiff @ u
        work = 0.5 * outside @ displacement
        elastic = 0.5 * inside @ displacement
        springs = sum(c.stored_energy(f) for c, f in zip(problem.contacts, found, strict=True))
        dissipated = sum(
            c.dissipated_energy(f) for c, f in zip(problem.contacts, found, strict=True)
        )
        obstacle_forces = np.array([load.obstacle_forces[c][i] for c, i in problem.free_motions()])
        work += 0.5 * obstacle_forces @ (motion - self._motion)
        forces = [c["force"] for c in now["contacts"]]
        displacements = load.shifts
        if before is not None:
            work += 0.5 * before["outside"] @ displacement + 0.5 * before["obstacle_forces"] @ (
                motion - self._motion
            )
            elastic += 0.5 * before["inside"] @ displacement
            springs -= before["springs"]
            ends = zip(forces, before["contacts"], strict=True)
            forces = [f + b["force"] for f, b in ends]
            displacements = [s - b for s, b in zip(load.shifts, before["shifts"], strict=True)]
        work += sum(0.5 * f @ s for f, s in zip(forces, displacements, strict=True))
        now |= {
            "outside": outside,
            "inside": inside,
            "shifts": load.shifts,
            "obstacle_forces": obstacle_forces,
        }
        energy = record["energy"]
        if energy is None:
            return
        penalty = all(c.projection is None for c in problem.contacts)
        scale = np.abs(outside) @ np.abs(displacement) + abs(springs) + abs(dissipated)
        scale += sum(np.abs(f) @ np.abs(s) for f, s in zip(forces, displacements, strict=True))
        if before is not None:
            scale += np.abs(before["outside"]) @ np.abs(displacement)
        allowed = max(1e-6, 300 * record["rtol"], self._integration_error) * scale
        rounding = sum(b["rounding"] for b in now["bodies"])
        if before is not None:  # bodies may have been translated without strain
            rounding = max(rounding, sum(b["rounding"] for b in before["bodies"]))
        allowed += 10 * rounding * max(np.abs(u).max(), np.abs(self._u).max(initial=0.0))
        for c, f in zip(problem.contacts, found, strict=True):
            stiff = c.k_n[c.k_n > 0].min(initial=np.inf)
            allowed += 10 * c.weights.sum() * self._roundoff(c, f) ** 2 / stiff
        pairs = [("work", energy.work, work), ("elastic", energy.elastic, elastic)]
        if penalty:
            pairs += [
                ("springs", energy.springs, springs),
                ("dissipation", energy.dissipation, dissipated),
            ]
        for what, reported, computed in pairs:
            self._check(name, f"energy {what}", abs(reported - computed), allowed)
        if penalty and dissipated < -allowed:
            self.failed_checks.append(f"energy: {name}: dissipation {dissipated:.3g} is negative")

    def _tolerance(self, record: dict[str, Any], base: float) -> float:
        """Return the relative tolerance of forces, at least ``base``."""
        found = max(base, 300 * record["rtol"], self._integration_error)
        for contact in record["contacts"]:
            if contact["lambda_n"] is not None:
                found = max(found, 30 * contact["tolerance"])
            if contact["error"]:
                found = max(found, contact["error"])
        return found

    def _has_free_multipliers(self, load: Any) -> bool:
        """Whether friction multipliers depend on the augmentations; see `_controllable_part`."""
        linear = self.scene["degree"] == 1 and load.fixed.size
        return bool(linear) and any(
            c.projection is not None and c.law.has_friction for c in self.problem.contacts
        )

    def _is_unique(self) -> bool:
        return all(c.law.is_unique and not c.free_components for c in self.problem.contacts)

    def _check_nearest(
        self,
        name: str,
        record: dict[str, Any],
        u: Array,
        motion: Array,
        load: Any,
        old: list[Any],
        found: list[dict],
        now: dict[str, Any],
    ) -> None:
        """Compare forces with the exact solution that the independent solver finds from u."""
        try:
            near, moved = self.problem.equilibrate(u, motion, load, old, 1e-12)
        except reference.NotSolved as failure:
            self.not_compared.append(f"{name}: nearest: {failure}")
            return
        exact = self._forces(near, load, self.problem.evaluate(near, moved, load, old))
        for i, contact in enumerate(exact["contacts"]):
            size = self._force_size(now, "contacts", i)
            rounding = max(b["rounding"] for b in now["bodies"])
            error = np.abs(contact["force"] - now["contacts"][i]["force"]).max()
            allowed = self._tolerance(record, _NEAREST_FORCE_TOLERANCE) * size + 10 * rounding
            if error > allowed and not self._is_unique():
                self.other_solutions.append(
                    f"{name}, contact {i}: nearest differs by {error / size:.1e}"
                )
            else:
                self._check(f"{name}, contact {i}", "nearest", error, allowed)

    def _check_independent(
        self, name: str, record: dict[str, Any], load: Any, now: dict[str, Any]
    ) -> None:
        """Solve the increment of the independent history, and compare its forces."""
        if self._other_failed:
            return
        problem = self._other
        try:
            u, motion, old = problem.solve(
                self._other_u, self._other_motion, load, self._other_state
            )
        except (reference.NotSolved, np.linalg.LinAlgError) as failure:
            self.not_compared.append(f"{name}: independent: {failure}")
            self._other_failed = True
            return
        found = problem.evaluate(u, motion, load, old)
        tolerance = self._tolerance(record, _INDEPENDENT_FORCE_TOLERANCE)
        largest_ratio = 0.0
        rounding = max(b["rounding"] for b in now["bodies"])
        forces = self._unique_forces(problem, found, problem.contact_force(found), load)
        for i in range(len(forces)):
            force, given = (self._total_force(forces, i), self._total_force(now["determined"], i))
            size = max(self._force_size(now, "contacts", i), float(np.abs(force).max()))
            error = np.abs(force - given).max()
            allowed = tolerance * size + 30 * rounding
            if allowed > 0:
                largest_ratio = max(largest_ratio, error / allowed)
            text = f"{name}, contact {i}: {given} by the package, {force} independently"
            if error > allowed:
                reported = self._is_unique() and not (
                    self._has_free_multipliers(load) and error <= _NONUNIQUE_FORCE_TOLERANCE * size
                )
                (self.failed_checks if reported else self.other_solutions).append(
                    "independent: " + text
                )
        self.error_ratios["independent"] = max(
            self.error_ratios.get("independent", 0.0), largest_ratio
        )
        if largest_ratio > 1.0:
            self._other_failed = True
        self._other_state = [
            c.next_state(f, o) for c, f, o in zip(problem.contacts, found, old, strict=True)
        ]
        self._update_pairs(problem, self._other_state, u, record)
        self._other_u, self._other_motion = u, motion

    def _total_force(self, forces: list[Array], i: int) -> Array:
        """Return the force on the body of a contact by all contacts between the same surfaces.

        With multipliers on both sides only their sum is unique.
        """
        total, body = np.zeros_like(forces[i]), self.scene["contacts"][i]["body"]
        for j, contact in enumerate(self.problem.contacts):
            if j == i or (
                contact.projection is not None and self._surfaces(j) == self._surfaces(i)
            ):
                sign = 1.0 if self.scene["contacts"][j]["body"] == body else -1.0
                total += sign * forces[j]
        return total

    def _unique_forces(
        self, problem: Any, found: list[dict], forces: list[Array], load: Any
    ) -> list[Array]:
        """Return the force of every contact, with friction multipliers on the free dofs only.

        At sticking Dirichlet nodes any multiplier within the friction bound is a solution, because
        the split between contact force and reaction is not unique.
        """
        reported = []
        given = zip(problem.contacts, found, forces, self.scene["contacts"], strict=True)
        for c, f, force, scene in given:
            if c.projection is None or not c.law.has_friction:
                reported.append((c.weights * c.paired) @ f["traction"])
                continue
            free = force.copy()
            free[load.fixed] = 0.0
            own = problem.body.body_numbers == scene["body"]
            reported.append(free.reshape(-1, c.d)[own].sum(axis=0))
        return reported

    def _repeat_pair_updates(self, record: dict[str, Any]) -> None:
        """Find the pairs at the displacements at which the package found them in the increment."""
        for i, reported in enumerate(record["contacts"]):
            if reported["paired_at"] is not None:
                at = self._nodal_values(reported["paired_at"])
                self._update_contact_pairs(self.problem, self._state, i, at, self._u)
                self._update_contact_pairs(self._other, self._other_state, i, at, self._other_u)

    def _update_pairs(
        self, problem: Any, states: list[Any], u: Array, record: dict[str, Any]
    ) -> None:
        """Update pairs and slip references at a committed state."""
        for i, reported in enumerate(record["contacts"]):
            if reported["updates_pairs"]:
                self._update_contact_pairs(problem, states, i, u, u)

    @staticmethod
    def _update_contact_pairs(
        problem: Any, states: list[Any], i: int, pairing_displacement: Array, u: Array
    ) -> None:
        """Find the pairs of a contact at a displacement; u is the committed displacement."""
        contact = problem.contacts[i]
        if contact.update_pairs is None:
            return
        before = contact.jump(u)
        contact.update_pairs(pairing_displacement)
        states[i].jump += contact.jump(u) - before
