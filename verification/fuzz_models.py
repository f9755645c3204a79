"""Random scenes as problems of the second solution; see `reference_solver`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.spatial
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact import compat
from fenics_contact.types import Array
from verification import reference_geometry, reference_laws
from verification import reference_solver as reference
from verification.fuzz_made import Made, geometry, tag_of
from verification.fuzz_scenes import Scene
from verification.reference_geometry import Body, Surface

__all__ = ["body_of", "capsule_at", "contact_of", "model"]

# How far a point at the rim of Γc may slide, by the length of a facet, and stay with its opposite.
_AT_RIM = 0.05


def _scaled(value: float | None, contact: Scene) -> float:
    """Factor of E/h."""
    if value is not None:
        return value
    wanted = contact.get("accuracy")
    return fc.Accuracy.of(wanted).factor if wanted else 10.0


def body_of(
    made: Made,
) -> tuple[Body, Callable[[int], Surface]]:
    """Arrays of a made scene, and its surfaces by their tags. On one rank."""
    scene, d, V = made.scene, made.d, made.V
    tangent = ufl.derivative(made.F, made.u, ufl.TrialFunction(V))
    stiffness = fem.assemble_matrix(fem.form(tangent)).to_scipy().toarray()
    parts = np.zeros(len(V.tabulate_dof_coordinates()), dtype=int)
    parts[V.dofmap.list] = made.box[:, None]
    body = Body(
        cell=scene["cell"],
        degree=scene["degree"],
        x=made.mesh.geometry.x[:, :d].copy(),
        vertices=np.array(compat.geometry_dofmap(made.mesh)),
        nodes=np.array(V.dofmap.list),
        places=V.tabulate_dof_coordinates()[:, :d].copy(),
        parts=parts,
        stiffness=0.5 * (stiffness + stiffness.T),
        bent=compat.geometry_element(made.mesh).degree,
    )
    made.mesh.topology.create_connectivity(d, d - 1)
    to_facet = made.mesh.topology.connectivity(d, d - 1)

    def surface(tag: int) -> Surface:
        facets = made.tags.find(tag)
        cells = made.cell_of(facets)
        local = [
            int(np.flatnonzero(to_facet.links(c) == f)[0])
            for c, f in zip(cells, facets, strict=False)
        ]
        return Surface(body, list(zip(cells.tolist(), local, strict=False)))

    return body, surface


def model(scene: Scene) -> tuple[reference.Problem, Made, Callable[[int, float], reference.Load]]:
    """The reference's problem, and its loads by stage and load parameter. On one rank."""
    made = Made(scene, MPI.COMM_SELF)
    d, outside = made.d, made.outside()
    body, surface = body_of(made)
    contacts = [
        _contact(
            made,
            contact,
            surface(11 + i),
            lambda c=contact["obstacle"]: surface(tag_of(scene, c["body"], c["side"])),
        )
        for i, contact in enumerate(scene["contacts"])
    ]
    fixed = [bc.dof_indices()[0] for bc in made.bcs]

    def load(stage: int, t: float) -> reference.Load:
        made.apply(stage, t)
        values = np.zeros(len(body.stiffness))
        for bc in made.bcs:
            bc.set(values)
        dofs = np.unique(np.concatenate([np.zeros(0, dtype=np.int32), *fixed]))
        shifts, pushes = [], []
        for contact in scene["contacts"]:
            moving = contact["obstacle"].get("moving")
            shift, push = np.zeros(d), np.zeros(d)
            if moving == "displacement":
                shift = made.shift.value.copy()
            elif moving == "carried":
                shift = made.carried.value.copy()
            elif moving == "force":
                for i in range(d):
                    if i in contact["obstacle"]["free"]:
                        push[i] = float(made.push[i].value)
                    else:
                        shift[i] = float(made.pull[i].value)
            shifts.append(shift)
            pushes.append(push)
        return reference.Load(
            fem.assemble_vector(outside).array.copy(), dofs, values[dofs], shifts, pushes
        )

    return reference.Problem(body, contacts), made, load


