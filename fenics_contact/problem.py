"""ContactProblem: one increment of a body in contact, solved by PETSc SNES, then checked."""

from __future__ import annotations

import logging
import time
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.arguments import check_instance, is_number, listed
from fenics_contact.checks.chattering import StatusWatch
from fenics_contact.checks.energy import Energy, EnergyState
from fenics_contact.checks.kinematics import Linearisation, linearisation
from fenics_contact.checks.rigid_motions import RigidMotions
from fenics_contact.checks.verdict import Attempt, Balance, NotConverged, Verdict, check_laws
from fenics_contact.contact.contact import (
    Contact,
    Found,
    Resultants,
    Status,
    displacement_degree,
    passing,
)
from fenics_contact.methods.alternating import Alternation
from fenics_contact.methods.callbacks import Callbacks, interrupts_held, release_interrupt
from fenics_contact.methods.continuation import Continuation
from fenics_contact.methods.options import Defaults, take_command_line
from fenics_contact.methods.quasi_newton import QuasiNewton
from fenics_contact.parallel import fail_together, global_max, global_min, global_sum, warn
from fenics_contact.surface.facets import facet_cells, local_facets
from fenics_contact.surface.modulus import cell_modulus
from fenics_contact.systems import dense, linear
from fenics_contact.systems.balance import Norms
from fenics_contact.systems.bulk import Bulk
from fenics_contact.systems.condensed import CondensedSystem, touched, worthwhile
from fenics_contact.systems.forces import Forces
from fenics_contact.systems.full import FullSystem
from fenics_contact.systems.operator import ContactOperator
from fenics_contact.systems.unknowns import Selection, Unknowns

__all__ = ["ContactProblem", "Step"]

Array = npt.NDArray[np.float64]
logger = logging.getLogger("fenics_contact")

# An open point keeps this share of its stiffness in H₀: enough that a body held by contact alone
# stays held when its whole surface is open, too little to be felt as a wrong tangent.
_OPEN_SHARE = 1e-3
# An unknown with less than this share of the bulk's stiffness has none.
_FELT = 1e-12
# Rounds with multipliers before it is given up.
_MAX_ROUNDS = 60
# Residual, relative, to which the first round is solved; share of a round's error to which the next
# is; and the error, in units of the tolerance, from which on the next may be the last one.
_FIRST_ROUND, _INNER, _NEARLY = 1e-4, 1e-2, 10.0
# A start with up to this many times the residual of the best is taken first if its points slip.
_FAR = 100.0
# Gaps smaller than this, relative to the mesh, are none: coordinates are no more exact.
_TOUCHING = 1e-12
# Contact that bears less than this share of the load on a free motion bears nothing yet.
_IDLE = 1e-3
# Share by which small displacements may change forces or pressures before it is said.
_NOTABLE = 0.01
# Displacements beyond this many sizes of the mesh excuse no round-off: a body that nothing loads
# may go anywhere, and then anything would pass.
_REACH = 10.0
# Round-off of displacements that two routes add up in different orders, by their size.
_ROUND_OFF = 100 * np.finfo(float).eps
# Increments expected where nothing is said.
_EXPECTED = 4
# Iterations of Newton's method without a lower residual after which another method takes over.
_PATIENCE = 20

_REASONS = PETSc.SNES.ConvergedReason
_OUTCOMES = {
    int(_REASONS.DIVERGED_LINEAR_SOLVE): "the matrix is singular",
    compat.NOT_FINITE: "the residual is not finite",
    int(_REASONS.DIVERGED_MAX_IT): "iterations used up",
    int(_REASONS.DIVERGED_LINE_SEARCH): "no progress",
    int(_REASONS.DIVERGED_DTOL): "no progress",
}
_COMMON = {
    "snes_rtol": 1e-9,
    "snes_stol": 0.0,
    "snes_max_it": 1000,
    # The paper's line search: |ρ·Ψ(ΔU + sρ)| ≤ c_L |ρ·Ψ(ΔU)|. With the single secant step that is
    # `cp`'s default it takes three times the iterations, and fails at stiffness it can solve.
    "snes_linesearch_type": "cp",
    "snes_linesearch_rtol": 0.1,
    "snes_linesearch_max_it": 20,
    # Bodies without contact are led to it before: no step of the iteration needs to be long.
    compat.LONGEST_STEP: 100.0,
    # `cp` takes |F·y| below this for convergence of the whole; the residual itself is tested here.
    "snes_linesearch_atol": 1e-300,
}
# Options that only make sense for the sparse matrices over all unknowns.
_NAMES_A_SOLVER = ("ksp_type", "pc_type", "pc_factor_mat_solver_type")
_METHODS: dict[str, dict[str, Any]] = {
    "lbfgs": {
        "snes_type": "qn",
        "snes_qn_type": "lbfgs",
        "snes_qn_scale_type": "jacobian",
        "snes_qn_restart_type": "none",  # Powell's uses K where K⁻¹ is meant
        "snes_qn_m": 20,
        "qn_mat_lmvm_eps": 0.0,  # else pairs are dropped by a test that depends on the units
    },
    "newton": {"snes_type": "newtonls", "snes_max_it": 100},
    "alternating": {},
    "continuation": {},
}
# What takes over where a method fails.
_LAST_RESORT = "continuation"


@dataclass(frozen=True)
class Step:
    """What one solve did.

    Attributes:
        increment: Number of the increment, from 1.
        reason: SNES reason of the last solve (positive: converged).
        iterations: SNES iterations in all.
        rounds: Solutions one after another, with multipliers between them.
        method: The method that found the solution; see `ContactProblem`.
        factorisations: Sparse matrices factored; dense ones of a condensed problem do not count.
        verdict: The independent check.
        contacts: Resultants of every contact, by name.
        energy: Works and energies of the increment.
        attempts: Everything that was tried, in its order; the last is what found the solution.
        wall_seconds: Time of the solve on this rank.
        load: Load parameter, where `increments` set one.
        increment_error: Errors by the size of the increments so far, by quantity, where
            `increments` estimates them; see `ErrorBudget`.
        complete: Whether all of u is that of the increment; else `ContactProblem.complete` makes
            it so.
    """

    increment: int
    reason: int
    iterations: int
    rounds: int
    method: str
    factorisations: int
    verdict: Verdict
    contacts: dict[str, Resultants]
    energy: Energy
    attempts: tuple[Attempt, ...]
    wall_seconds: float
    load: float | None = None
    increment_error: dict[str, float] | None = None
    complete: bool = True

    def summary(self) -> str:
        """One line for people; friction is ∫|τ| over the points, not the size of its resultant."""
        parts = [f"increment {self.increment}"]
        if self.load is not None:
            parts.append(f"load {self.load:.6g}")
        made = f"{self.iterations} iterations" if self.iterations else "solved by its first guess"
        parts.append(f"{self.method}: {made}")
        residual, force = self.verdict.relative_residual, self.verdict.force
        parts.append(f"residual {residual:.1e} of the forces" if force > 0 else "no forces")
        for name, r in self.contacts.items():
            parts.append(
                f"{name}: force {r.normal_force:.6g}, friction ∫|τ| "
                f"{r.tangential_force:.6g}, area {r.area:.4g}, {r.stick} stick {r.slip} slip "
                f"{r.open} open"
            )
        return "; ".join(parts)


@dataclass(frozen=True)
class _Solved:
    """What `ContactProblem.solve` found, until it is committed or dropped.

    Attributes:
        state: This rank's unknowns; where u is behind, those that are not.
        contacts: The state of every contact.
    """

    state: Array
    contacts: list[Found]


