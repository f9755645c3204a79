"""The fingerprint of a scene: what its equations are written in, by words and by numbers.

By it a problem refuses the states of another one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.contact.contact import Contact
from fenics_contact.histories.checkpoint_file import StoredCheckpoint
from fenics_contact.histories.point_matching import parts_of, positions
from fenics_contact.histories.signature import signature_of_law, signature_of_obstacle
from fenics_contact.obstacles.base import SampledObstacle
from fenics_contact.obstacles.deformable import DeformableBody
from fenics_contact.parallel import global_max, global_sum
from fenics_contact.problem import N_ROWS, ContactProblem
from fenics_contact.types import Array

__all__ = ["changed_data", "data_of", "data_words", "fixed_words", "probe", "why_another_scene"]

# Relative difference up to which data are the same, and, of lengths, relative to the mesh: the gap
# to an obstacle is a difference of coordinates.
_EQUAL, _ROUND_OFF = 1e-9, 1e-11
_LENGTHS = ("initial_gap", "shift", "about")


def why_another_scene(
    stored: StoredCheckpoint, problem: ContactProblem, fields: Sequence[fem.Function]
) -> list[str]:
    """Why no state of a file can be one of this problem, in words; empty: it may. Collective."""
    words = _compare_words(stored.scene["fixed"], fixed_words(problem, fields))
    return words or _compare_shapes(stored, problem, fields)


def changed_data(
    stored: StoredCheckpoint,
    problem: ContactProblem,
    committed: Array,
    given: Sequence[dict[str, Array]],
) -> list[str]:
    """What of the data is not as in a file, in words. Collective.

    Args:
        stored: What was read.
        problem: At the state of the file.
        committed: The state of the file, see `ContactProblem.committed_rows`.
        given: Data at the points of every contact.
    """
    differences = _compare_words(stored.scene["data"], data_words(problem))
    differences += _compare_probes(problem, stored.arrays)
    differences += _compare_conditions(problem, committed)
    for contact, theirs in zip(problem.contacts, given, strict=True):
        differences += _compare_points(contact, theirs, problem.full.scales.mesh_size)
    return differences


def fixed_words(problem: ContactProblem, fields: Sequence[fem.Function]) -> dict[str, str]:
    """What has to be the same for a state to fit at all, in words. Collective."""
    space = problem.displacement.u.function_space
    mesh, words = space.mesh, {}
    n_cells = mesh.topology.index_map(mesh.topology.dim).size_global
    degree = compat.geometry_element(mesh).degree
    words["mesh"] = f"{n_cells} {mesh.topology.cell_name()}s of degree {degree}"
    words["dimension"] = str(mesh.geometry.dim)
    words["element"] = str(space.element.basix_element.family).split(".")[-1]
    words["element"] += f" of degree {space.element.basix_element.degree}"
    words["nodes"] = str(space.dofmap.index_map.size_global)
    for part in parts_of(problem)[1:]:
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


def data_words(problem: ContactProblem) -> dict[str, str]:
    """What of the data is told by words, of the contacts."""
    words = {}
    for c in problem.contacts:
        parameters = c.law.parameters()
        switches = {n: v for n, v in vars(c.law).items() if n not in parameters}
        words[f"law of {c.name}"] = _name(c.law, switches)
        gdim, multipliers = problem.u.function_space.mesh.geometry.dim, c.multipliers is not None
        code = signature_of_law(c.law, gdim, multipliers=multipliers)
        words[f"code (UFL) of the law of {c.name}"] = code
        switches = {n: v for n, v in vars(c.obstacle).items() if isinstance(v, bool | str)}
        if isinstance(c.obstacle, DeformableBody):
            switches["search_distance"] = c.obstacle.search_distance
        if isinstance(c.obstacle, SampledObstacle):
            switches["data"] = c.obstacle.fingerprint
        words[f"obstacle of {c.name}"] = _name(c.obstacle, switches)
        if c.finite and c.rigid and not isinstance(c.obstacle, SampledObstacle):
            # With small displacements its values on Γc are all that counts.
            code = signature_of_obstacle(c.obstacle, gdim)
            words[f"code (UFL) of the obstacle of {c.name}"] = code
        words[f"enforcement of {c.name}"] = (
            "penalty" if c.multipliers is None else f"augmented to {c.tolerance:g}"
        )
        rule = c.surface.quadrature_scheme or "default"
        words[f"rule of {c.name}"] = f"{rule}, degree {c.quadrature.degree}"
    return words


def _name(item: Any, switches: dict[str, Any]) -> str:
    """Class and switches, as one would write them."""
    told = [f"{n}={v!r}" for n, v in switches.items() if isinstance(v, bool | int | float | str)]
    return f"{type(item).__name__}({', '.join(told)})"


def probe(problem: ContactProblem) -> dict[str, Array]:
    """Numbers of the bulk that no distribution changes: products of smooth fields. Collective.

    Returns:
        "stiffness": v·Kw of every pair of the fields, then what they are compared with; "loads":
        v·f and the forces on free obstacles, likewise.
    """
    space = problem.u.function_space
    comm, d = space.mesh.comm, space.mesh.geometry.dim
    parts = [(part.dofs, part.space.dofmap.bs, positions(part.space)) for part in parts_of(problem)]
    low = parts[0][2].min(axis=0, initial=np.inf)
    comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
    n_owned = problem.full.unknowns.n_dofs
    smooth, images = [], []
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
            smooth.append(field.x.array[:n_owned].copy())
            images.append(image.x.array[:n_owned].copy())
    load = problem.full.present_load()
    v, w, f = np.array(smooth), np.array(images), load[:n_owned]
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
    """Whether the arrays are those of such a problem, but for the numbers of places."""
    gdim, n_motions = len(problem.displacement.u), problem.full.unknowns.n_motions
    wanted: dict[str, tuple[int | None, ...]] = {
        "numbers": (None,),
        "state": (2 + len(problem.contacts),),
        "motions": (N_ROWS, n_motions),
        "stiffness": (2, 9),
        "loads": (2, 3 + n_motions),
    }
    for part in parts_of(problem):
        wanted[part.name] = (None, 2 * gdim + N_ROWS * part.space.dofmap.bs)
    for c in problem.contacts:
        sizes = [sum(max(width, 1) for _, width in t) for t in stored.scene["contacts"][c.name]]
        n_history = c.history.rows().shape[1]
        wanted[f"contact {c.name}"] = (None, 2 * gdim + n_history + sizes[0])
        wanted[f"values {c.name}"] = (None, 2 * gdim + sizes[1])
    for number, field in enumerate(fields):
        bs = field.function_space.dofmap.index_map_bs
        wanted[f"field {number}"] = (None, 2 * gdim + bs)
    theirs, names = stored.arrays, wanted.keys() | stored.arrays.keys()
    return [
        f"array {name!r} has shape {theirs[name].shape if name in theirs else None} in the file "
        f"and {wanted.get(name)} here"
        for name in sorted(names)
        if name not in theirs
        or name not in wanted
        or theirs[name].ndim != len(wanted[name])
        or any(n not in (None, m) for n, m in zip(wanted[name], theirs[name].shape, strict=True))
    ]


def _compare_probes(problem: ContactProblem, theirs: dict[str, Array]) -> list[str]:
    """Stiffness and loads."""
    ours, differences = probe(problem), []
    rigid = problem.full.bulk.scale * problem.full.scales.mesh_size * np.finfo(float).eps
    for name, words in (
        ("stiffness", "stiffness of the bulk, by smooth fields v·Kw,"),
        ("loads", "loads of the bulk and on free obstacles, by smooth fields v·f,"),
    ):
        (a, scale), (b, other) = theirs[name], ours[name]
        allowed = _EQUAL * np.maximum(scale, other) + (rigid if name == "loads" else 0.0)
        excess = np.abs(a - b) - allowed
        if not np.all(excess <= 0):
            i = int(np.argmax(excess))
            differences.append(f"{words} is {a[i]:.10g} in the file and {b[i]:.10g} here")
    return differences


def _compare_conditions(problem: ContactProblem, committed: Array) -> list[str]:
    """Which components are prescribed, and their values, at a state."""
    comm, then, mask = problem.u.function_space.mesh.comm, committed[0], committed[-1] > 0
    differ = int(global_sum(comm, np.count_nonzero(mask != problem.full.constrained)))
    if differ:
        theirs, ours = global_sum(comm, [mask.sum(), problem.full.constrained.sum()])
        return [
            f"Dirichlet conditions: {theirs:.0f} components of nodes are prescribed in the file "
            f"and {ours:.0f} here, and {differ} of them are not the same"
        ]
    now = problem.full.prescribed_values()
    # A direct solver leaves its round-off where values are prescribed, too.
    floor = _ROUND_OFF * global_max(comm, np.abs(then))
    return _largest_difference(
        comm, "a value prescribed by a Dirichlet condition", then[mask], now[mask], floor
    )


def data_of(contact: Contact) -> dict[str, Array]:
    """The data of law, obstacle and contact at this rank's points, by name. Collective.

    The results of the last evaluation are not changed.
    """
    contact.inputs.update()
    contact.contact_kinematics.update_data()
    data = contact.contact_kinematics.data.values
    names = ["weight", "normal", "shift", "turn", "about", "axis"]
    # Else it is that of the latest pairs.
    if contact.gap_prescribed or not contact.contact_kinematics.can_update_pairs:
        names.append("initial_gap")
    return {n: v for n, v in data.items() if n in names or n.startswith("parameter ")}


def _compare_points(contact: Contact, theirs: dict[str, Array], size: float) -> list[str]:
    """Data at the points."""
    comm, ours = contact.surface.mesh.comm, data_of(contact)
    missing = [f"data of {contact.name}, {_named(theirs)} in the file and {_named(ours)} here"] * (
        theirs.keys() != ours.keys()
    )
    for name in (n for n in ours if n in theirs):  # in the same order on all ranks
        words = f"{name.removeprefix('parameter ')} of {contact.name} at a point of Γc"
        floor = _ROUND_OFF * size if name in _LENGTHS else 0.0
        missing += _largest_difference(comm, words, theirs[name], ours[name], floor)
    return missing


def _named(data: dict[str, Array]) -> str:
    return ", ".join(name.removeprefix("parameter ") for name in data)


def _largest_difference(
    comm: MPI.Comm, words: str, theirs: Array, ours: Array, floor: float
) -> list[str]:
    """The two values that differ most, in words; nothing if they do not. Collective."""
    theirs, ours = theirs.ravel(), ours.ravel()
    worst = (0.0, 0.0, 0.0, 0.0)
    if theirs.size:
        difference = np.abs(theirs - ours)
        i = int(np.argmax(np.where(np.isnan(difference), np.inf, difference)))
        largest = float(max(np.abs(theirs).max(), np.abs(ours).max()))
        worst = (float(difference[i]), float(theirs[i]), float(ours[i]), largest)
    everyone = np.array(comm.allgather(worst))
    i = int(np.argmax(np.where(np.isnan(everyone[:, 0]), np.inf, everyone[:, 0])))
    if everyone[i, 0] <= _EQUAL * everyone[:, 3].max() + floor:
        return []
    return [f"{words} is {everyone[i, 1]:.10g} in the file and {everyone[i, 2]:.10g} here"]