def _times_as_wide(here: Surface, there: Surface) -> float:
    """How many opposite facets are as wide as one of Γc where they are narrowest; the median.

    Each beside the one whose middle is closest and that looks its way or against it.
    """
    arms = [s.corners() - s.corners().mean(axis=1, keepdims=True) for s in (here, there)]
    apart = here.corners().mean(axis=1)[:, None] - there.corners().mean(axis=1)
    closest = np.linalg.norm(apart, axis=2).argmin(axis=1)
    found = []
    for own, other in zip(arms[0], arms[1][closest], strict=True):
        plane, opposite = (np.linalg.svd(a)[2] for a in (own, other))
        if (plane[2] @ opposite[2]) ** 2 <= 0.5:
            continue
        # Of x in the plane of Γc |own x| / |other x|, the largest.
        right = np.linalg.qr(other @ plane[:2].T)[1]
        found.append(np.linalg.norm(own @ plane[:2].T @ np.linalg.inv(right), 2))
    return float(np.median(found)) if found else 1.0


def _most_under_one(here: Surface, there: Surface) -> float:
    """How many opposite facets are as long as one of Γc where they are most.

    Under a facet are that with the closest middle and all to which it is the closest and that are
    farther by half of its length at most.
    """
    ours, theirs = here.lengths(), there.lengths()
    apart = np.linalg.norm(
        here.corners().mean(axis=1)[:, None] - there.corners().mean(axis=1), axis=2
    )
    most = 0.0
    for i, (own, row) in enumerate(zip(ours, apart, strict=True)):
        under = (apart.argmin(axis=0) == i) & (row <= row.min() + own / 2)
        under[row.argmin()] = True
        lengths = np.sort(theirs[under])
        most = max(most, own / lengths[(len(lengths) - 1) // 2])
    return float(most)


def contact_of(
    made: Made,
    contact: Scene,
    here: Surface,
    kind_of: Any = reference.ContactModel,
    there: Surface | None = None,
) -> tuple[Any, tuple[Array, Array]]:
    """Points, stiffness and law of a contact without its obstacle; facet and place of points."""
    scene, law = made.scene, contact["law"]
    d, degree = made.d, scene["degree"]
    rigid = contact["obstacle"]["kind"] != "body"
    wanted = contact.get("accuracy")
    augmented = contact.get("enforcement") == "augmented"
    physical = law["kind"] in ("foundation", "tension") or any(
        (law.get(k) or [""])[0] == "springs" for k in ("k_n", "k_t")
    )
    if wanted and "enforcement" not in contact and not physical:
        augmented = fc.Accuracy.of(wanted).enforcement == "augmented"
    scheme, rule = contact.get("scheme"), contact.get("quadrature")
    per_node = 1
    if rule is None and rigid:  # 4 along a round obstacle, by its radius
        around = made.obstacle(contact).smallest_radius
        per_node = int(np.ceil(4 * float(np.median(here.lengths())) / around - 1e-9))
    if scheme is None and rule is None and augmented and rigid and degree == 1 and per_node <= 1:
        scheme = "vertex" if scene["cell"] != "hexahedron" else None
    if rule is None:
        rule = max(2 * degree, min(2 * (per_node * degree - 1), {2: 78, 3: 6}[d]))
        if there is not None:  # p + 1 points for every facet that is opposite, but for many
            ratio = float(np.median(here.lengths()) / np.median(there.lengths()))
            graded = _most_under_one(here, there)
            ratio = graded if graded > 1.5 * ratio else ratio
            finite = kind_of is not reference.ContactModel
            across = _times_as_wide(here, there) if d == 3 and finite else 0.0
            times = round(across if across > 2 * ratio else ratio)  # long and narrow ones across
            times = times if finite or times >= 6 else 1
            rule = max(rule, min(2 * ((degree + 1) * times - 1), {2: 78, 3: 6}[d]))
    facet, xi, weights = here.rule(rule, scheme or "default")
    weights = weights * scene.get("thickness", 1.0)
    x, _ = here.place(facet, xi)
    owner = made.box[here.cells]
    stress, modulus = made.moduli[owner[0]], made.moduli[owner]
    if there is not None:  # between two bodies the softer one says what is stiff
        modulus = np.minimum(modulus, made.moduli[made.box[there.cells]].max())

    def stiffness(given: Any) -> Array:
        if not given:
            return np.zeros(len(x))
        kind, value = given
        if kind == "scaled":
            smooth = reference_geometry.smooth_modulus(here, modulus, facet, xi)
            return _scaled(value, contact) * smooth
        if kind == "number":
            return np.full(len(x), value * stress / made.length)
        vertices = {}
        for f, own in enumerate(here.corner_vertices):
            for q, k in zip(np.flatnonzero(facet == f), own, strict=False):
                vertices[k] = vertices.get(k, 0.0) + weights[q]
        area = [vertices[k] for own in here.corner_vertices for k in own]
        return value * stress * made.length ** (d - 2) / np.array(area)

    kind = {"prescribed": "tresca", "tension": "foundation", "polygon": "coulomb"}.get(
        law["kind"], law["kind"]
    )
    the_law = reference_laws.Law(
        kind="coulomb" if kind == "ellipse" else kind,
        friction=law.get("friction", 0.0),
        pressure=law.get("pressure", 0.0) * stress,
        transverse=law.get("transverse"),
        modes=law.get("modes"),
        direction=law.get("direction"),
        tension=law["kind"] == "tension",
        unilateral=law["kind"] != "prescribed",
    )
    free = (
        tuple(contact["obstacle"].get("free", ()))
        if contact["obstacle"].get("moving") == "force"
        else ()
    )
    made_model = kind_of(
        x=x,
        place=None,
        interpolation=here.interpolation(facet, xi),
        weights=weights,
        here=here,
        facet=facet,
        k_n=stiffness(law.get("k_n")),
        k_t=stiffness(law.get("k_t")),
        law=the_law,
        paired=np.ones(len(x), dtype=bool),
        free=free,
        project=_projection(here, facet, xi, weights, max(1, degree - 1)) if augmented else None,
    )
    if contact["obstacle"]["kind"] == "rod":
        low, high = geometry(scene, contact)["ends"]
        made_model.spine = low + np.linspace(0, 1, 21)[:, None] * (high - low)
    return made_model, (facet, xi)


def capsule_at(x: Array, where: dict[str, Any]) -> tuple[Array, Array]:
    """Distance of places from a capsule, (n,), and minus its gradient, (n, d)."""
    low, high = where["ends"]
    way = high - low
    share = (x - low) @ way / max(way @ way, np.finfo(float).tiny)
    arm = x - low - np.clip(share.real, 0.0, 1.0)[:, None] * way
    arm = arm * where.get("flat", 1.0)
    far = np.sqrt(np.sum(arm * arm, axis=1))
    return far - where["radius"], -arm / far[:, None]


def _contact(made: Made, contact: Scene, here: Surface, opposite: Any) -> Any:
    """A contact as the reference has it."""
    there = opposite() if contact["obstacle"]["kind"] == "body" else None
    made_model, (facet, xi) = contact_of(made, contact, here, there=there)
    scene, given, x = made.scene, contact.get("gap"), made_model.x
    if there is None:
        kind, where = contact["obstacle"]["kind"], geometry(scene, contact)
        place = _placement(kind, where, x)
        made_model.radius = float(where.get("radius", 0.0))
        if given is None and kind != "obstacle":
            made_model.near = lambda x, shift: _placement(kind, where, x)(shift)
        if given is not None:
            bare = place

            def place(shift: Array) -> tuple[Array, Array]:
                normal = bare(shift)[1]
                return given * made.length + normal @ shift, normal

        made_model.place = place
        return made_model
    normal = here.normal(facet, xi)
    interpolation = made_model.interpolation

    def repair(u: Array | None) -> None:
        matrix, gap, paired = reference_geometry.pair(here, there, (facet, xi), u=u)
        made_model.paired = paired
        made_model.interpolation = np.where(paired[:, None], interpolation - matrix, 0.0)
        gap = gap if given is None else np.full(len(x), given * made.length)
        made_model.place = lambda shift: (gap + normal @ shift, normal + 0 * shift)

    repair(None)
    gap = made_model.place(np.zeros(made.d))[0]
    if given is None and not made_model.law.tension:
        thickness = scene.get("thickness", 1.0)
        made_model.back = lambda u: reference_geometry.penetration(there, here, u, thickness)
    if contact["obstacle"]["update"] == "increment":
        made_model.repair = repair
    if given is None:

        def anew(u: Array) -> tuple[Array, Array, Array]:
            matrix, where, met = reference_geometry.pair(here, there, (facet, xi), u=u)
            # At the rim a point loses its opposite by any strain.
            slid = np.linalg.norm(made_model.jump(u), axis=1) > _AT_RIM * here.lengths()[facet]
            met, lost = met | ~slid, ~met & ~slid
            rows = np.where(met[:, None], interpolation - matrix, 0.0)
            rows[lost] = made_model.interpolation[lost]
            return rows, np.where(lost, gap, where), np.where(lost, made_model.paired, met)

        made_model.anew = anew
    return made_model


def _placement(kind: str, where: dict[str, Any], x: Array) -> Any:
    """Gap and normal at the points, as functions of the obstacle's shift."""
    if kind == "halfspace":
        normal = np.asarray(where["normal"])
        return lambda s: ((x - where["point"] - s) @ normal, np.tile(-normal, (len(x), 1)) + 0 * s)
    if kind == "obstacle":
        normal = -np.asarray(where["normal"])
        gap = where["gap"] + where["curve"] * (x[:, 0] - where["middle"]) ** 2
        return lambda s: (gap + s @ normal, np.tile(normal, (len(x), 1)) + 0 * s)
    if kind == "rod":
        return lambda s: capsule_at(x - s, where)
    sign = -1.0 if kind.endswith("inside") else 1.0
    flat = np.ones(x.shape[1])
    if kind.startswith("cylinder") and len(flat) == 3:
        flat[1] = 0.0

    def place(s: Array) -> tuple[Array, Array]:
        arm = (x - where["center"] - s) * flat
        distance = np.sqrt(np.sum(arm * arm, axis=1))
        return sign * (distance - where["radius"]), -sign * arm / distance[:, None]

    return place


def _projection(here: Surface, facet: Array, xi: Array, weights: Array, degree: int) -> Array:
    """L2 projection at the points onto continuous functions of a degree on Γc."""
    import basix

    kind = "interval" if here.d == 2 else "triangle" if here.simplex else "quadrilateral"
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType[kind], degree, basix.LagrangeVariant.gll_warped
    )
    every = np.repeat(np.arange(len(here.facets)), element.dim)
    nodes, _ = here.place(every, np.tile(element.points, (len(here.facets), 1)))
    # Nodes at one place are one; facets of Γc that touch belong to one body here.
    size = np.ptp(nodes, axis=0).max()
    tree = scipy.spatial.cKDTree(nodes)
    number = np.array([min(tree.query_ball_point(p, 1e-8 * size)) for p in nodes])
    _, number = np.unique(number, return_inverse=True)
    number = number.reshape(len(here.facets), element.dim)
    table = element.tabulate(0, xi)[0, :, :, 0]
    basis = np.zeros((len(xi), number.max() + 1))
    for q, f in enumerate(facet):
        basis[q, number[f]] += table[q]
    gram = basis.T @ (weights[:, None] * basis)
    return basis @ np.linalg.pinv(gram, rcond=1e-11, hermitian=True) @ (basis.T * weights)
