"""Fingerprint of a problem, in words and numbers, by which it refuses states of another one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.contact.contact import Contact
from fenics_contact.histories.checkpoint_file import StoredCheckpoint
from fenics_contact.histories.point_matching import node_coordinates, split_unknowns
from fenics_contact.histories.restart import N_ROWS
from fenics_contact.histories.signature import signature_of_law, signature_of_obstacle
from fenics_contact.obstacles.base import SampledObstacle
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.parallel import global_max, global_sum
from fenics_contact.problem import ContactProblem
from fenics_contact.types import Array

__all__ = [
    "compare_data",
    "compare_model",
    "describe_data",
    "describe_model",
    "point_data",
    "probe",
]

# Largest relative difference of equal data, and round-off relative to the mesh size (lengths are
# differences of coordinates) or to the largest displacement.
_EQUAL_RATIO, _ROUND_OFF_RATIO = 1e-9, 1e-11
_LENGTHS = ("initial_gap", "shift", "about")


def compare_model(
    stored: StoredCheckpoint, problem: ContactProblem, fields: Sequence[fem.Function]
) -> list[str]:
    """Return why a checkpoint cannot be of this problem, empty if it can. Collective."""
    words = _compare_words(stored.scene["fixed"], describe_model(problem, fields))
    return words or _compare_shapes(stored, problem, fields)


def compare_data(
    stored: StoredCheckpoint,
    problem: ContactProblem,
    committed: Array,
    given: Sequence[dict[str, Array]],
) -> list[str]:
    """Describe differences between the data of a problem and a checkpoint. Collective.

    The problem is in the state of the checkpoint, with the rows ``committed``; ``given`` are the
    stored data at the points of every contact.
    """
    differences = _compare_words(stored.scene["data"], describe_data(problem))
    differences += _compare_probes(problem, stored.arrays)
    differences += _compare_conditions(problem, committed)
    for contact, theirs in zip(problem.contacts, given, strict=True):
        differences += _compare_points(contact, theirs, problem.full.scales.mesh_size)
    return differences


def describe_model(problem: ContactProblem, fields: Sequence[fem.Function]) -> dict[str, str]:
    """Describe mesh, elements and contacts, without which no state fits. Collective."""
    space = problem.displacement.u.function_space
    mesh, words = space.mesh, {}
    n_cells = mesh.topology.index_map(mesh.topology.dim).size_global
    degree = compat.geometry_element(mesh).degree
    words["mesh"] = f"{n_cells} {mesh.topology.cell_name()}s of degree {degree}"
    words["dimension"] = str(mesh.geometry.dim)
    words["element"] = str(space.element.basix_element.family).split(".")[-1]
    words["element"] += f" of degree {space.element.basix_element.degree}"
    words["nodes"] = str(space.dofmap.index_map.size_global)
    for part in split_unknowns(problem)[1:]:
        nodes = part.space.dofmap.index_map.size_global
        words[part.name] = f"{part.space.ufl_element()} at {nodes} nodes"
    words["contacts"] = ", ".join(c.name for c in problem.contacts)
    for c in problem.contacts:
        n_points = int(global_sum(mesh.comm, c.quadrature.n_points))
        words[f"quadrature of {c.name}"] = f"{n_points} points"
        words[f"history of {c.name}"] = ", ".join(c.history.names)
        words[f"kinematics of {c.name}"] = c.kinematics
        free = ["xyz"[i] for i in c.free_motion] + ["angle"] * (c.free_angle is not None)
        words[f"free motion of {c.name}"] = ", ".join(free)
    for number, field in enumerate(fields):
        element = field.function_space.ufl_element()
        size = field.function_space.dofmap.index_map.size_global
        words[f"fields[{number}]"] = (
            f"{field.name}: {type(element).__name__} of shape {element.reference_value_shape} at "
            f"{size} points"
        )
    return words


def describe_data(problem: ContactProblem) -> dict[str, str]:
    """Describe law, obstacle, enforcement and quadrature rule of every contact."""
    words = {}
    for c in problem.contacts:
        parameters = c.law.parameters()
        switches = {n: v for n, v in vars(c.law).items() if n not in parameters}
        words[f"law of {c.name}"] = _format_call(c.law, switches)
        gdim, multipliers = problem.u.function_space.mesh.geometry.dim, c.multipliers is not None
        code = signature_of_law(c.law, gdim, multipliers=multipliers)
        words[f"code (UFL) of the law of {c.name}"] = code
        switches = {n: v for n, v in vars(c.obstacle).items() if isinstance(v, bool | str)}
        if isinstance(c.obstacle, DeformableBody):
            switches["search_distance"] = c.obstacle.search_distance
        if isinstance(c.obstacle, SampledObstacle):
            switches["data"] = c.obstacle.fingerprint
        words[f"obstacle of {c.name}"] = _format_call(c.obstacle, switches)
        if (
            c.contact_kinematics.is_finite
            and c.contact_kinematics.is_rigid
            and not isinstance(c.obstacle, SampledObstacle)
        ):
            # With small displacements only its values on Γc matter; they are compared as numbers.
            code = signature_of_obstacle(c.obstacle, gdim)
            words[f"code (UFL) of the obstacle of {c.name}"] = code
        words[f"enforcement of {c.name}"] = (
            "penalty" if c.multipliers is None else f"augmented to {c.tolerance:g}"
        )
        rule = c.surface.quadrature_scheme or "default"
        words[f"rule of {c.name}"] = f"{rule}, degree {c.quadrature.degree}"
    return words


def _format_call(item: Any, switches: dict[str, Any]) -> str:
    """Format class name and switches as a constructor call."""
    given = [f"{n}={v!r}" for n, v in switches.items() if isinstance(v, bool | int | float | str)]
    return f"{type(item).__name__}({', '.join(given)})"


def probe(problem: ContactProblem) -> dict[str, Array]:
    """Return products of smooth fields with stiffness and loads. Collective.

    Returns:
        "stiffness": v·Kw of every pair of fields, and the reference magnitudes |v| |Kw|; "loads":
        v·f and the forces on free obstacles, and their reference magnitudes.
    """
    space = problem.u.function_space
    comm, d = space.mesh.comm, space.mesh.geometry.dim
    parts = [
        (p.dofs, p.space.dofmap.bs, node_coordinates(p.space)) for p in split_unknowns(problem)
    ]
    low = parts[0][2].min(axis=0, initial=np.inf)
    comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
    n_owned = problem.full.unknowns.n_dofs
    fields, images = [], []
    field, image = fem.Function(space), fem.Function(space)
    with problem.full.bulk.present_stiffness() as stiffness:
        for k in range(3):
            for dofs, bs, x in parts:
                phases = 1.0 + k + 2.0 * np.arange(bs)
                waves = np.cos(np.add.outer(np.arange(d), np.arange(bs)) * (1 + k)) * (2 + k)
                values = np.sin((x - low) / problem.full.scales.mesh_size @ waves + phases)
                field.x.array[dofs] = values.ravel()
            field.x.scatter_forward()
            stiffness.mult(field.x.petsc_vec, image.x.petsc_vec)
            fields.append(field.x.array[:n_owned].copy())
            images.append(image.x.array[:n_owned].copy())
    load = problem.full.present_load()
    v, w, f = np.array(fields), np.array(images), load[:n_owned]
    products = v @ w.T
    sums = global_sum(comm, np.concatenate([products.ravel(), v @ f]))
    squares = global_sum(
        comm, np.concatenate([np.sum(v**2, axis=1), np.sum(w**2, axis=1), [f @ f]])
    )
    nv, nw, nf = np.split(np.sqrt(squares), [3, 6])
    motions = problem.full.unknowns.motions(load)
    return {
        "stiffness": np.stack([sums[:9], np.outer(nv, nw).ravel()]),
        "loads": np.stack(
            [np.concatenate([sums[9:], motions]), np.concatenate([nv * nf, np.abs(motions)])]
        ),
    }


def _compare_words(theirs: dict[str, str], ours: dict[str, str]) -> list[str]:
    return [
        f"{name} is {theirs.get(name, 'missing')} in the file and {ours.get(name, 'missing')} here"
        for name in dict.fromkeys([*theirs, *ours])
        if theirs.get(name) != ours.get(name)
    ]


def _compare_shapes(
    stored: StoredCheckpoint, problem: ContactProblem, fields: Sequence[fem.Function]
) -> list[str]:
    """Describe missing or unknown arrays, and those of another shape, except numbers of points."""
    gdim, n_motions = len(problem.displacement.u), problem.full.unknowns.n_motions
    expected: dict[str, tuple[int | None, ...]] = {
        "numbers": (None,),
        "state": (2 + len(problem.contacts),),
        "motions": (N_ROWS, n_motions),
        "stiffness": (2, 9),
        "loads": (2, 3 + n_motions),
    }
    for part in split_unknowns(problem):
        expected[part.name] = (None, 2 * gdim + N_ROWS * part.space.dofmap.bs)
    for c in problem.contacts:
        sizes = [sum(max(width, 1) for _, width in t) for t in stored.scene["contacts"][c.name]]
        n_history = c.history.rows().shape[1]
        expected[f"contact {c.name}"] = (None, 2 * gdim + n_history + sizes[0])
        expected[f"values {c.name}"] = (None, 2 * gdim + sizes[1])
    for number, field in enumerate(fields):
        bs = field.function_space.dofmap.index_map_bs
        expected[f"field {number}"] = (None, 2 * gdim + bs)
    theirs, names = stored.arrays, expected.keys() | stored.arrays.keys()
    return [
        f"array {name!r} has shape {theirs[name].shape if name in theirs else None} in the file "
        f"and {expected.get(name)} here"
        for name in sorted(names)
        if name not in theirs
        or name not in expected
        or theirs[name].ndim != len(expected[name])
        or any(n not in (None, m) for n, m in zip(expected[name], theirs[name].shape, strict=True))
    ]


def _compare_probes(problem: ContactProblem, theirs: dict[str, Array]) -> list[str]:
    """Compare stiffness and loads of the bulk."""
    ours, differences = probe(problem), []
    round_off = problem.full.bulk.scale * problem.full.scales.mesh_size * np.finfo(float).eps
    for name, words in (
        ("stiffness", "stiffness of the bulk, by smooth fields v·Kw,"),
        ("loads", "loads of the bulk and on free obstacles, by smooth fields v·f,"),
    ):
        (a, scale), (b, other) = theirs[name], ours[name]
        allowed = _EQUAL_RATIO * np.maximum(scale, other) + (round_off if name == "loads" else 0.0)
        excess = np.abs(a - b) - allowed
        if not np.all(excess <= 0):
            i = int(np.argmax(excess))
            differences.append(f"{words} is {a[i]:.10g} in the file and {b[i]:.10g} here")
    return differences


def _compare_conditions(problem: ContactProblem, committed: Array) -> list[str]:
    """Compare the components with Dirichlet conditions, and their values, in a state."""
    comm, stored, mask = problem.u.function_space.mesh.comm, committed[0], committed[-1] > 0
    n_different = int(global_sum(comm, np.count_nonzero(mask != problem.full.constrained)))
    if n_different:
        theirs, ours = global_sum(comm, [mask.sum(), problem.full.constrained.sum()])
        return [
            f"Dirichlet conditions: {theirs:.0f} components of nodes are prescribed in the file "
            f"and {ours:.0f} here, and {n_different} of them are not the same"
        ]
    present = problem.full.prescribed_values()
    # A direct solver leaves round-off in prescribed values, too.
    floor = _ROUND_OFF_RATIO * global_max(comm, np.abs(stored))
    return _largest_difference(
        comm, "a value prescribed by a Dirichlet condition", stored[mask], present[mask], floor
    )


def point_data(contact: Contact) -> dict[str, Array]:
    """Return the data of law, obstacle and contact at this rank's points, by name. Collective."""
    contact.inputs.update()
    contact.contact_kinematics.update_data()
    data = contact.contact_kinematics.data.values
    names = ["weight", "normal", "shift", "turn", "about", "axis"]
    # If pairs are updated, the initial gap depends on the latest pairs.
    if contact.gap_prescribed or not contact.contact_kinematics.can_update_pairs:
        names.append("initial_gap")
    return {n: v for n, v in data.items() if n in names or n.startswith("parameter ")}