class ContactProblem:
    """A body, its Dirichlet conditions and its contacts: one increment at a time.

    SNES sees a dimensionless problem: displacements by the size of the mesh, stiffness by the
    largest entry of the bulk's diagonal. The options database reaches everything under
    ``prefix``, for example ``-contact_snes_monitor`` or ``-contact_snes_type newtonls``; what the
    caller's ``petsc_options`` and the command line do not set comes from ``method``.

    Attributes:
        u: The displacement.
        contacts: The contacts.
        bulk: The bulk form.
        snes: The PETSc solver.
        accuracy: That of the contact that wants most, None if not every contact says one.
        increment: Number of committed increments.
        kinematics: See the argument.
        initial_penetration: Largest penetration of the undeformed body (length), 0 if none; an
            interference by a prescribed gap is none.
    """

    def __init__(
        self,
        F: ufl.Form,
        u: fem.Function,
        *,
        bcs: Sequence[fem.DirichletBC] = (),
        contacts: Sequence[Contact] = (),
        method: str | None = None,
        alpha: float = 1.0,
        phi: float = 1.0,
        fallback: bool = True,
        condensation: bool | None = None,
        linear_solver: str | None = None,
        petsc_options: Mapping[str, Any] | None = None,
        prefix: str = "contact_",
        kinematics: float = 0.2,
        second_route: bool = False,
    ) -> None:
        """Compile the forms, measure the scales and check the input. Collective.

        Args:
            F: Residual of the bulk in ``u`` and one test function, loads included, contact not.
            u: Displacement; its values are the starting state.
            bcs: Dirichlet conditions on ``u`` or its components.
            contacts: Contacts of ``u``.
            method: "lbfgs" (quasi-Newton, H₀ = (K + αK_n + φK_t)⁻¹), "newton" (consistent
                tangent), "continuation" (the same, from soft contact to stiff; alternating where
                it is stuck), or "alternating" (minimum problems in turn, each by Newton's method
                with a line search on the energy). By default "lbfgs" on all unknowns, where a
                factorisation costs as much as dozens of iterations, and condensed, where it costs
                as much as ten, "newton", with "continuation" for the first increment.
            alpha: Share of the normal contact stiffness in H₀, 0 to 1 (paper: 1).
            phi: Share of the tangential contact stiffness of sticking points in H₀, 0 to 1. The
                paper has 0; 1 needs a third of the iterations once a point sticks.
            fallback: Whether to go on by continuation where the method fails with no less than its
                usual limit on iterations.
            condensation: Whether to iterate on the unknowns that contact touches alone, all others
                eliminated: for a linear bulk on one rank. By default where it can be done and is
                worth it (`condense.worthwhile`), unless an option names a linear solver.
            linear_solver: How systems over all unknowns are solved: "direct" (MUMPS) or "multigrid"
                (GAMG: a V-cycle as H₀ of L-BFGS, or inside CG and GMRES for Newton's method). By
                default multigrid for three-dimensional problems that it solves sooner, and where
                the factors would not fit in half of the memory; supports that move freely need
                "direct". The log says what was chosen.
            petsc_options: Options without prefix; they win over the method's, the command line
                over both.
            prefix: Prefix of the options.
            kinematics: Displacements are taken as small; an increment fails where that changes the
                contact force or the pressure (between two bodies: the force) by more than this
                share, and is warned of from a hundredth on. Infinite: it never fails.
            second_route: Whether every verdict also compares the forces on Γc with those that
                DOLFINx assembles from the boundary form; one more form to compile for each contact,
                and an assembly for each increment.

        Raises:
            ValueError: Input that has no sense; the text says what and what to do. On all ranks.
        """
        if method not in (None, *_METHODS):
            raise ValueError(f"method is {method!r}; use one of {sorted(_METHODS)}")
        if linear_solver not in (None, *linear.KINDS):
            raise ValueError(
                f"linear_solver is {linear_solver!r}; use one of {sorted(linear.KINDS)}, or None "
                "for the one that suits the size of the problem"
            )
        for name, share in (("alpha", alpha), ("phi", phi)):
            if not (is_number(share) and 0.0 <= share <= 1.0):
                raise ValueError(f"{name} is {share!r}; it must lie between 0 and 1")
        if not (is_number(kinematics) and kinematics > 0):
            raise ValueError(
                f"kinematics is {kinematics!r}; it must be a positive share, such as 0.2, or "
                "infinite, so that no increment fails by it"
            )
        check_instance("u", u, fem.Function)
        displacement_degree(u, u.function_space.mesh, "problem")
        check_instance("prefix", prefix, str)
        if petsc_options is not None:
            check_instance("petsc_options", petsc_options, Mapping)
        self.contacts = listed("contacts", contacts, Contact)
        self._bcs = listed("bcs", bcs, fem.DirichletBC)
        compat.warn_of_slow_blas()
        self.u = u
        self.bulk = Bulk(F, u)
        said = [c.accuracy for c in self.contacts if c.accuracy is not None]
        all_say = bool(said) and len(said) == len(self.contacts)
        self.accuracy = min(said, key=lambda a: a.error) if all_say else None
        self.increment = 0
        self._comm = u.function_space.mesh.comm
        self._alpha, self._phi = alpha, phi
        n_motions = sum(len(contact.free_motion) for contact in self.contacts)
        self.unknowns = Unknowns(u.function_space, n_motions)
        self._n_owned = self.unknowns.n_dofs
        self._constrained = self._constrained_unknowns()
        self._check_contacts()
        self._whole = FullSystem(u, self.unknowns, self.bulk, self.contacts, self._constrained)

        self.bulk.check_finite()
        self.bulk.update()
        self.bulk.check_elastic()
        waiting = [c for c in self.contacts if c.needs_modulus]
        if waiting:
            modulus = cell_modulus(self.bulk.tangent_form, u, waiting[0].weight)
            for contact in waiting:
                contact.set_modulus(modulus)
        self.motions = RigidMotions(u.function_space, self.unknowns, self._motion_names())
        self.initial_penetration = self._check_start()
        self._bulk_matrix = self.unknowns.widened(self.bulk.stiffness, rows=True)
        self.motions.find_free(self._bulk_matrix, self._constrained)
        self.motions.check_held(self.operators)

        self._length = self.motions.size
        self._load: Array = np.zeros(self.unknowns.n_local)
        self._factorisations = 0
        nothing: Array = np.zeros(self._whole.n_bodies)
        self._norms = Norms(nothing, nothing, nothing, nothing.size)
        self._start_terms, self._imposed = nothing, self._length
        self._committed = self._rest = self._whole.state()
        for contact in self.contacts:
            contact.evaluate()
        forces: dict[object, Forces] = {self._whole.mark: Forces.none(self._committed)}
        self._energy = self._committed_energy = EnergyState.unloaded(forces, self.contacts)
        # What the present and the committed state need to be completed, and their loads.
        self._pending_field: Array | None = None
        self._committed_lag: tuple[Array | None, Array] = None, self._load
        self._rate: Array | None = None
        self._solved: _Solved | None = None
        self._cold = True
        self.kinematics, self._second_route = kinematics, second_route
        self._large: set[str] = set()
        n_nodes = self.unknowns.first_motion / len(u)
        self._cell_size = self._length / n_nodes ** (1 / len(u))
        self._watch = StatusWatch(self.contacts)
        self._round_rtol = 0.0
        self._condensation, self._linear_solver = condensation, linear_solver
        self.prefix, self._fallback = prefix, fallback
        self._expected = _EXPECTED
        self._fresh = True  # nothing was solved yet
        self._obstacle: str | None = None  # to condensation, as last said
        self._given = method, dict(petsc_options or {})
        take_command_line(prefix, self._comm)
        self._configure()

    # ---- construction ----------------------------------------------------------------------------

    def _motion_names(self) -> list[str]:
        return [
            f"translation along {'xyz'[i]} of the support of {contact.name}"
            for contact in self.contacts
            for i in contact.free_motion
        ]

    def _constrained_unknowns(self) -> npt.NDArray[np.bool_]:
        mask = np.zeros(self.unknowns.n_local, dtype=np.bool_)
        for bc in self._bcs:
            dofs, _ = bc.dof_indices()
            if self._comm.allreduce(int(dofs.size and dofs.max() >= self.u.x.array.size)):
                raise ValueError("a Dirichlet condition is on another function space than u")
            # Their number of owned dofs, which comes with them, is wrong for blocked conditions.
            mask[dofs[dofs < self._n_owned]] = True
        return mask

    def _check_contacts(self) -> None:
        names = [c.name for c in self.contacts]
        if len(set(names)) != len(names):
            raise ValueError(f"contacts are named {names}; give every Contact a name of its own")
        constrained = fem.Function(self.u.function_space)
        constrained.x.array[: self._n_owned] = self._constrained[: self._n_owned]
        constrained.x.scatter_forward()
        for contact in self.contacts:
            if contact.u is not self.u:
                raise ValueError(f"{contact.name}: its u is not the u of the problem")
            held = _facets_held(contact, constrained.x.array)
            n_held = self._comm.allreduce(held)
            if n_held:
                raise ValueError(
                    f"{contact.name}: all displacements of {n_held} facets of Γc are prescribed by "
                    "Dirichlet conditions; contact has nothing to decide there: take these facets "
                    "out of Γc or out of the condition"
                )

    def _check_start(self) -> float:
        worst = 0.0
        for contact in self.contacts:
            contact.check_input()
            contact.check_side()
            gap = global_min(self._comm, contact.values["gap"])
            if gap < -_TOUCHING * self.motions.size and not contact.gap_prescribed:
                worst = max(worst, -gap)
                if self._comm.rank == 0:
                    logger.warning(
                        "%s: the undeformed body penetrates its support by up to %g",
                        contact.name,
                        -gap,
                    )
        return worst

    def _configure(self) -> None:
        """Set up SNES and its two linear solvers: for H₀, and for the consistent tangent."""
        (method, given), prefix = self._given, self.prefix
        options = self._options = Defaults()
        options.give(given, prefix)
        if self.accuracy is not None:
            # Residuals as large as what multipliers may miss would make rounds that change nothing.
            least = [_INNER * c.tolerance for c in self.contacts if c.multipliers is not None]
            options.set({"snes_rtol": min(self.accuracy.rtol, *least, 1.0)}, prefix)
            if self._comm.rank == 0:
                logger.info("accuracy %s", self.accuracy)
        solvers = [part + name for part in ("", "tangent_") for name in _NAMES_A_SOLVER]
        named = [name for name in solvers if options.get(prefix + name) is not None]
        self._named_solvers = named
        self._condensed = self._choose_condensation(named)
        self._whole.linear_kind = self._choose_linear_solver(named)
        self._set_space()
        self._automatic = method is None
        self._method = method or ("newton" if self._condensed else "lbfgs")
        options.set(_COMMON | _METHODS[self._method], prefix)
        self._quasi_newton = options.get(prefix + "snes_type") == PETSc.SNES.Type.QN
        newton = linear.newton_options(self._space.linear_kind)
        if not self._quasi_newton:
            options.set(newton, prefix)
        snes = self.snes = PETSc.SNES().create(self._comm)
        snes.setOptionsPrefix(prefix)
        snes.setSolution(self._solution)
        self._callbacks = Callbacks(self._comm)
        self._rounds = QuasiNewton(self)
        self._solvers: dict[bool, PETSc.KSP] = {}
        for consistent in (False, True):
            # Tolerances that follow the residual are for a solver that SNES has made.
            own = consistent and not self._quasi_newton
            ksp = snes.getKSP() if own else PETSc.KSP().create(self._comm)
            part = prefix + ("tangent_" if consistent else "")
            ksp.setOptionsPrefix(part)
            symmetric = self._symmetric(consistent)
            options.set(
                self._space.linear_solver(symmetric=symmetric, accurate=not self._quasi_newton),
                part,
            )
            with options.present():
                ksp.setFromOptions()
            self._solvers[consistent] = ksp
        self._forget_matrices()
        self._attach(consistent=not self._quasi_newton)
        with options.present():
            snes.setFromOptions()
            snes.setUp()

        def newton_solver(symmetric: bool) -> dict[str, Any]:
            """Options of one for Newton's method; none where that of H₀ or the tangent is one."""
            if not newton:
                return {}
            return self._space.linear_solver(symmetric=symmetric, accurate=True) | newton

        self._alternation = Alternation(self, options, newton_solver(self._symmetric(False)))
        self._continuation = Continuation(self, options, newton_solver(self._symmetric(True)))
        self._rtol = snes.getTolerances()[0]
        self._max_it = snes.getTolerances()[3]

    def expect(self, increments: int) -> None:
        """Say how many increments will be solved: the choice of the solver needs it. Collective.

        `increments` does. It matters before the first solution, in three dimensions: a few are
        solved by multigrid sooner than all unknowns but those of Γc are eliminated for many. Where
        nothing is said, four are expected.

        Args:
            increments: Their number, at least 1.

        Raises:
            ValueError: It is less.
        """
        if increments < 1:
            raise ValueError(f"increments is {increments}; expect at least 1")
        if self._fresh and self._expected != increments:
            self._expected = increments
            chosen = self._choose_condensation(self._named_solvers)
            if chosen != self._condensed:
                self._configure()

    def _symmetric(self, consistent: bool) -> bool:
        return self.bulk.symmetric and (not consistent or self.has_potential)

    def _choose_condensation(self, solvers: Sequence[str]) -> bool:
        """Whether to iterate on the unknowns that contact touches alone. Collective.

        Args:
            solvers: Options given that name a linear solver, which the dense one cannot be.
        """
        obstacle = None
        if not self.contacts:
            obstacle = "there is no contact"
        elif not self.bulk.linear:
            obstacle = "the bulk is not linear in u"
        elif self._comm.size > 1:
            obstacle = f"it takes one rank, and there are {self._comm.size}"
        elif solvers:
            obstacle = f"the options name a linear solver ({', '.join(solvers)})"
        elif self._linear_solver == "multigrid":
            obstacle = "linear_solver is 'multigrid', and it takes a factorisation"
        if self._condensation and obstacle:
            raise ValueError(
                f"condensation is True, but {obstacle}; leave it out, or give condensation=False"
            )
        if self._condensation is False:
            obstacle = "the caller wants none"
        elif self._condensation is None and not obstacle:
            n, n_touched = self.unknowns.n_local, touched(self.operators, self.unknowns).size
            if n_touched == n or not worthwhile(n, n_touched, len(self.u)):
                obstacle = f"contact touches {n_touched} of {n} unknowns, too many to gain by it"
            elif not self.unknowns.n_motions and self._linear_solver is None:
                n_bytes = linear.factor_bytes(n, len(self.u), symmetric=self.bulk.symmetric)
                obstacle = linear.too_large(n_bytes, self._comm)
                if not obstacle and linear.quicker(n, len(self.u), condensed_for=self._expected):
                    obstacle = f"multigrid is quicker for {n} unknowns"
        if obstacle and obstacle != self._obstacle and self._comm.rank == 0:
            logger.info("iterating on all unknowns: %s", obstacle)
        self._obstacle = obstacle
        return obstacle is None

    def _choose_linear_solver(self, solvers: Sequence[str]) -> str:
        """How to solve systems over all unknowns, one of `linear.KINDS`. Collective.

        Args:
            solvers: Options given that name a linear solver; they win.
        """
        kind, reason = self._linear_solver, "the caller's choice"
        if kind is None:
            n = self.unknowns.first_motion
            n_bytes = linear.factor_bytes(n, len(self.u), symmetric=self._symmetric(False))
            if not self._symmetric(True):  # L-BFGS keeps the factors of both
                n_bytes += linear.factor_bytes(n, len(self.u), symmetric=False)
            reason = linear.too_large(n_bytes, self._comm) or ""
            if not reason and linear.quicker(n, len(self.u)):
                reason = "it is quicker for as many"
            kind = "multigrid" if reason and not self._condensed and not solvers else "direct"
        if kind == "multigrid" and self.unknowns.n_motions:
            kind, reason = "direct", "supports that move freely are no nodes with rigid motions"
        if reason and self._comm.rank == 0 and not self._condensed:
            n = self.unknowns.first_motion
            logger.info("linear systems of %d unknowns, solver %s: %s", n, kind, reason)
        return kind

    def _set_space(self, kept: npt.NDArray[np.int32] | None = None) -> None:
        """Take the space to iterate in: all unknowns, or those kept, by default those touched.

        Collective.
        """
        self._space = self._whole
        if self._condensed:
            kept = touched(self.operators, self.unknowns) if kept is None else kept
            self._space = CondensedSystem(
                self._whole, Selection(self.unknowns, kept), prefix=self.prefix + "interior_"
            )
            logger.info("condensed onto %d of %d unknowns", kept.size, self.unknowns.n_local)
        self._pairings = [c.pairings for c in self.contacts]
        self._solution: PETSc.Vec = self._space.vector()
        self._function: PETSc.Vec = self._space.vector()

    def _update_space(self, stiffness_changed: bool) -> None:
        """Follow changes of the pairs and of the bulk's tangent. Collective."""
        if self._pairings != [c.pairings for c in self.contacts]:
            if not self._condensed:
                self._set_space()
            else:
                # A body that slides comes back to places where it was: what is kept grows only.
                before = self._space.unknowns.kept
                kept = np.union1d(before, touched(self.operators, self.unknowns))
                if kept.size > before.size:
                    self._set_space(kept.astype(np.int32))
                self._pairings = [c.pairings for c in self.contacts]
            self.snes.reset()
            self._make_matrices()
        if stiffness_changed or not self._space.ready:
            self._factorisations += self._space.update(self._bulk_matrix)

    def _make_matrices(self) -> None:
        """New matrices for new couplings, or to forget all that was factored. Collective."""
        self._forget_matrices()
        self._attach(consistent=not self._quasi_newton)

    def _forget_matrices(self) -> None:
        """Drop the matrices of H₀ and of the consistent tangent. Collective."""
        self._matrices: dict[bool, PETSc.Mat] = {}
        self._filled: set[bool] = set()
        for ksp in self._solvers.values():
            ksp.reset()
        self._rounds.forget()
        self._predicts = False

    def _matrix(self, consistent: bool) -> PETSc.Mat:
        """The matrix of H₀ or of the consistent tangent, made when first needed. Collective."""
        if consistent not in self._matrices:
            symmetric = self._symmetric(consistent)
            matrix = self._space.matrix(self._bulk_matrix, symmetric=symmetric)
            self._space.prepare(self._solvers[consistent], matrix)
            self._matrices[consistent] = matrix
        return self._matrices[consistent]

    def _attach(self, *, consistent: bool) -> None:
        """Give SNES its callbacks and the linear solver for H₀ or the consistent tangent."""
        self._consistent = consistent
        # Weak, so that SNES does not keep the problem that keeps SNES: the garbage collector would
        # free such a cycle, at another time on every rank, and to free a factorisation is
        # collective.
        this: ContactProblem = weakref.proxy(self)
        self.snes.setKSP(self._solvers[consistent])
        self._callbacks.attach(
            self.snes,
            lambda x, f: this._compute_residual(x, f),
            self._function,
            lambda x, J: this._compute_jacobian(x, J),
            self._matrix(consistent),
            lambda: this._test_convergence(),
        )

    @property
    def has_potential(self) -> bool:
        """Whether every contact law has one."""
        return all(c.law.has_potential for c in self.contacts)

    # ---- SNES callbacks --------------------------------------------------------------------------

    def _set_u(self, x: PETSc.Vec) -> None:
        state = x.array_r * self._length
        # A V-cycle moves the prescribed unknowns too, which nothing would bring back.
        state[self._space.constrained] = self._space.prescribed
        self._space.set_state(state)

    def _compute_residual(self, x: PETSc.Vec, f: PETSc.Vec) -> None:
        self._set_u(x)
        contacts = self._space.contact_forces()
        total = sum(contacts, self._space.bulk_force())
        self._measure_norms(self._space, total, contacts)
        total[self._space.constrained] = 0.0
        f.array[:] = total / (self.bulk.scale * self._length)

    def _energy_at(self, x: PETSc.Vec) -> float:
        """Potential of a linear bulk and contacts, dimensionless as SNES sees it. Collective."""
        self._set_u(x)
        energy = self._space.bulk_energy() + sum(c.energy() for c in self.contacts)
        total = float(global_sum(self._comm, energy))
        return total / (self.bulk.scale * self._length**2)

    def _measure_norms(self, space: FullSystem, total: Array, contacts: Sequence[Array]) -> None:
        """Norms of residual and forces at the present state. Collective."""
        self._norms = space.parts.norms(
            total,
            contacts,
            space.load,
            space.terms(space.state()),
            space.constrained,
            space.outside,
            self._start_terms,
        )

    @property
    def rtol(self) -> float:
        """Residual that ends the present iteration, as a share of the forces."""
        return max(self._rtol, self._round_rtol)

    def _test_convergence(self) -> int:
        reasons = PETSc.SNES.ConvergedReason
        if self._norms.within(self.rtol):
            return int(reasons.CONVERGED_FNORM_RELATIVE)
        if self._watch.idle > _PATIENCE and self._may_climb():
            return int(reasons.DIVERGED_LINE_SEARCH)
        return int(reasons.ITERATING)

    def _compute_jacobian(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        if not self._quasi_newton:  # else H₀ is made between the rounds, and kept during one
            self._assemble_tangent(x, J)

    def _assemble_tangent(self, x: PETSc.Vec, J: PETSc.Mat) -> None:
        """The consistent tangent of bulk and contact. Collective."""
        residual = self._norms.total  # SNES has just computed it at x
        self._set_u(x)
        self._update_bulk()
        for contact in self.contacts:
            contact.evaluate()
        self._watch.note(residual)
        # Until enough points are closed to hold the body its tangent is singular: take H₀ of the
        # whole surface, as for the start of the quasi-Newton iteration.
        if self.motions.held(self.operators):
            self._assemble_matrix(J, self._tangents())
        else:
            self._assemble_matrix(J, self._stiffnesses(everywhere=True))

    def _assemble_matrix(self, matrix: PETSc.Mat, contacts: Iterable[PETSc.Mat]) -> None:
        """Bulk tangent plus contact, conditions applied, dimensionless. Collective.

        Args:
            matrix: What to fill.
            contacts: Contact's part, used up.
        """
        self._factorisations += self._space.fill(matrix, self._bulk_matrix, contacts)
        self._filled |= {c for c, m in self._matrices.items() if m.handle == matrix.handle}

    def _tangents(self) -> Iterator[PETSc.Mat]:
        return (operator.tangent() for operator in self._space.operators)

    def _stiffnesses(self, *, everywhere: bool) -> Iterator[PETSc.Mat]:
        """The shares αK_n + φK_t of the contacts, as evaluated.

        Args:
            everywhere: Take all of Γc as closed and sticking, as the paper does, where nothing
                can be told from the status.
        """
        for operator in self._space.operators:
            contact = operator.contact
            normal = tangential = np.ones(contact.quadrature.n_points)
            if not everywhere:
                normal = np.where(contact.status != Status.OPEN, 1.0, _OPEN_SHARE)
                tangential = np.where(contact.status == Status.STICK, 1.0, _OPEN_SHARE)
            springs = contact.springs(self._alpha * normal, self._phi * tangential)
            yield operator.springs(springs)

    def _clear_pairs(self, *, consistent: bool | None = None) -> None:
        """Forget the pairs of L-BFGS and keep the factorisation, which reset() would drop too."""
        self.snes.setKSP(PETSc.KSP().create(self._comm))
        self.snes.reset()
        self._attach(consistent=self._consistent if consistent is None else consistent)

    def _update_bulk(self) -> bool:
        """Assemble the bulk's tangent if it may have changed; True if it did. Collective."""
        changed = self.bulk.update()
        if changed and self.unknowns.n_motions:
            self._bulk_matrix.destroy()
            self._bulk_matrix = self.unknowns.widened(self.bulk.stiffness, rows=True)
        return changed

    # ---- the neighbourhood of a solution ---------------------------------------------------------

    @property
    def increments_wanted(self) -> int:
        """How many increments a load history takes for the accuracy; 1 if none is said."""
        friction = any(c.law.has_friction for c in self.contacts)
        return self.accuracy.increments if self.accuracy and friction else 1

    @property
    def operators(self) -> list[ContactOperator]:
        """The contacts over all unknowns, with the pairs as they are. Collective."""
        return self._whole.operators

    @property
    def load(self) -> Array:
        """External forces of the last solve at this rank's unknowns (force)."""
        return self._load

    @property
    def constrained(self) -> npt.NDArray[np.bool_]:
        """Mask over this rank's unknowns: those with Dirichlet conditions."""
        return self._constrained

    def present_state(self) -> Array:
        """This rank's unknowns as they are now, completed; a copy (length). Collective."""
        self.complete()
        return self._whole.state()

    @contextmanager
    def linearised(
        self, springs: Sequence[Array]
    ) -> Iterator[Callable[[Sequence[Array] | None], Array]]:
        """Solve with the bulk's tangent and given springs on Γc, about the present state.

        Collective.

        Args:
            springs: For every contact the stiffness at its points, (n_points, gdim, gdim)
                (stress/length).

        Yields:
            A function of the tractions that are added on the body, one array (n_points, gdim) for
            every contact, or of None for the residual that is left; it returns the change of this
            rank's unknowns. Collective.
        """
        self.complete()
        # After a history that was taken up and is at its end nothing has been assembled yet.
        self._update_space(self._update_bulk())
        self._predicts = False  # by the matrix that is about to be used
        space = self._space
        space.begin(self._load)
        right, left = space.vector(), space.vector()
        ksp = PETSc.KSP().create(self._comm)

        def solve(tractions: Sequence[Array] | None) -> Array:
            right.set(0.0)
            if tractions is None:
                right.array[:] = space.bulk_force() + space.contact_force()
            else:
                for operator, traction in zip(space.operators, tractions, strict=True):
                    operator.add_force(right, traction)
            right.array[space.constrained] = 0.0
            right.scale(-1.0 / self.bulk.scale)
            with interrupts_held():
                ksp.solve(right, left)
            dense.raise_kept(ksp)
            return space.extended(left.array_r.copy())

        try:
            matrices = (o.springs(s) for o, s in zip(space.operators, springs, strict=True))
            self._assemble_matrix(self._matrix(True), matrices)
            # The tangent's own solver may be a V-cycle and no more; after a factorisation GMRES
            # ends with its first iteration.
            ksp.setOperators(self._matrix(True))
            ksp.setType(PETSc.KSP.Type.GMRES)
            ksp.setPC(self._solvers[True].getPC())
            ksp.setTolerances(rtol=1e-8, max_it=1000)
            yield solve
        finally:
            for item in (ksp, right, left):
                item.destroy()

    # ---- solving ---------------------------------------------------------------------------------

    @interrupts_held()
    def solve(self, *, ahead: float = 1.0, field: bool = True) -> Step:
        """Solve the next increment with the loads and conditions as they are now. Collective.

        The history does not change: `commit` does that.

        Args:
            ahead: Size of this increment in units of the last one, for the guess to start from.
            field: Whether to find all of u. If not, and if the problem is condensed, u may stay
                behind: then only what contact touches, all results of the contacts included, is
                that of the increment, and the verdict is on the condensed equations. `complete`
                brings up the rest, for a fifteenth to a thirtieth of a factorisation.

        Returns:
            What was done, the verdict included.

        Raises:
            NotConverged: No solution was found, or what was found failed the verdict; u and
                history are as before.
            ValueError: Input that is not finite, out of range, or a load that no contact force
                can balance.
        """
        start = time.perf_counter()
        self._fresh = False
        saved = self._whole.state(), self._load, self._pending_field, self._energy
        try:
            # A trial of a line search may overflow, and the convergence test and the verdict see
            # it: a warning, on the rank that has the point, must not become an error there alone.
            with self._options.present(), np.errstate(all="ignore"):
                step = self._solve(start, ahead, field)
                release_interrupt()
        except BaseException as error:
            fail_together(self._comm, error)
            state, self._load, self._pending_field, self._energy = saved
            self._whole.set_state(state)
            for contact in self.contacts:
                contact.restore()
            if not isinstance(error, NotConverged | ValueError):
                self._recover()
            raise
        finally:
            if self._comm.rank == 0:
                self._options.warn_of_unread(self.prefix)
        return step

    def _solve(self, start: float, ahead: float, field: bool) -> Step:
        pairings = [c.pairings for c in self.contacts]
        if self._pending_field is not None and not (
            self.bulk.is_current() and pairings == self._pairings
        ):
            self.complete()  # what it takes is about to go
        self._check_before()
        for bc in self._bcs:
            bc.set(self.u.x.array)
        self.u.x.scatter_forward()
        self._factorisations = 0
        stiffness_changed = self._update_bulk()
        self._update_space(stiffness_changed)
        self._approach()
        self._imposed = self._imposed_length()
        self._whole.reach = self._space.reach = _REACH * self._imposed
        self._space.begin(self._load)
        self._start_terms = np.zeros_like(self._start_terms)
        reason, attempts, rounds = self._enforce(ahead, stiffness_changed)
        lags = not field and self._may_lag()
        judge = self._judge_kept if lags else self._judge_all
        verdict = judge(kinematics=reason > 0)  # a solver that failed may have no factors for it
        if reason <= 0 or verdict.failures:
            raise self._not_converged(reason, verdict, attempts)
        energy = self._energy.since(self._committed_energy, self.contacts, self._comm)
        verdict = replace(verdict, created=energy.created)
        if verdict.failures:
            raise self._not_converged(reason, verdict, attempts)
        self._warn_of_large_motion(verdict)
        self._solved = _Solved(self._whole.state(), [c.found() for c in self.contacts])
        return Step(
            increment=self.increment + 1,
            reason=reason,
            iterations=sum(attempt.iterations for attempt in attempts),
            rounds=rounds,
            method=attempts[-1].method,
            factorisations=self._factorisations,
            verdict=verdict,
            contacts={c.name: c.resultants() for c in self.contacts},
            energy=energy,
            attempts=tuple(attempts),
            wall_seconds=time.perf_counter() - start,
            complete=not lags,
        )

    def _not_converged(
        self, reason: int, verdict: Verdict, attempts: Sequence[Attempt]
    ) -> NotConverged:
        return NotConverged(self.increment + 1, reason, verdict, attempts, prefix=self.prefix)

    def _may_lag(self) -> bool:
        """Whether u can stay behind: energies and pairs must be found without it. Collective."""
        if not (self._condensed and self.bulk.symmetric):
            return False
        if self.increment == 0 and not self._committed.any():
            nothing = Forces.none(np.zeros(1))
            self._committed_energy.forces.setdefault(self._space.mark, nothing)
        follows = any(contact.pairs_anew for contact in self.contacts)
        return self._space.mark in self._committed_energy.forces and not follows

    def complete(self) -> Verdict | None:
        """Bring all of u up to the increment solved last, if it is behind. Collective.

        See `solve` with ``field=False``, and `increments`. The field is checked apart from how it
        was found: the product of the bulk's matrix with it must meet loads and contact forces.

        Returns:
            The verdict; None if nothing was behind.

        Raises:
            NotConverged: The equations do not hold on all of u.
        """
        if self._pending_field is None:
            return None
        committed = self._committed_lag[0] is self._pending_field
        self._space.complete(self._pending_field)
        self._pending_field = None
        state, image = self.unknowns.vector(), self.unknowns.vector()
        state.array[:] = self._whole.state()
        self._bulk_matrix.mult(state, image)
        self._whole.begin(self._load)
        bulk = image.array_r - self._load
        verdict, reaction = self._judge(self._whole, bulk, laws=False)
        energy = self._committed_energy if committed else self._energy
        energy.forces[self._whole.mark] = self._whole.forces(bulk, reaction)
        if committed:
            self._committed = self._whole.state()
            self._committed_lag = None, self._load
        elif self._solved is not None:
            self._solved = replace(self._solved, state=self._whole.state())
        for vector in (state, image):
            vector.destroy()
        if verdict.failures:
            number = self.increment + (not committed)
            reason = int(self.snes.getConvergedReason())
            raise NotConverged(number, reason, verdict, prefix=self.prefix)
        return verdict

    def _enforce(self, ahead: float, stiffness_changed: bool) -> tuple[int, list[Attempt], int]:
        """Solve, let multipliers take over what the springs bear, and again. Collective.

        Returns:
            Reason of the last solution, what was tried, and how many solutions there were.
        """
        augmented = [c for c in self.contacts if c.multipliers is not None]
        if not augmented:
            return *self._iterate(ahead, stiffness_changed), 1
        attempts: list[Attempt] = []
        exact = False
        # The first solutions need not be better than the multipliers they are found with.
        self._round_rtol = _FIRST_ROUND
        try:
            for number in range(1, _MAX_ROUNDS + 1):
                reason, tried = self._iterate(ahead, stiffness_changed)
                for attempt in tried:
                    last = attempts[-1] if attempts else None
                    if last and (last.method, last.outcome) == (attempt.method, attempt.outcome):
                        attempts[-1] = replace(
                            attempt, iterations=last.iterations + attempt.iterations
                        )
                    else:
                        attempts.append(attempt)
                if reason <= 0:
                    break
                for contact in augmented:
                    contact.evaluate()
                errors = [c.enforcement_error() for c in augmented]
                worst = max(e / c.tolerance for e, c in zip(errors, augmented, strict=True))
                logger.debug("round %d: errors %s", number, errors)
                if worst <= 1.0 and exact:
                    break
                ahead, stiffness_changed = 0.0, False
                exact = worst <= _NEARLY
                left = min((e for e in errors if e > 0), default=0.0)
                self._round_rtol = 0.0 if exact else min(_FIRST_ROUND, _INNER * left)
                if number < _MAX_ROUNDS and worst > 1.0:
                    for contact in augmented:
                        contact.augment()
        finally:
            self._round_rtol = 0.0
        return reason, attempts, number

    def _iterate(self, ahead: float, stiffness_changed: bool) -> tuple[int, list[Attempt]]:
        """Iterate from one start after another, then by continuation. Collective.

        Returns:
            Reason, and what was tried.
        """
        reason, attempts = int(PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE), []
        factored = self._predicts
        starts = [start / self._length for start in self._starts(ahead)]
        tries = [(start, self._method) for start in starts]
        climbs = self._may_climb()
        cold = self._cold and ahead > 0.0  # and no later round of multipliers
        if climbs and cold and self._automatic and self._condensed:
            # From nothing, Newton's method on the stiff problem often gives up first.
            tries = [(starts[0], _LAST_RESORT)]
        elif climbs:
            tries.append((starts[0], _LAST_RESORT))
        for start, method in tries:
            self._solution.array[:] = start
            self._watch.start()
            iterations, reason = self._solve_by(method, stiffness_changed)
            attempts.append(Attempt(method, iterations, self._outcome(reason)))
            if reason > 0:
                break
            if self._comm.rank == 0:
                logger.info("increment %d: %s", self.increment + 1, attempts[-1])
        self._set_u(self._solution)
        newton = method not in ("alternating", "continuation") and not self._quasi_newton
        made = sum(attempt.iterations for attempt in attempts[-1:])
        self._predicts = reason > 0 and newton and (factored or made > 0)
        return int(reason), attempts

    def _solve_by(self, method: str, stiffness_changed: bool) -> tuple[int, int]:
        """Iterations and reason of one method, from ``_solution``. Collective."""
        if method == "alternating":
            return self._alternation.solve(self._solution)
        if method == "continuation":
            return self._continuation.solve()
        if self._quasi_newton:
            return self._rounds.solve(stiffness_changed)
        return self._callbacks.solve(self.snes, self._solution)

    def _recover(self) -> None:
        """Replace what an error of PETSc may have left locked or half done. Collective."""
        self._solution, self._function = self._space.vector(), self._space.vector()
        self.snes.reset()
        self._make_matrices()

    def _outcome(self, reason: int) -> str:
        """What became of a attempt, in words. Collective."""
        if reason > 0:
            return "converged"
        words = _OUTCOMES.get(reason, f"SNES reason {reason}")
        return "; ".join(filter(None, (words, self._watch.chattering())))

    def _may_climb(self) -> bool:
        """Whether to go on after a failure: not if iterations are rationed by the caller."""
        limit = self._max_it if self._quasi_newton else self.snes.getTolerances()[3]
        return (
            self._fallback
            and self._method != _LAST_RESORT
            and limit >= (_COMMON | _METHODS[self._method])["snes_max_it"]
        )

    def _hardness(self) -> float:
        """Largest ratio of contact's stiffness to the bulk's at an unknown. Collective."""
        diagonals = []
        for operators in ([], self._space.operators):
            parts = (o.springs(o.contact.springs(1.0, 1.0)) for o in operators)
            self._space.fill(self._matrix(True), self._bulk_matrix, parts)
            diagonals.append(self._space.diagonal.copy())
        bulk, both = diagonals
        felt = bulk > _FELT * self.bulk.scale  # the motion of a support has no stiffness
        return global_max(self._comm, both[felt] / bulk[felt] - 1.0)

    def _check_before(self) -> None:
        self.bulk.check_finite()
        for contact in self.contacts:
            contact.check_input()
        self._load = -self._whole.with_supports(self.bulk.update_load())
        size = global_max(self._comm, np.abs(self._load))
        if not np.isfinite(size):
            raise ValueError("the external load is not finite (NaN or inf) at some dof")
        for number, bc in enumerate(self._bcs):
            values = np.zeros_like(self.u.x.array)
            bc.set(values)
            if not np.isfinite(global_max(self._comm, np.abs(values))):
                raise ValueError(
                    f"Dirichlet condition number {number} has values that are not finite"
                )
        if self.bulk.linear:
            self.motions.check_balance(self._load, self.operators)

    def _starts(self, ahead: float) -> list[Array]:
        """Unknowns of the space to start from, nearest to equilibrium first. Collective.

        The present state; that state moved on by as much as the last increment moved it: in
        proportional loading that is the solution; and that state with one step of Newton's method
        on the tangent in which the last increment ended. At the present state itself no point has
        slipped yet, and all closed ones stick: from there Newton's method takes ten steps to let
        them slip again, one after another from the edge of the contact inwards. The start by a step
        has the right ones slipping, and comes first unless it is far off.
        """
        present: Array = self._space.state()
        starts = [present]
        # What a step from here takes away leaves the round-off of what was there.
        terms: Array = self._space.by_body(self._space.terms(present))[0]
        terms = np.asarray(np.hypot(terms, self._space.outside[1]), dtype=np.float64)
        # The last matrix may be that of a step that overflowed. Later rounds of multipliers have
        # the round-off of the first one's start, too.
        terms = np.where(np.isfinite(terms), terms, 0.0)
        self._start_terms = np.maximum(self._start_terms, terms)
        residuals = [self._residual_at(present)]
        # Where nothing was borne yet the last increment tells nothing of this one.
        predicts = self._predicts and not self._cold
        if predicts:
            starts.append(self._predicted(present))
        if self._rate is not None and ahead and not self._cold:
            starts.append(present + ahead * self._space.part(self._rate))
        residuals += [self._residual_at(start) for start in starts[1:]]
        if predicts and residuals[1] <= _FAR * min(residuals):
            residuals[1] = 0.0
        return [starts[i] for i in np.argsort(residuals, kind="stable")]

    def _residual_at(self, state: Array) -> float:
        """Norm of the residual at a state of the space, left in ``_function``. Collective."""
        self._solution.array[:] = state / self._length
        self._compute_residual(self._solution, self._function)
        return self._norms.total

    def _predicted(self, present: Array) -> Array:
        """One Newton step on the tangent factored last; the residual is there. Collective."""
        self._predicts = False
        step = self._solution.duplicate()
        self._solvers[True].solve(self._function, step)
        dense.raise_kept(self._solvers[True])
        moved = present - self._length * step.array_r
        step.destroy()
        return np.asarray(moved, dtype=np.float64)

    def _approach(self) -> None:
        """Move bodies that nothing holds yet to first touch, along their load. Collective.

        One that was released before rests wherever that ended, turned perhaps by more than the load
        will press it together: it starts again from where it began.
        """
        self._cold = self.increment == 0
        if not len(self.motions.free):
            return
        borne, load = (
            np.abs(self.motions.resultants(forces)).max()
            for forces in (self._whole.contact_force(), self._load)
        )
        if borne < _IDLE * load:
            self._cold = True
            self._whole.set_state(np.where(self._constrained, self._whole.state(), self._rest))
        for contact in self.contacts:
            contact.evaluate()
        touching = [bool(np.any(c.status != Status.OPEN)) for c in self.contacts]
        if self._comm.allreduce(any(touching)):
            return
        way = self.motions.approach(self._load, self.operators)
        if way is not None:
            self._whole.set_state(self._whole.state() + way)

    def _judge_all(self, *, kinematics: bool) -> Verdict:
        """Complete u and judge by assembly, past SNES and its residual. Collective."""
        self._space.complete(self._space.pending_field)
        self._pending_field = None
        for contact in self.contacts:
            contact.evaluate()
        bulk = self._whole.with_supports(self.bulk.assemble_residual())
        verdict, reaction = self._judge(self._whole, bulk, kinematics=kinematics)
        forces: dict[object, Forces] = {self._whole.mark: self._whole.forces(bulk, reaction)}
        if self._condensed and self.bulk.symmetric:
            forces[self._space.mark] = self._forces_kept()
        self._energy = EnergyState.at(forces, self.contacts)
        return verdict

    def _judge_kept(self, *, kinematics: bool) -> Verdict:
        """Judge the condensed equations; u stays behind. One rank only."""
        self._pending_field = self._space.pending_field
        for contact in self.contacts:
            contact.evaluate()
        bulk = self._space.bulk_force()
        verdict, _ = self._judge(self._space, bulk, kinematics=kinematics)
        forces: dict[object, Forces] = {self._space.mark: self._forces_kept()}
        self._energy = EnergyState.at(forces, self.contacts)
        return verdict

    def _forces_kept(self) -> Forces:
        bulk, contact = self._space.bulk_force(), self._space.contact_force()
        return self._space.forces(bulk, np.where(self._space.constrained, bulk + contact, 0.0))

    def _judge(
        self, space: FullSystem, bulk: Array, *, laws: bool = True, kinematics: bool = False
    ) -> tuple[Verdict, Array]:
        """Recompute residual, balance and laws at evaluated contacts. Collective.

        Args:
            space: The unknowns on which the residual is looked at.
            bulk: Residual of the bulk on these.
            laws: Whether to check the laws, too.
            kinematics: Whether to look at what small displacements leave out.

        Returns:
            The verdict, and the reactions at the unknowns.
        """
        contacts = space.contact_forces()
        total = sum(contacts, bulk)
        self._measure_norms(space, total, contacts)
        norms = self._norms
        names, tolerance = space.parts.names, norms.tolerance(self.rtol)
        reaction = np.where(space.constrained, total, 0.0)
        imbalance, sizes = self._force_sums(space, bulk - reaction, [bulk, *contacts])
        allowed = np.sqrt(sizes[0]) * 2 * tolerance[: len(imbalance)] + 1e-12 * sizes[1]
        augmented = [c for c in self.contacts if c.multipliers is not None and laws]
        equations = zip(names, norms.residual, norms.force, tolerance, strict=True)
        sums = zip(names, np.abs(imbalance).max(axis=1), sizes[1], allowed, strict=False)
        verdict = Verdict(
            equations={name: Balance(*map(float, row)) for name, *row in equations},
            sums={name: Balance(*map(float, row)) for name, *row in sums},
            laws={c.name: check_laws(c) for c in self.contacts} if laws else {},
            enforcement={c.name: c.enforcement_error() for c in augmented},
            enforcement_tolerance={c.name: c.tolerance for c in augmented},
            # Of the opposite only what Γc meets is known before u is complete.
            unseen=passing(self.contacts) if space is self._whole else {},
            kinematics=self._linearisation() if kinematics else {},
            kinematics_allowed=self.kinematics,
            displacement=self._farthest(),
            routes=self._compare_routes() if self._second_route and laws else {},
        )
        return verdict, reaction

    def _imposed_length(self) -> float:
        """Size of the mesh, or of the motions and gaps that are imposed if larger. Collective."""
        imposed = [self._whole.state()[self._constrained]]
        for contact in self.contacts:
            imposed += [contact.values[name] for name in ("shift", "gap")]
        return max(self._length, *(global_max(self._comm, np.abs(v)) for v in imposed))

    def _farthest(self) -> float:
        """Largest displacement by what is imposed. Collective."""
        return global_max(self._comm, np.abs(self.u.x.array)) / self._imposed

    def _compare_routes(self) -> dict[str, Balance]:
        """Nodal forces on Γc as the solver has them against those of the boundary form. Collective.

        Both have the round-off of the displacement, by as much as the springs are stiff.
        """
        found = {}
        for contact in self.contacts:
            mine, assembled = contact.own_forces()
            values = contact.values
            stiffness = np.zeros(len(values["gap"]))
            if contact.law.has_normal_stiffness:
                stiffness += contact.normal_stiffness
            if contact.law.has_tangential:
                stiffness += np.abs(contact.tangential_stiffness).max(axis=(1, 2))
            terms = np.linalg.norm(values["jump"], axis=1) + np.abs(values["gap"])
            blur = float(global_sum(self._comm, contact.measure @ (stiffness * terms)))
            sizes = (global_max(self._comm, np.abs(f)) for f in (mine - assembled, mine))
            residual, force = (float(size) for size in sizes)
            allowed = 1e-10 * force + _ROUND_OFF * blur
            found[contact.name] = Balance(residual, force, allowed)
        return found

    def _linearisation(self) -> dict[str, Linearisation]:
        """What taking displacements as small changes at the state judged, by contact. Collective.

        To some digits: with the matrix factored last, which is the tangent near the solution.
        """
        if not self.contacts:
            return {}
        space, consistent = self._space, self._consistent or self._filled != {False}
        modulus = self.bulk.scale * self._cell_size ** (2 - len(self.u))

        def respond(springs: Sequence[Array], tractions: Sequence[Array]) -> list[Array]:
            right, left, diagonal = space.vector(), space.vector(), space.diagonal
            matrix = space.matrix(self._bulk_matrix, symmetric=False)
            ksp = PETSc.KSP().create(self._comm)
            try:
                if consistent not in self._filled:  # nothing was iterated yet
                    self._assemble_matrix(self._matrix(consistent), self._tangents())
                parts = (o.springs(k) for o, k in zip(space.operators, springs, strict=True))
                space.fill(matrix, self._bulk_matrix, parts)
                for operator, traction in zip(space.operators, tractions, strict=True):
                    operator.add_force(right, traction)
                right.array[space.constrained] = 0.0
                right.scale(-1.0 / self.bulk.scale)
                ksp.setOperators(matrix)
                ksp.setType(PETSc.KSP.Type.FGMRES)
                ksp.getPC().setType("python")
                ksp.getPC().setPythonContext(_Nearby(self._solvers[consistent]))
                ksp.setTolerances(rtol=_NOTABLE**2, max_it=100)
                ksp.solve(right, left)
                return [operator.jump(left.array_r) for operator in space.operators]
            finally:
                space.diagonal = diagonal
                for item in (ksp, matrix, right, left):
                    item.destroy()

        return linearisation(self.contacts, modulus, respond)

    def _warn_of_large_motion(self, verdict: Verdict) -> None:
        """Say once of every contact that displacements are not small. Collective."""
        for name, found in verdict.kinematics.items():
            if found.worst > _NOTABLE and name not in self._large:
                self._large.add(name)
                warn(
                    self._comm,
                    f"{name}: displacements are taken as small, with gap and normals of the "
                    "undeformed body; where it has moved to, the contact force would differ by "
                    f"{100 * found.force:.2g} % and the pressure by {100 * found.pressure:.2g} %",
                )

    def _force_sums(
        self, space: FullSystem, internal: Array, forces: Sequence[Array]
    ) -> tuple[Array, Array]:
        """What does not cancel of ∑F(u) - reactions - ∫ (r_n n + τ) on every body. Collective.

        Moments, too. The last is the contacts' own sum over their points, not that of their nodal
        forces.

        Args:
            space: The unknowns.
            internal: Residual of the bulk without reactions, (n_local,).
            forces: What tells how large all forces are, (n_local,) each.

        Returns:
            The sums, (n_bodies, n_per_body) (force), see `RigidMotions.work`; of every body the
            number of its unknowns, and the sum of the absolute forces, (2, n_bodies).
        """
        motions, n = self.motions.of_bodies, self._whole.n_bodies - self.unknowns.n_motions
        total = np.array([[space.part(mode) @ internal for mode in body] for body in motions])
        for operator in self.operators:
            contact = operator.contact
            total -= self.motions.work(operator, contact.measure[:, None] * contact.traction)
        count = np.bincount(space.label, minlength=n)[:n]
        sizes = [np.bincount(space.label, np.abs(f), minlength=n)[:n] for f in forces]
        sums = global_sum(self._comm, np.stack([*total.T, count, np.sum(sizes, axis=0)]))
        # What cannot be told is left out; a force that is no number is seen by the translations.
        rotations = sums[len(self.u) : -2]
        rotations[np.isnan(rotations)] = 0.0
        return sums[:-2].T, sums[-2:]

    @interrupts_held()
    def commit(self) -> None:
        """Make the solved state the start of the next increment, history included. Collective.

        It is what `solve` found, whatever has changed since: constants, or u. Where nothing was
        solved since the last commit nothing happens. If it fails, the history is as before.
        """
        solved, self._solved = self._solved, None
        if solved is None:
            return
        before = [c.history.function.x.array.copy() for c in self.contacts]
        try:
            self._whole.set_state(solved.state)
            for contact, found in zip(self.contacts, solved.contacts, strict=True):
                contact.commit(found)
        except BaseException as error:
            fail_together(self._comm, error)
            for contact, values in zip(self.contacts, before, strict=True):
                contact.history.function.x.array[:] = values
            self.restore()
            raise
        state = self._whole.state()
        self._rate = state - self._committed
        self._committed = state
        self._committed_lag = self._pending_field, self._load
        self._committed_energy = self._energy.between([c.committed_jump for c in self.contacts])
        self.increment += 1

    def restore(self) -> None:
        """Drop a solved increment that was not committed: u is that of the last commit again.

        The history needs no restoring: it changes at `commit` alone. Collective.
        """
        self._solved = None
        self._whole.set_state(self._committed)
        self._pending_field, self._load = self._committed_lag
        for contact in self.contacts:
            contact.restore()

    # ---- going on in another run -----------------------------------------------------------------

    def committed_state(self) -> tuple[Array, Array]:
        """What another run needs of the last commit to go on from it. Collective.

        u is completed, if it is behind.

        Returns:
            Rows over this rank's unknowns, (6, n_local): their values, by how much the last
            increment moved them, internal and external forces at them (force), and masks of those
            kept when condensed and of those with Dirichlet conditions; and two numbers: of
            increments, and how many of them were expected.

        Raises:
            ValueError: The state is not that of the last commit.
        """
        now = self._whole.state()
        differs = self._pending_field is not self._committed_lag[0] or not np.array_equal(
            now, self._committed
        )
        if self._comm.allreduce(int(differs)):
            raise ValueError(
                "u is not that of the last commit: a solved increment was not committed, or its "
                "values were changed; call commit() or restore() before the state is saved"
            )
        self.complete()
        forces = self._committed_energy.forces[self._whole.mark]
        kept = np.zeros(self.unknowns.n_local)
        if self._condensed:
            kept[self._space.unknowns.kept] = 1.0
        rate = np.zeros_like(kept) if self._rate is None else self._rate
        rows = (self._committed, rate, forces.internal, forces.external, kept, self._constrained)
        numbers = np.array([self.increment, self._expected], dtype=np.float64)
        return np.stack(rows).astype(np.float64), numbers

    @contextmanager
    def at_state(self, state: Array) -> Iterator[None]:
        """Let unknowns be the present ones inside of the block. Collective."""
        before = self._whole.state()
        try:
            self._whole.set_state(state)
            yield
        finally:
            self._whole.set_state(before)

    def present_load(self) -> Array:
        """External forces as they are now at this rank's unknowns (force). Collective."""
        return -self._whole.with_supports(self.bulk.update_load())

    def prescribed_values(self) -> Array:
        """Values of the Dirichlet conditions as they are now, u elsewhere, at the unknowns."""
        values = self.u.x.array.copy()
        for bc in self._bcs:
            bc.set(values)
        return self.unknowns.joined(values[: self._n_owned], np.zeros(self.unknowns.n_motions))

    def set_committed(
        self,
        rows: Array,
        numbers: Array,
        points: Sequence[tuple[Array, Mapping[str, Array]]],
    ) -> None:
        """Take up what `committed_state` gave in another run, under its loads. Collective.

        Args:
            rows: What it gave.
            numbers: Likewise.
            points: Of every contact what `Contact.take_up` takes.
        """
        state, rate, internal, external, kept, _ = rows
        increment, expected = (int(value) for value in numbers)
        self.expect(expected)
        self._fresh, self._solved = False, None
        if self._condensed and kept.any():
            self._set_space(np.flatnonzero(kept).astype(np.int32))
            self.snes.reset()
        self.increment = increment
        self._committed, self._rate = state.copy(), rate.copy() if increment else None
        self._whole.set_state(state)
        self._pending_field, self._load = None, self.present_load()
        self._committed_lag = None, self._load
        self._whole.begin(self._load)
        for contact, (history, values) in zip(self.contacts, points, strict=True):
            contact.take_up(history, values)
        forces: dict[object, Forces] = {self._whole.mark: Forces(state, internal, external)}
        energy = EnergyState.at(forces, self.contacts)
        self._energy = energy.between([c.committed_jump for c in self.contacts])
        self._committed_energy = self._energy
        self.restart_solver()

    def restart_solver(self) -> None:
        """Drop what the solver has kept from earlier increments. Collective."""
        self._space.forget()
        self._make_matrices()
        for mark in set(self._committed_energy.forces) - {self._whole.mark}:
            del self._committed_energy.forces[mark]


class _Nearby:
    """A preconditioner: the solver of a matrix that differs by the status of some points."""

    def __init__(self, ksp: PETSc.KSP) -> None:
        ksp.setUp()
        self._pc = ksp.getPC()

    def apply(self, pc: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """For PETSc."""
        self._pc.apply(x, y)


def _facets_held(contact: Contact, constrained: Array) -> int:
    """Number of this rank's facets of Γc all of whose displacements are prescribed."""
    space = contact.u.function_space
    mesh, dofmap = space.mesh, space.dofmap
    facets = contact.surface.facets
    held: npt.NDArray[np.bool_] = np.all(constrained.reshape(-1, dofmap.bs), axis=1)
    count = 0
    for cell, local in zip(facet_cells(mesh, facets), local_facets(mesh, facets), strict=True):
        closure = dofmap.dof_layout.entity_closure_dofs(mesh.topology.dim - 1, local)
        count += bool(held[dofmap.cell_dofs(cell)[closure]].all())
    return count
