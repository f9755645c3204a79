"""What lies opposite Γc where it is another body."""

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

# Slide relative to the facet size from which on pairs of the undeformed bodies are replaced. In
# partial slip of fine meshes the slide is half of a facet: with other pairs twice the load is not
# twice the displacement (0.3 %), and the energy of a fretting cycle is further from Mindlin's.
MAX_SLIDE = 1.0
# Slide relative to the facet size below which pairs need not be found anew.
NEGLIGIBLE_SLIDE = 1e-2


class BodySmall(ContactKinematics):
    """Another body, paired with the points of the undeformed bodies, or of deformed ones.

    Args:
        pairs: Pairs of the points; by default such as stay.
    """

    is_rigid = False

    def __init__(self, parts: ContactParts, pairs: Pairs | None = None) -> None:
        pairs = pairs or parts.new_pairs()
        assert pairs.distance is not None
        normal = ufl.FacetNormal(parts.quadrature.surface.mesh)
        super().__init__(parts, pairs, parts.new_jump(), Placement(pairs.distance, normal))

    def outputs(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """See `ContactKinematics`."""
        told = super().outputs(arrays) | self._pair_outputs(arrays)
        since = 0.0 if self.pairs.found_jump is None else self.pairs.found_jump
        slide, normal = told["jump"] - since, arrays["normal"]
        slide = slide - np.sum(slide * normal, axis=1)[:, None] * normal
        return told | {"slide": slide}

    def _pair_outputs(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """Which points have an opposite, and how deep they are in it."""
        depth = self.pairs.depth(arrays["normal_displacement"])
        return {"paired": self.pairs.paired.astype(np.float64), "depth": depth}

    def true_placement(self, values: PointValues) -> tuple[Array, Array]:
        """See `ContactKinematics`."""
        return self.pairs.true_gap(values)

    def deviation(self, values: PointValues) -> tuple[Array, Array]:
        """See `ContactKinematics`."""
        gap, normal = self.true_placement(values)
        linear = np.where(self.pairs.paired, self.pairs.linear_gap(values.normal), 0.0)
        return gap - linear, normal

    @property
    def updates_pairs(self) -> bool:
        """See `ContactKinematics`."""
        found_before = self.pairs.found_at is not None
        return self._update == "increment" or (self._update == "auto" and found_before)

    @property
    def can_update_pairs(self) -> bool:
        """See `ContactKinematics`."""
        return self._update != "never"

    @property
    def _update(self) -> str:
        obstacle = self._parts.obstacle
        assert isinstance(obstacle, DeformableBody)
        return obstacle.update_pairs

    def needs_pair_update(self, values: PointValues) -> bool:
        """See `ContactKinematics`."""
        if self.updates_pairs or self._update != "auto":
            return self.updates_pairs
        comm, paired = self._mesh.comm, self.pairs.paired
        if comm.allreduce(int(np.any(self.transmitting_points(values)))):
            return self.largest_slide(values) > MAX_SLIDE
        # Of open points, to whom pairs are nothing yet, only where a body was carried elsewhere;
        # where there are no pairs at all it may come to some.
        if comm.allreduce(int(np.any(paired))):
            return self._farthest(values.slide, paired) > MAX_SLIDE
        return self._farthest(self.pairs.own_displacement(), ~paired) > MAX_SLIDE

    def needs_new_pairs(self, values: PointValues, of: PointValues | None = None) -> bool:
        """See `ContactKinematics`."""
        if not self.can_update_pairs:
            return False
        return self.largest_slide(values, of) > self.slide_limit or self._comes_to_pairs(values)

    def _comes_to_pairs(self, values: PointValues) -> bool:
        """Whether points without a pair that have moved would find one now. Collective."""
        pairs = self.pairs
        if pairs.n_unpaired == 0:
            return False
        way = pairs.moved_since_found()
        way -= np.sum(way * values.normal, axis=1)[:, None] * values.normal
        if not self._farthest(way, ~pairs.paired) > self.slide_limit:
            return False
        gap, _ = self.true_placement(values)
        return bool(self._mesh.comm.allreduce(int(np.any(~np.isnan(gap) & ~pairs.paired))))

    def transmitting_points(self, values: PointValues) -> Mask:
        """See `ContactKinematics`."""
        return self.pairs.paired & (np.abs(values.total_traction).max(axis=1) > 0)

    def largest_slide(self, values: PointValues, of: PointValues | None = None) -> float:
        """See `ContactKinematics`."""
        return self._farthest(values.slide, self.transmitting_points(of or values))

    @property
    def slide_limit(self) -> float:
        """See `ContactKinematics`."""
        return NEGLIGIBLE_SLIDE if self.updates_pairs else MAX_SLIDE

    def _farthest(self, ways: Array, points: Mask) -> float:
        """The largest displacement of some points relative to their facet sizes. Collective."""
        lengths = np.linalg.norm(ways, axis=1) / self._parts.quadrature.facet_sizes
        return global_max(self._mesh.comm, lengths[points])

    def find_pairs(self, u: fem.Function | None, depth: Array) -> None:
        """See `ContactKinematics`."""
        self.update_data()
        self._parts.displacement.follow()
        self.pairs.find(self.data.values["x"], self.data.values["normal"], depth, u)

    def resume(self, depth: Array, evaluate: Callable[[], PointValues], *, anew: bool) -> None:
        """See `ContactKinematics`: the pairs by which points were as deep as that are gone."""
        if anew:
            self.find_pairs(self._parts.displacement.u, depth)
        super().resume(depth, evaluate, anew=anew)
        if anew:  # to the last digit as `commit` has it
            self.committed_jump = self.present_jump()

    def commit(self, values: PointValues) -> Array | None:
        """See `ContactKinematics`."""
        due = self.needs_pair_update(values)
        super().commit(values)
        if not due:
            return None
        # The traction stays with the points of Γc; what they slip over has moved on.
        self.find_pairs(self._parts.displacement.u, values.depth)
        return self.update_committed_jump()


class BodyFinite(BodySmall):
    """Another body, wherever both go: pairs of the present places."""

    is_finite = True
    follows = True

    def __init__(self, parts: ContactParts) -> None:
        obstacle = parts.obstacle
        assert isinstance(obstacle, DeformableBody)
        pairs = FiniteSlidingPairs(parts.name, parts.displacement.u, parts.quadrature, obstacle)
        super().__init__(parts, pairs)
        self._present = pairs
        self.local_jump = pairs.local_jump.function
        self.in_form = self.at_points = FiniteSlidingKinematics(parts.multipliers)

    def update(self) -> None:
        """See `ContactKinematics`."""
        self.update_data()
        data, history = self.data.values, self._parts.history
        self._parts.displacement.follow()
        self._present.follow(data["x"], data["normal"], history, self._parts.multipliers or history)
        self._update_jump()

    def outputs(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """Return outputs as `ContactKinematics` does; the jump is zero at the committed state."""
        pairs, normal = self._present, self._present.local_jump.values("normal")
        told = self._pair_outputs(arrays) | {"normal": normal, "jump": pairs.jump_since()}
        if not self._parts.law.has_friction:
            return told
        told |= self._framed(arrays, normal)
        old = pairs.turned(self._parts.history.values("traction"))
        old -= np.sum(old * normal, axis=1)[:, None] * normal
        return told | {"projection_point": np.zeros_like(normal), "carried_traction": old}

    def tangent(self, law: PointLaw) -> PointTangent:
        """See `ContactKinematics`."""
        by_felt = law.evaluate_tangent().by_jump
        traction = law.evaluate_traction()
        return PointTangent(self._present.tangent(by_felt, traction, self._parts.history))

    def undeformed_gap(self, values: PointValues) -> Array:
        """See `ContactKinematics`."""
        return self._present.undeformed_gap

    def turned(self, vectors: Array, *, back: bool = False) -> Array:
        """See `ContactKinematics`: of the committed bodies."""
        return self._present.turned(vectors, back=back)

    @property
    def updates_pairs(self) -> bool:
        """See `ContactKinematics`: they are, and wherever else the bodies go."""
        return True

    @property
    def can_update_pairs(self) -> bool:
        """See `ContactKinematics`: not at a commit alone, whatever the obstacle says."""
        return False

    def find_pairs(self, u: fem.Function | None, depth: Array) -> None:
        """See `ContactKinematics`: they are found wherever points are updated."""
        self.update()

    def reset_reference(self) -> bool:
        """See `ContactKinematics`."""
        if self._present.is_begun():
            return False
        self._present.commit()
        return True

    def start(self) -> dict[str, Array]:
        """See `ContactKinematics`: all is counted from the committed bodies."""
        return {}

    def projection_points(self, values: PointValues) -> dict[str, Array]:
        """See `ContactKinematics`: the ways in the committed bodies."""
        return {"jump": self._present.way}

    def committed_fields(self, fields: Mapping[str, Array]) -> dict[str, Array]:
        """See `ContactKinematics`: vectors turned with the surface."""
        turned = {n: self.turned(fields[n]) for n in ("traction", "jump") if n in fields}
        return dict(fields) | turned

    def resume(self, depth: Array, evaluate: Callable[[], PointValues], *, anew: bool) -> None:
        """See `ContactKinematics`."""
        self._present.commit()
        super().resume(depth, evaluate, anew=False)

    def commit(self, values: PointValues) -> Array | None:
        """See `ContactKinematics`."""
        super().commit(values)
        self._present.commit()
        self.committed_jump = np.zeros_like(values.jump)
        return None
