"""Problems of the independent solver (`reference_solver`) for random scenes."""

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
from verification.fuzz_scenes import Scene
from verification.fuzz_setup import SceneSetup, obstacle_geometry, tag_of
from verification.reference_geometry import Body, Surface

__all__ = ["capsule_gap_at", "make_body", "make_contact", "make_problem"]

# Slip up to which points at the edge keep their opposite points, relative to the facet length.
_EDGE_SLIP_RATIO = 0.05


def _relative_factor(value: float | None, contact: Scene) -> float:
    """Return the factor of E/h in a relative contact stiffness."""
    if value is not None:
        return value
    accuracy = contact.get("accuracy")
    return fc.Accuracy.of(accuracy).factor if accuracy else 10.0


def make_body(setup: SceneSetup) -> tuple[Body, Callable[[int], Surface]]:
    """Return the bodies of a scene as arrays, and a function of its surfaces. On one rank."""
    scene, d, V = setup.scene, setup.d, setup.V
    tangent = ufl.derivative(setup.F, setup.u, ufl.TrialFunction(V))
    stiffness = fem.assemble_matrix(fem.form(tangent)).to_scipy().toarray()
    body_numbers = np.zeros(len(V.tabulate_dof_coordinates()), dtype=int)
    body_numbers[V.dofmap.list] = setup.cell_body[:, None]
    body = Body(
        cell=scene["cell"],
        degree=scene["degree"],
        x=setup.mesh.geometry.x[:, :d].copy(),
        vertices=np.array(compat.geometry_dofmap(setup.mesh)),
        nodes=np.array(V.dofmap.list),
        nodes_x=V.tabulate_dof_coordinates()[:, :d].copy(),
        body_numbers=body_numbers,
        stiffness=0.5 * (stiffness + stiffness.T),
        geometry_degree=compat.geometry_element(setup.mesh).degree,
    )
    setup.mesh.topology.create_connectivity(d, d - 1)
    to_facet = setup.mesh.topology.connectivity(d, d - 1)

    def surface(tag: int) -> Surface:
        facets = setup.tags.find(tag)
        cells = setup.cells_of(facets)
        local = [
            int(np.flatnonzero(to_facet.links(c) == f)[0])
            for c, f in zip(cells, facets, strict=False)
        ]
        return Surface(body, list(zip(cells.tolist(), local, strict=False)))

    return body, surface


def make_problem(
    scene: Scene,
) -> tuple[reference.Problem, SceneSetup, Callable[[int, float], reference.Load]]:
    """Return the independent problem, the setup, and a function for the loads. On one rank."""
    setup = SceneSetup(scene, MPI.COMM_SELF)
    outside = setup.external_force()
    body, surface = make_body(setup)
    contacts = [
        _make_contact(
            setup,
            contact,
            surface(11 + i),
            lambda c=contact["obstacle"]: surface(tag_of(scene, c["body"], c["side"])),
        )
        for i, contact in enumerate(scene["contacts"])
    ]
    fixed = [bc.dof_indices()[0] for bc in setup.bcs]

    def load(stage: int, t: float) -> reference.Load:
        setup.apply(stage, t)
        values = np.zeros(len(body.stiffness))
        for bc in setup.bcs:
            bc.set(values)
        dofs = np.unique(np.concatenate([np.zeros(0, dtype=np.int32), *fixed]))
        shifts, pushes = setup.obstacle_loads()
        return reference.Load(
            fem.assemble_vector(outside).array.copy(), dofs, values[dofs], shifts, pushes
        )

    return reference.Problem(body, contacts), setup, load


def _width_ratio(slave: Surface, master: Surface) -> float:
    """Return the median of the width ratios of facets of Γc and their closest opposing facets."""
    arms = [s.corners() - s.corners().mean(axis=1, keepdims=True) for s in (slave, master)]
    offset = slave.corners().mean(axis=1)[:, None] - master.corners().mean(axis=1)
    closest = np.linalg.norm(offset, axis=2).argmin(axis=1)
    found = []
    for own, other in zip(arms[0], arms[1][closest], strict=True):
        plane, opposite = (np.linalg.svd(a)[2] for a in (own, other))
        if (plane[2] @ opposite[2]) ** 2 <= 0.5:
            continue
        # The largest |own x| / |other x| of all x in the plane of Γc.
        right = np.linalg.qr(other @ plane[:2].T)[1]
        found.append(np.linalg.norm(own @ plane[:2].T @ np.linalg.inv(right), 2))
    return float(np.median(found)) if found else 1.0