def _compare_points(contact: Contact, theirs: dict[str, Array], size: float) -> list[str]:
    """Compare the data at the points of a contact."""
    comm, ours = contact.surface.mesh.comm, point_data(contact)
    differences = [
        f"data of {contact.name}, {_join_names(theirs)} in the file and {_join_names(ours)} here"
    ] * (theirs.keys() != ours.keys())
    for name in (n for n in ours if n in theirs):  # in the same order on all ranks
        words = f"{name.removeprefix('parameter ')} of {contact.name} at a point of Γc"
        floor = _ROUND_OFF_RATIO * size if name in _LENGTHS else 0.0
        differences += _largest_difference(comm, words, theirs[name], ours[name], floor)
    return differences


def _join_names(data: dict[str, Array]) -> str:
    return ", ".join(name.removeprefix("parameter ") for name in data)


def _largest_difference(
    comm: MPI.Comm, words: str, theirs: Array, ours: Array, floor: float
) -> list[str]:
    """Describe the pair of values that differ most; empty if all are equal. Collective."""
    theirs, ours = theirs.ravel(), ours.ravel()
    worst = (0.0, 0.0, 0.0, 0.0)
    if theirs.size:
        difference = np.abs(theirs - ours)
        i = int(np.argmax(np.where(np.isnan(difference), np.inf, difference)))
        largest = float(max(np.abs(theirs).max(), np.abs(ours).max()))
        worst = (float(difference[i]), float(theirs[i]), float(ours[i]), largest)
    gathered = np.array(comm.allgather(worst))
    i = int(np.argmax(np.where(np.isnan(gathered[:, 0]), np.inf, gathered[:, 0])))
    if gathered[i, 0] <= _EQUAL_RATIO * gathered[:, 3].max() + floor:
        return []
    return [f"{words} is {gathered[i, 1]:.10g} in the file and {gathered[i, 2]:.10g} here"]
