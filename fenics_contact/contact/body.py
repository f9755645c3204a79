"""Kinematics of contact between Γc and an opposing deformable body."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import ufl
from dolfinx import fem

from fenics_contact.contact.contact_kinematics import ContactKinematics, ContactParts
from fenics_contact.contact.finite_sliding import FiniteSlidingKinematics, FiniteSlidingPairs
from fenics_contact.contact.pairs import Pairs
from fenics_contact.contact.point_law import PointLaw, PointTangent
from fenics_contact.contact.values import PointValues
from fenics_contact.obstacles.base import Placement
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.parallel import global_max
from fenics_contact.types import Array, Mask

__all__ = ["MAX_SLIDE", "NEGLIGIBLE_SLIDE", "BodyFinite", "BodySmall"]

# Slide relative to the facet size above which pairs of the undeformed bodies are replaced. In
# partial slip of fine meshes the slide is half a facet: an update would make displacements deviate
# from proportionality to the load (0.3 %), and the energy of a fretting cycle from Mindlin's.
MAX_SLIDE = 1.0
# Slide relative to the facet size below which pairs need no update.
NEGLIGIBLE_SLIDE = 1e-2


class BodySmall(ContactKinematics):
    """Small displacements between bodies, with pairs of the undeformed or of deformed bodies."""

    is_rigid = False

    def __init__(self, parts: ContactParts, pairs: Pairs | None = None) -> None:
        pairs = pairs or parts.new_pairs()
        assert pairs.distance is not None
        normal = ufl.FacetNormal(parts.quadrature.surface.mesh)
        super().__init__(parts, pairs, parts.new_jump(), Placement(pairs.distance, normal))

    def outputs(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """Return the fields of `ContactKinematics.outputs`, pairing, depth and slide."""
        outputs = super().outputs(arrays) | self._pair_outputs(arrays)
        pairing_jump = 0.0 if self.pairs.pairing_jump is None else self.pairs.pairing_jump
        slide, normal = outputs["jump"] - pairing_jump, arrays["normal"]
        slide = slide - np.sum(slide * normal, axis=1)[:, None] * normal
        return outputs | {"slide": slide}

    def _pair_outputs(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """Return pairing and penetration depth of the points."""
        depth = self.pairs.depth(arrays["normal_displacement"])
        return {"paired": self.pairs.paired.astype(np.float64), "depth": depth}

    def true_placement(self, values: PointValues) -> tuple[Array, Array]:
        """Return gap and normal at X + u by a separate search. Collective."""
        return self.pairs.true_gap(values)

    def deviation(self, values: PointValues) -> tuple[Array, Array]:
        """Return the true gap minus the linearised gap, and the true normal. Collective."""
        gap, normal = self.true_placement(values)
        linear = np.where(self.pairs.paired, self.pairs.linear_gap(values.normal), 0.0)
        return gap - linear, normal

    @property
    def updates_pairs(self) -> bool:
        """Whether pairs are updated at every commit and where bodies slide."""
        has_updated = self.pairs.pairing_displacement is not None
        return self._update_policy == "increment" or (self._update_policy == "auto" and has_updated)

    @property
    def can_update_pairs(self) -> bool:
        """Whether pairs may be updated, unless ``update_pairs`` is "never"."""
        return self._update_policy != "never"

    @property
    def _update_policy(self) -> str:
        obstacle = self._parts.obstacle
        assert isinstance(obstacle, DeformableBody)
        return obstacle.update_pairs

    def needs_pair_update(self, values: PointValues) -> bool:
        """Whether `commit` will update the pairs, for which it needs all of ``u``. Collective."""
        if self.updates_pairs or self._update_policy != "auto":
            return self.updates_pairs
        comm, paired = self._mesh.comm, self.pairs.paired
        if comm.allreduce(int(np.any(self.transmitting_points(values)))):
            return self.largest_slide(values) > MAX_SLIDE
        # Pairs of open points matter only if a body has been displaced as a whole; without any
        # pair it may have come to some.
        if comm.allreduce(int(np.any(paired))):
            return self._largest_ratio(values.slide, paired) > MAX_SLIDE
        return self._largest_ratio(self.pairs.own_displacement(), ~paired) > MAX_SLIDE

    def needs_new_pairs(self, values: PointValues, of: PointValues | None = None) -> bool:
        """Whether points have slid off their pairs, or could be paired now. Collective."""
        if not self.can_update_pairs:
            return False
        return self.largest_slide(values, of) > self.slide_limit or self._has_new_pairs(values)

    def _has_new_pairs(self, values: PointValues) -> bool:
        """Whether unpaired points that have slid have an opposite point now. Collective."""
        pairs = self.pairs
        if pairs.n_unpaired == 0:
            return False
        displacement = pairs.displacement_since_pairing()
        displacement -= np.sum(displacement * values.normal, axis=1)[:, None] * values.normal
        if not self._largest_ratio(displacement, ~pairs.paired) > self.slide_limit:
            return False
        gap, _ = self.true_placement(values)
        return bool(self._mesh.comm.allreduce(int(np.any(~np.isnan(gap) & ~pairs.paired))))

    def transmitting_points(self, values: PointValues) -> Mask:
        """Return a mask of the points that transmit forces to another body, (n_points,)."""
        return self.pairs.paired & (np.abs(values.total_traction).max(axis=1) > 0)

    def largest_slide(self, values: PointValues, of: PointValues | None = None) -> float:
        """Return the largest slide of points that transmit forces, per facet size. Collective."""
        return self._largest_ratio(values.slide, self.transmitting_points(of or values))

    @property
    def slide_limit(self) -> float:
        """Largest admissible `largest_slide` of a solution."""
        return NEGLIGIBLE_SLIDE if self.updates_pairs else MAX_SLIDE

    def _largest_ratio(self, displacements: Array, points: Mask) -> float:
        """Return the largest displacement of some points per facet size. Collective."""
        lengths = np.linalg.norm(displacements, axis=1) / self._parts.quadrature.facet_sizes
        return global_max(self._mesh.comm, lengths[points])

    def find_pairs(self, u: fem.Function | None, depth: Array) -> None:
        """Find the opposite points in a displacement. Collective."""
        self.update_data()
        self._parts.displacement.update()
        self.pairs.find(self.data.values["x"], self.data.values["normal"], depth, u)

    def resume(self, depth: Array, evaluate: Callable[[], PointValues], *, new_pairs: bool) -> None:
        """Make the present ``u`` the committed displacement of another run. Collective."""
        if new_pairs:
            self.find_pairs(self._parts.displacement.u, depth)
        super().resume(depth, evaluate, new_pairs=new_pairs)
        if new_pairs:  # with the same round-off as in `commit`
            self.committed_jump = self.present_jump()

    def commit(self, values: PointValues) -> Array | None:
        """Make an evaluated state the committed one; return the change of the jump. Collective."""
        needs_update = self.needs_pair_update(values)
        super().commit(values)
        if not needs_update:
            return None
        # Tractions are fields of Γc and need no transfer, but the slip reference changes.
        self.find_pairs(self._parts.displacement.u, values.depth)
        return self.update_committed_jump()


class BodyFinite(BodySmall):
    """Finite sliding between bodies: the pairs follow the deformed bodies."""

    is_finite = True
    pairs_follow_bodies = True

    def __init__(self, parts: ContactParts) -> None:
        obstacle = parts.obstacle
        assert isinstance(obstacle, DeformableBody)
        pairs = FiniteSlidingPairs(parts.name, parts.displacement.u, parts.quadrature, obstacle)
        super().__init__(parts, pairs)
        self._finite = pairs
        self.local_jump = pairs.local_jump.function
        self.in_form = self.at_points = FiniteSlidingKinematics(parts.multipliers)

    def update(self) -> None:
        """Update data, pairs and jump to the present data and ``u``. Collective."""
        self.update_data()
        data, history = self.data.values, self._parts.history
        self._parts.displacement.update()
        self._finite.update(data["x"], data["normal"], history, self._parts.multipliers or history)
        self._update_jump()

    def outputs(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """Return the fields of `ContactKinematics.outputs`, with the jump since the last commit."""
        pairs, normal = self._finite, self._finite.local_jump.values("normal")
        outputs = self._pair_outputs(arrays) | {"normal": normal, "jump": pairs.jump_increment()}
        if not self._parts.law.has_friction:
            return outputs
        outputs |= self._to_history_frame(arrays, normal)
        traction = pairs.rotate(self._parts.history.values("traction"))
        traction -= np.sum(traction * normal, axis=1)[:, None] * normal
        zeros = np.zeros_like(normal)
        return outputs | {"projection_point": zeros, "carried_traction": traction}

    def tangent(self, law: PointLaw) -> PointTangent:
        """Return the derivatives of the point forces by the local unknowns. Collective."""
        by_local_jump = law.evaluate_tangent().by_jump
        traction = law.evaluate_traction()
        return PointTangent(self._finite.tangent(by_local_jump, traction, self._parts.history))

    def undeformed_gap(self, values: PointValues) -> Array:
        """Return the gap of the undeformed Γc, (n_points,) (length)."""
        return self._finite.undeformed_gap

    def rotate(self, vectors: Array, *, inverse: bool = False) -> Array:
        """Return vectors rotated with the surface from the committed state, or back."""
        return self._finite.rotate(vectors, inverse=inverse)

    @property
    def updates_pairs(self) -> bool:
        """Whether pairs are updated, which is always so."""
        return True

    @property
    def can_update_pairs(self) -> bool:
        """Whether pairs are updated at a commit; here they follow every displacement instead."""
        return False

    def find_pairs(self, u: fem.Function | None, depth: Array) -> None:
        """Update the points, and the pairs with them. Collective."""
        self.update()

    def reset_reference(self) -> bool:
        """Measure slip from the present ``u``; return whether the reference changes. Collective."""
        if self._finite.is_at_commit():
            return False
        self._finite.commit()
        return True

    def reference_fields(self) -> dict[str, Array]:
        """Return no fields, because slip is measured from the committed bodies."""
        return {}

    def slip_reference(self, values: PointValues) -> dict[str, Array]:
        """Return V of `finite_sliding` as the reference of slip."""
        return {"jump": self._finite.total_slip}

    def to_history(self, fields: Mapping[str, Array]) -> dict[str, Array]:
        """Return fields of a solution with vectors rotated with the surface."""
        rotated = {n: self.rotate(fields[n]) for n in ("traction", "jump") if n in fields}
        return dict(fields) | rotated

    def resume(self, depth: Array, evaluate: Callable[[], PointValues], *, new_pairs: bool) -> None:
        """Make the present ``u`` the committed displacement of another run. Collective."""
        self._finite.commit()
        super().resume(depth, evaluate, new_pairs=False)

    def commit(self, values: PointValues) -> Array | None:
        """Make an evaluated state the committed one. Collective."""
        super().commit(values)
        self._finite.commit()
        self.committed_jump = np.zeros_like(values.jump)
        return None