def _largest_length_ratio(slave: Surface, master: Surface) -> float:
    """Return the largest ratio of a facet length of Γc and the median of its opposite facets.

    These are the closest facet, and those whose closest facet it is, farther away by at most half
    of its length.
    """
    ours, theirs = slave.lengths(), master.lengths()
    offset = np.linalg.norm(
        slave.corners().mean(axis=1)[:, None] - master.corners().mean(axis=1), axis=2
    )
    most = 0.0
    for i, (own, row) in enumerate(zip(ours, offset, strict=True)):
        under = (offset.argmin(axis=0) == i) & (row <= row.min() + own / 2)
        under[row.argmin()] = True
        lengths = np.sort(theirs[under])
        most = max(most, own / lengths[(len(lengths) - 1) // 2])
    return float(most)


def make_contact(
    setup: SceneSetup,
    contact: Scene,
    slave: Surface,
    model_class: Any = reference.ContactModel,
    master: Surface | None = None,
) -> tuple[Any, tuple[Array, Array]]:
    """Return a contact without gap function, and facet and reference coordinates of its points."""
    scene, law = setup.scene, contact["law"]
    d, degree = setup.d, scene["degree"]
    rigid = contact["obstacle"]["kind"] != "body"
    accuracy = contact.get("accuracy")
    augmented = contact.get("enforcement") == "augmented"
    physical = law["kind"] in ("foundation", "tension") or any(
        (law.get(k) or [""])[0] == "springs" for k in ("k_n", "k_t")
    )
    if accuracy and "enforcement" not in contact and not physical:
        augmented = fc.Accuracy.of(accuracy).enforcement == "augmented"
    scheme, rule = contact.get("scheme"), contact.get("quadrature")
    per_node = 1
    if rule is None and rigid:  # 4 points per radius of the obstacle
        around = setup.obstacle(contact).smallest_radius
        per_node = int(np.ceil(4 * float(np.median(slave.lengths())) / around - 1e-9))
    if scheme is None and rule is None and augmented and rigid and degree == 1 and per_node <= 1:
        scheme = "vertex" if scene["cell"] != "hexahedron" else None
    if rule is None:
        rule = max(2 * degree, min(2 * (per_node * degree - 1), {2: 78, 3: 6}[d]))
        if master is not None:  # p + 1 points per opposing facet
            ratio = float(np.median(slave.lengths()) / np.median(master.lengths()))
            graded = _largest_length_ratio(slave, master)
            ratio = graded if graded > 1.5 * ratio else ratio
            finite = model_class is not reference.ContactModel
            across = _width_ratio(slave, master) if d == 3 and finite else 0.0
            times = round(across if across > 2 * ratio else ratio)  # across long and narrow facets
            times = times if finite or times >= 6 else 1
            rule = max(rule, min(2 * ((degree + 1) * times - 1), {2: 78, 3: 6}[d]))
    facet, xi, weights = slave.quadrature(rule, scheme or "default")
    weights = weights * scene.get("thickness", 1.0)
    x, _ = slave.position(facet, xi)
    owner = setup.cell_body[slave.cells]
    stress, modulus = setup.moduli[owner[0]], setup.moduli[owner]
    if master is not None:  # the softer body determines the stiffness
        modulus = np.minimum(modulus, setup.moduli[setup.cell_body[master.cells]].max())

    def stiffness(given: Any) -> Array:
        if not given:
            return np.zeros(len(x))
        kind, value = given
        if kind == "scaled":
            smooth = reference_geometry.smooth_modulus(slave, modulus, facet, xi)
            return _relative_factor(value, contact) * smooth
        if kind == "number":
            return np.full(len(x), value * stress / setup.length)
        vertices = {}
        for f, own in enumerate(slave.corner_vertices):
            for q, k in zip(np.flatnonzero(facet == f), own, strict=False):
                vertices[k] = vertices.get(k, 0.0) + weights[q]
        area = [vertices[k] for own in slave.corner_vertices for k in own]
        return value * stress * setup.length ** (d - 2) / np.array(area)

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
    model = model_class(
        x=x,
        gap_function=None,
        interpolation=slave.interpolation(facet, xi),
        weights=weights,
        slave=slave,
        facet=facet,
        k_n=stiffness(law.get("k_n")),
        k_t=stiffness(law.get("k_t")),
        law=the_law,
        paired=np.ones(len(x), dtype=bool),
        free_components=free,
        projection=_l2_projection(slave, facet, xi, weights, max(1, degree - 1))
        if augmented
        else None,
    )
    if contact["obstacle"]["kind"] == "rod":
        low, high = obstacle_geometry(scene, contact)["ends"]
        model.centreline = low + np.linspace(0, 1, 21)[:, None] * (high - low)
    return model, (facet, xi)


def capsule_gap_at(x: Array, where: dict[str, Any]) -> tuple[Array, Array]:
    """Return the distances of points from a capsule, (n,), and minus their gradients, (n, d)."""
    low, high = where["ends"]
    direction = high - low
    fraction = (x - low) @ direction / max(direction @ direction, np.finfo(float).tiny)
    arm = x - low - np.clip(fraction.real, 0.0, 1.0)[:, None] * direction
    arm = arm * where.get("flat", 1.0)
    far = np.sqrt(np.sum(arm * arm, axis=1))
    return far - where["radius"], -arm / far[:, None]


def _make_contact(setup: SceneSetup, contact: Scene, slave: Surface, opposite: Any) -> Any:
    """Return a contact of the independent solver with its gap function and pairs."""
    master = opposite() if contact["obstacle"]["kind"] == "body" else None
    model, (facet, xi) = make_contact(setup, contact, slave, master=master)
    scene, given, x = setup.scene, contact.get("gap"), model.x
    if master is None:
        kind, where = contact["obstacle"]["kind"], obstacle_geometry(scene, contact)
        gap_at = _gap_function(kind, where, x)
        model.radius = float(where.get("radius", 0.0))
        if given is None and kind != "obstacle":
            model.deformed_gap = lambda x, shift: _gap_function(kind, where, x)(shift)
        if given is not None:
            unprescribed_gap = gap_at

            def gap_at(shift: Array) -> tuple[Array, Array]:
                normal = unprescribed_gap(shift)[1]
                return given * setup.length + normal @ shift, normal

        model.gap_function = gap_at
        return model
    normal = slave.normal(facet, xi)
    interpolation = model.interpolation

    def update_pairs(u: Array | None) -> None:
        matrix, gap, paired = reference_geometry.find_pairs(slave, master, (facet, xi), u=u)
        model.paired = paired
        model.interpolation = np.where(paired[:, None], interpolation - matrix, 0.0)
        gap = gap if given is None else np.full(len(x), given * setup.length)
        model.gap_function = lambda shift: (gap + normal @ shift, normal + 0 * shift)

    update_pairs(None)
    gap = model.gap_function(np.zeros(setup.d))[0]
    if given is None and not model.law.tension:
        thickness = scene.get("thickness", 1.0)
        model.opposite_penetration = lambda u: reference_geometry.integrate_penetration(
            master, slave, u, thickness
        )
    if contact["obstacle"]["update_pairs"] != "never":
        model.update_pairs = update_pairs
    if given is None:

        def find_current_pairs(u: Array) -> tuple[Array, Array, Array]:
            matrix, current_gap, is_paired = reference_geometry.find_pairs(
                slave, master, (facet, xi), u=u
            )
            # At the edge any strain may separate a point from its opposite point.
            slid = np.linalg.norm(model.jump(u), axis=1) > _EDGE_SLIP_RATIO * slave.lengths()[facet]
            is_paired, keeps_pair = is_paired | ~slid, ~is_paired & ~slid
            rows = np.where(is_paired[:, None], interpolation - matrix, 0.0)
            rows[keeps_pair] = model.interpolation[keeps_pair]
            return (
                rows,
                np.where(keeps_pair, gap, current_gap),
                np.where(keeps_pair, model.paired, is_paired),
            )

        model.current_pairs = find_current_pairs
    return model


def _gap_function(kind: str, where: dict[str, Any], x: Array) -> Any:
    """Return the function from an obstacle's displacement to gap and normal at the points."""
    if kind == "halfspace":
        normal = np.asarray(where["normal"])
        return lambda s: ((x - where["point"] - s) @ normal, np.tile(-normal, (len(x), 1)) + 0 * s)
    if kind == "obstacle":
        normal = -np.asarray(where["normal"])
        gap = where["gap"] + where["curve"] * (x[:, 0] - where["middle"]) ** 2
        return lambda s: (gap + s @ normal, np.tile(normal, (len(x), 1)) + 0 * s)
    if kind == "rod":
        return lambda s: capsule_gap_at(x - s, where)
    sign = -1.0 if kind.endswith("inside") else 1.0
    flat = np.ones(x.shape[1])
    if kind.startswith("cylinder") and len(flat) == 3:
        flat[1] = 0.0

    def gap_at(s: Array) -> tuple[Array, Array]:
        arm = (x - where["center"] - s) * flat
        distance = np.sqrt(np.sum(arm * arm, axis=1))
        return sign * (distance - where["radius"]), -sign * arm / distance[:, None]

    return gap_at


def _l2_projection(slave: Surface, facet: Array, xi: Array, weights: Array, degree: int) -> Array:
    """Return the L2 projection onto continuous functions on Γc as a matrix of point values."""
    import basix

    kind = "interval" if slave.d == 2 else "triangle" if slave.simplex else "quadrilateral"
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType[kind], degree, basix.LagrangeVariant.gll_warped
    )
    every = np.repeat(np.arange(len(slave.facets)), element.dim)
    nodes, _ = slave.position(every, np.tile(element.points, (len(slave.facets), 1)))
    # Nodes with equal coordinates are identified.
    size = np.ptp(nodes, axis=0).max()
    tree = scipy.spatial.cKDTree(nodes)
    number = np.array([min(tree.query_ball_point(p, 1e-8 * size)) for p in nodes])
    _, number = np.unique(number, return_inverse=True)
    number = number.reshape(len(slave.facets), element.dim)
    table = element.tabulate(0, xi)[0, :, :, 0]
    basis = np.zeros((len(xi), number.max() + 1))
    for q, f in enumerate(facet):
        basis[q, number[f]] += table[q]
    gram = basis.T @ (weights[:, None] * basis)
    return basis @ np.linalg.pinv(gram, rcond=1e-11, hermitian=True) @ (basis.T * weights)
