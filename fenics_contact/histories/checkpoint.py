"""The committed state of a problem in a file, to go on from after whatever ended the run.

The file is an archive of NumPy arrays. DOLFINx's own writers (ADIOS2, HDF5) carry functions on the
cells of a mesh; the history lives at quadrature points of facets, for which they have no format.
Every value is stored with where it belongs, so that any number of ranks finds it again: the place
of its node or point, and the middle of the cells around it, which tells apart what shares a place
(two bodies that touch, the faces of a slit).

With the state goes a fingerprint of the scene: what the equations are written in, by words and by
numbers, so that a state is not taken up by a problem that it is no state of.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import basix
import dolfinx
import numpy as np
import scipy.spatial
from dolfinx import fem, la
from mpi4py import MPI

from fenics_contact import compat
from fenics_contact.contact.contact import Contact
from fenics_contact.parallel import collective_errors, fail_together, global_max, global_sum
from fenics_contact.problem import ContactProblem
from fenics_contact.results import files
from fenics_contact.supports.base import SampledSupport
from fenics_contact.supports.deformable import DeformableBody
from fenics_contact.surface.facets import facet_cells
from fenics_contact.types import Array, Indices

__all__ = [
    "Stored",
    "check_changed",
    "check_fields",
    "exists",
    "load",
    "read",
    "save",
    "take_up",
]

logger = logging.getLogger("fenics_contact")

_FORMAT = 4
# The file's end: these words, and the digest of all before them.
_MARK = b"\nfenics_contact checkpoint, sha256 "
# Distance, relative to the mesh, within which a place is found again: computed on other ranks its
# coordinates differ by round-off.
_SAME = 1e-9
# Relative difference up to which data are the same, and, of lengths, relative to the mesh: the gap
# to a support is a difference of coordinates.
_EQUAL, _ROUND_OFF = 1e-9, 1e-11
_LENGTHS = ("initial_gap", "shift", "about")
_REMEDY = "remove it to start anew"


@dataclass(frozen=True)
class Stored:
    """What a file holds, on every rank.

    Attributes:
        path: The file.
        scene: The fingerprint in words, and what else is no array.
        arrays: By name.
    """

    path: Path
    scene: dict[str, Any]
    arrays: dict[str, Array]

    @property
    def numbers(self) -> list[float]:
        """The caller's numbers."""
        return [float(value) for value in self.arrays["numbers"]]

    @property
    def notes(self) -> Any:
        """The caller's notes."""
        return self.scene["notes"]


def exists(problem: ContactProblem, path: str | Path) -> bool:
    """Whether there is something of that name, as rank 0 sees it. Collective."""
    comm = problem.u.function_space.mesh.comm
    found = None
    with collective_errors(comm):
        if comm.rank == 0:
            found = Path(path).exists()
    return bool(comm.bcast(found))


def save(
    problem: ContactProblem,
    path: str | Path,
    numbers: Sequence[float] = (),
    *,
    fields: Sequence[fem.Function] = (),
    notes: Any = None,
) -> None:
    """Write the committed state, with the loads as they are now. Collective.

    The file is complete or as before, whenever the program is ended: it is written under another
    name, and then renamed. What the solver knows from earlier increments is dropped, here as in a
    program that starts from the file, so that both go on with the same digits (on several ranks
    to the solver's tolerance: there MUMPS adds in the order in which messages come).

    Args:
        problem: At a committed state.
        path: The file (``.npz``).
        numbers: The caller's own, to be found again: the load parameter, for instance.
        fields: The caller's functions that belong to the state; see `check_fields`.
        notes: More of the caller's, of what JSON can hold.

    Raises:
        ValueError: The problem has a solved increment that is not committed, or a state that is
            not finite; or see `check_fields`.
        OSError: It cannot be written; the problem is as before. On all ranks.
    """
    comm = problem.u.function_space.mesh.comm
    check_fields(problem, fields)
    unknowns, state = problem.committed_state()
    arrays = {
        "numbers": np.array(numbers, dtype=np.float64),
        "state": state,
        "motions": np.stack([problem.unknowns.motions(row) for row in unknowns]),
        **_probe(problem),
    }
    physical = _physical(problem, unknowns)
    for part in _parts(problem):
        rows = physical[:, part.dofs].reshape(len(physical), -1, part.space.dofmap.bs)
        arrays[part.name] = _gather(comm, _node_places(part.space), *rows)
    scene: dict[str, Any] = {"format": _FORMAT, "notes": notes, "contacts": {}}
    scene["fixed"], scene["data"] = _fixed(problem, fields), _data(problem)
    for contact in problem.contacts:
        given, values = contact.given(), dict(contact.values.arrays)
        scene["contacts"][contact.name] = _layout(given), _layout(values)
        places = _point_places(contact)
        arrays[f"contact {contact.name}"] = _gather(comm, places, contact.history.rows(), given)
        arrays[f"values {contact.name}"] = _gather(comm, places, values)
    for number, field in enumerate(fields):
        arrays[f"field {number}"] = _gather(comm, _node_places(field.function_space), _rows(field))
    with collective_errors(comm):
        if comm.rank == 0:
            for name, array in arrays.items():
                _check_finite(name, array, "the committed state is none; nothing is saved")
            _write(Path(path), scene, arrays)
    problem.restart_solver()


def load(
    problem: ContactProblem,
    path: str | Path,
    *,
    fields: Sequence[fem.Function] = (),
    changed: str = "refuse",
) -> list[float]:
    """Make a saved state the committed one. Collective.

    The loads, conditions and supports must be set as they were: they are compared.

    Args:
        problem: That of the file, made anew.
        path: The file.
        fields: Those that were given to `save`, to be set; in the same order.
        changed: "refuse" a file whose state is one of other data than the problem's (stiffness,
            laws and their parameters, supports, conditions, loads), or "continue" from it with the
            data of the problem.

    Returns:
        The caller's numbers.

    Raises:
        ValueError: The file is damaged, none of `save`, or that of another mesh, element, rule or
            set of contacts, or of other data; the problem is as before. On all ranks.
        OSError: It cannot be read. On all ranks.
    """
    check_changed(changed)
    stored = read(problem, path)
    take_up(problem, stored, fields=fields, changed=changed)
    return stored.numbers


def check_changed(changed: str) -> None:
    """Refuse words that are none of the two.

    Raises:
        ValueError: It says which there are.
    """
    if changed not in ("refuse", "continue"):
        raise ValueError(f'changed is {changed!r}; it must be "refuse" or "continue"')


def check_fields(problem: ContactProblem, fields: Sequence[fem.Function]) -> None:
    """Refuse what cannot be saved with the state. Collective.

    That is every function but those of real values at points (Lagrange of any degree, continuous
    or not, quadrature elements; scalar or blocked), on the mesh or a submesh of it.

    Raises:
        ValueError: It names the field. On all ranks.
    """
    comm = problem.u.function_space.mesh.comm
    for number, field in enumerate(fields):
        if not isinstance(field, fem.Function):
            raise ValueError(
                f"fields[{number}] is a {type(field).__name__}; it must be a fem.Function"
            )
        what, space = f"fields[{number}], {field.name!r},", field.function_space
        dofmap = space.dofmap
        n_nodes = dofmap.index_map.size_local + dofmap.index_map.num_ghosts
        if field is problem.u:
            raise ValueError(
                f"{what} is the function of the displacement, which is saved by itself"
            )
        if field.x.array.dtype != np.float64:
            raise ValueError(f"{what} has values of type {field.x.array.dtype}; save float64")
        if MPI.Comm.Compare(space.mesh.comm, comm) not in (MPI.IDENT, MPI.CONGRUENT):
            raise ValueError(f"{what} is on a mesh of other ranks than the problem's")
        try:
            space.tabulate_dof_coordinates()
            whole = field.x.array.size == n_nodes * dofmap.index_map_bs
            pointwise = whole and dofmap.bs == dofmap.index_map_bs
        except RuntimeError:
            pointwise = False
        if not pointwise:
            raise ValueError(
                f"{what} is in {space.ufl_element()}, whose dofs are no values at points; "
                "interpolate it to a Lagrange or quadrature space, parts of a mixed one each into "
                "a function of its own"
            )


def read(problem: ContactProblem, path: str | Path) -> Stored:
    """Read and check a file by itself. Collective.

    Raises:
        ValueError: It is damaged, or none of `save`. On all ranks.
        OSError: It cannot be read. On all ranks.
    """
    comm, path = problem.u.function_space.mesh.comm, Path(path)
    found = None
    with collective_errors(comm):
        if comm.rank == 0:
            found = _read(path)
    scene, arrays = comm.bcast(found)
    return Stored(path, scene, arrays)


def take_up(
    problem: ContactProblem,
    stored: Stored,
    *,
    loads: Callable[[], None] | None = None,
    fields: Sequence[fem.Function] = (),
    changed: str = "refuse",
) -> None:
    """Make what `read` gave the committed state. Collective.

    Everything is checked before anything is set.

    Args:
        problem: See `load`.
        stored: What was read.
        loads: Sets the loads as they were; called where the file may be that of the problem. If
            what follows fails, it is the caller's to take them back.
        fields: See `load`.
        changed: See `load`.

    Raises:
        ValueError: See `load`.
    """
    comm = problem.u.function_space.mesh.comm
    check_fields(problem, fields)
    _refuse(stored, _compare_words(stored.scene["fixed"], _fixed(problem, fields)))
    _refuse(stored, _compare_shapes(stored, problem, fields))
    size = problem.motions.size
    motions = stored.arrays["motions"]
    rows = np.zeros((len(motions), problem.unknowns.n_dofs))
    for part in _parts(problem):
        nodes = _find(comm, stored, part.name, _node_places(part.space), size)
        # A rank may have no nodes, of which no shape can be told.
        width = nodes.shape[1] // len(motions)
        by_row = nodes.reshape(len(nodes), len(motions), width).swapaxes(0, 1)
        rows[:, part.dofs] = by_row.reshape(len(motions), len(nodes) * width)
    joined = (problem.unknowns.joined(row, motions[i]) for i, row in enumerate(rows))
    unknowns = np.stack(list(joined))
    unknowns = _physical(problem, unknowns, back=True)
    points, given = [], []
    for contact in problem.contacts:
        places, (data, layout) = _point_places(contact), stored.scene["contacts"][contact.name]
        found = _find(comm, stored, f"contact {contact.name}", places, size)
        n_history = contact.history.rows().shape[1]
        given.append(_unpack(found[:, n_history:], data))
        values = _unpack(_find(comm, stored, f"values {contact.name}", places, size), layout)
        points.append((found[:, :n_history], values))
    own = []
    for number, field in enumerate(fields):
        places = _node_places(field.function_space)
        own.append(_find(comm, stored, f"field {number}", places, size))
    before = [field.x.array.copy() for field in fields]
    try:
        if loads is not None:
            loads()
        for field, row in zip(fields, own, strict=True):
            _set_rows(field, row)
        with problem.at_state(unknowns[0]):
            differences = _compare_words(stored.scene["data"], _data(problem))
            differences += _compare_probes(problem, stored.arrays)
            differences += _compare_conditions(problem, unknowns)
            for contact, theirs in zip(problem.contacts, given, strict=True):
                differences += _compare_points(contact, theirs, size)
        if changed == "refuse":
            _refuse(stored, differences, ', or give changed="continue" to go on with what is here')
    except BaseException as error:
        fail_together(comm, error)
        for field, array in zip(fields, before, strict=True):
            field.x.array[:] = array
        raise
    if differences and comm.rank == 0:
        logger.warning("going on from %s with changed data: %s", stored.path, _list(differences))
    problem.set_committed(unknowns, stored.arrays["state"], points)


# ---- the file ------------------------------------------------------------------------------------


def _write(path: Path, scene: dict[str, Any], arrays: dict[str, Array]) -> None:
    """Write the archive, read it back, and put it in place.

    Raises:
        OSError: It cannot be written, or is not what was written. The file before it stays.
    """
    content = _pack(scene, arrays)
    with files.replacing(path) as temporary:
        with open(temporary, "wb") as file:
            file.write(content)
        # Whether it can be gone on from is better known now than when it is needed.
        if temporary.read_bytes() != content:
            raise OSError(f"{path} is not what was written: is the disk full, or damaged?")


def _pack(scene: dict[str, Any], arrays: dict[str, Array]) -> bytes:
    """The archive, and how it ends."""
    words = np.frombuffer(json.dumps(scene).encode(), dtype=np.uint8)
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, scene=words, **arrays)
    content = archive.getvalue()
    return content + _MARK + hashlib.sha256(content).hexdigest().encode()


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Array]]:
    """Scene and arrays of a file.

    Raises:
        ValueError: It is damaged, or none of this format.
        OSError: It cannot be read.
    """
    content = path.read_bytes()
    end = len(content) - len(_MARK) - 64
    if end < 0 or content[end : end + len(_MARK)] != _MARK:
        raise ValueError(
            f"{path} is no checkpoint of this version, or is cut short: its end is missing; put a "
            f"copy in its place, or {_REMEDY}"
        )
    if hashlib.sha256(content[:end]).hexdigest().encode() != content[-64:]:
        raise ValueError(
            f"{path} is damaged: it is not as it was written; put a copy in its place, or {_REMEDY}"
        )
    try:
        with np.load(io.BytesIO(content[:end]), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        scene = json.loads(arrays.pop("scene").tobytes())
        found = scene["format"]
        wanted = {"format", "notes", "contacts", "fixed", "data"}
        complete = found != _FORMAT or (set(scene) == wanted and "numbers" in arrays)
    except Exception as error:  # whatever the archive's reader makes of it
        raise ValueError(f"{path} is no checkpoint ({error}); {_REMEDY}") from error
    if found != _FORMAT or not complete:
        raise ValueError(
            f"{path} is a checkpoint of format {found!r}, and this version reads {_FORMAT}; go on "
            f"with the version that wrote it, or {_REMEDY}"
        )
    for name, array in arrays.items():
        if array.dtype != np.float64 or array.ndim not in (1, 2):
            raise ValueError(
                f"{path}: {name!r} is of type {array.dtype}, with {array.ndim} axes; a checkpoint "
                f"has tables of float64; {_REMEDY}"
            )
        _check_finite(name, array, f"{path}, {_REMEDY}")
    return scene, arrays


def _check_finite(name: str, array: Array, where: str) -> None:
    # Where an increment is cut is infinite where none was; what is evaluated may be anything.
    wrong = np.isnan(array) if name == "numbers" else ~np.isfinite(array)
    if wrong.any() and not name.startswith("values "):
        raise ValueError(f"{name!r} has values that are not finite: {where}")


def _refuse(stored: Stored, differences: Sequence[str], remedy: str = "") -> None:
    """Raise if something differs."""
    if differences:
        raise ValueError(
            f"{stored.path} is not of this problem: {_list(differences)}; {_REMEDY}{remedy}"
        )


def _list(differences: Sequence[str]) -> str:
    return "; ".join(differences)


# ---- the fingerprint -----------------------------------------------------------------------------


def _fixed(problem: ContactProblem, fields: Sequence[fem.Function]) -> dict[str, str]:
    """What no state can be taken over into another of, in words. Collective."""
    space = problem.displacement.u.function_space
    mesh, words = space.mesh, {}
    n_cells = mesh.topology.index_map(mesh.topology.dim).size_global
    degree = compat.geometry_element(mesh).degree
    words["mesh"] = f"{n_cells} {mesh.topology.cell_name()}s of degree {degree}"
    words["dimension"] = str(mesh.geometry.dim)
    words["element"] = str(space.element.basix_element.family).split(".")[-1]
    words["element"] += f" of degree {space.element.basix_element.degree}"
    words["nodes"] = str(space.dofmap.index_map.size_global)
    for part in _parts(problem)[1:]:
        nodes = part.space.dofmap.index_map.size_global
        words[part.name] = f"{part.space.ufl_element()} at {nodes} nodes"
    words["contacts"] = ", ".join(c.name for c in problem.contacts)
    for c in problem.contacts:
        n_points = int(global_sum(mesh.comm, c.quadrature.n_points))
        words[f"quadrature of {c.name}"] = f"{n_points} points"
        words[f"history of {c.name}"] = ", ".join(c.history.names)
        words[f"kinematics of {c.name}"] = "finite" if c.finite else "small"
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


def _data(problem: ContactProblem) -> dict[str, str]:
    """What of the data is told by words, of the contacts."""
    words = {}
    for c in problem.contacts:
        parameters = c.law.parameters()
        switches = {n: v for n, v in vars(c.law).items() if n not in parameters}
        words[f"law of {c.name}"] = _name(c.law, switches)
        switches = {n: v for n, v in vars(c.support).items() if isinstance(v, bool | str)}
        if isinstance(c.support, DeformableBody):
            switches["search_distance"] = c.support.search_distance
        if isinstance(c.support, SampledSupport):
            switches["data"] = c.support.fingerprint
        words[f"support of {c.name}"] = _name(c.support, switches)
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


def _probe(problem: ContactProblem) -> dict[str, Array]:
    """Numbers of the bulk that no distribution changes: products of smooth fields. Collective.

    Returns:
        "stiffness": v·Kw of every pair of the fields, then what they are compared with; "loads":
        v·f and the forces on free supports, likewise.
    """
    space = problem.u.function_space
    comm, d = space.mesh.comm, space.mesh.geometry.dim
    parts = [(part.dofs, part.space.dofmap.bs, _positions(part.space)) for part in _parts(problem)]
    low = parts[0][2].min(axis=0, initial=np.inf)
    comm.Allreduce(MPI.IN_PLACE, low, op=MPI.MIN)
    n_owned = problem.unknowns.n_dofs
    smooth, images = [], []
    field, image = fem.Function(space), fem.Function(space)
    with problem.bulk.present_stiffness() as stiffness:
        for k in range(3):
            for dofs, bs, x in parts:
                phases = 1.0 + k + 2.0 * np.arange(bs)
                waves = np.cos(np.add.outer(np.arange(d), np.arange(bs)) * (1 + k)) * (2 + k)
                values = np.sin((x - low) / problem.motions.size @ waves + phases)
                field.x.array[dofs] = values.ravel()
            field.x.scatter_forward()
            stiffness.mult(field.x.petsc_vec, image.x.petsc_vec)
            smooth.append(field.x.array[:n_owned].copy())
            images.append(image.x.array[:n_owned].copy())
    load = problem.present_load()
    v, w, f = np.array(smooth), np.array(images), load[:n_owned]
    products = v @ w.T
    sums = global_sum(comm, np.concatenate([products.ravel(), v @ f]))
    squares = global_sum(
        comm, np.concatenate([np.sum(v**2, axis=1), np.sum(w**2, axis=1), [f @ f]])
    )
    nv, nw, nf = np.split(np.sqrt(squares), [3, 6])
    motions = problem.unknowns.motions(load)
    return {
        "stiffness": np.stack([sums[:9], np.outer(nv, nw).ravel()]),
        "loads": np.stack(
            [np.concatenate([sums[9:], motions]), np.concatenate([nv * nf, np.abs(motions)])]
        ),
    }


def _compare_words(theirs: dict[str, str], ours: dict[str, str]) -> list[str]:
    return [
        f"{name} is {theirs.get(name, 'not there')} in the file and {ours.get(name, 'not')} here"
        for name in dict.fromkeys([*theirs, *ours])
        if theirs.get(name) != ours.get(name)
    ]


def _compare_shapes(
    stored: Stored, problem: ContactProblem, fields: Sequence[fem.Function]
) -> list[str]:
    """Whether the arrays are those of such a problem, but for the numbers of places."""
    gdim, n_motions = len(problem.displacement.u), problem.unknowns.n_motions
    wanted: dict[str, tuple[int | None, ...]] = {
        "numbers": (None,),
        "state": (2 + len(problem.contacts),),
        "motions": (6, n_motions),
        "stiffness": (2, 9),
        "loads": (2, 3 + n_motions),
    }
    for part in _parts(problem):
        wanted[part.name] = (None, 2 * gdim + 6 * part.space.dofmap.bs)
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
    ours, differences = _probe(problem), []
    rigid = problem.bulk.scale * problem.motions.size * np.finfo(float).eps
    for name, words in (
        ("stiffness", "stiffness of the bulk, by smooth fields v·Kw,"),
        ("loads", "loads of the bulk and on free supports, by smooth fields v·f,"),
    ):
        (a, scale), (b, other) = theirs[name], ours[name]
        allowed = _EQUAL * np.maximum(scale, other) + (rigid if name == "loads" else 0.0)
        excess = np.abs(a - b) - allowed
        if not np.all(excess <= 0):
            i = int(np.argmax(excess))
            differences.append(f"{words} is {a[i]:.10g} in the file and {b[i]:.10g} here")
    return differences


def _compare_conditions(problem: ContactProblem, unknowns: Array) -> list[str]:
    """Which components are prescribed, and their values, at the state of ``unknowns``."""
    comm, mask = problem.u.function_space.mesh.comm, unknowns[-1] > 0
    differ = int(global_sum(comm, np.count_nonzero(mask != problem.constrained)))
    if differ:
        theirs, ours = global_sum(comm, [mask.sum(), problem.constrained.sum()])
        return [
            f"Dirichlet conditions: {theirs:.0f} components of nodes are prescribed in the file "
            f"and {ours:.0f} here, and {differ} of them are not the same"
        ]
    now, then = problem.prescribed_values(), unknowns[0]
    # A direct solver leaves its round-off where values are prescribed, too.
    floor = _ROUND_OFF * global_max(comm, np.abs(then))
    return _largest_difference(
        comm, "a value prescribed by a Dirichlet condition", then[mask], now[mask], floor
    )


def _compare_points(contact: Contact, theirs: dict[str, Array], size: float) -> list[str]:
    """Data at the points."""
    comm, ours = contact.surface.mesh.comm, contact.given()
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


# ---- values and their places ---------------------------------------------------------------------


def _layout(data: dict[str, Array]) -> list[tuple[str, int]]:
    """Names and numbers of components, 0 for scalars."""
    return [(name, array.shape[1] if array.ndim > 1 else 0) for name, array in data.items()]


def _unpack(rows: Array, layout: Sequence[tuple[str, int]]) -> dict[str, Array]:
    """The columns of rows by name."""
    data, first = {}, 0
    for name, width in layout:
        data[name] = rows[:, first : first + width] if width else rows[:, first].copy()
        first += max(width, 1)
    return data


def _gather(comm: MPI.Comm, places: Array, *values: Array | dict[str, Array]) -> Array:
    """Rows of places and values of all ranks on rank 0, nothing on the others. Collective."""
    columns = [places]
    for part in values:
        columns += part.values() if isinstance(part, dict) else [part]
    gathered = comm.gather(np.column_stack(columns))
    return np.zeros((0, 0)) if gathered is None else np.concatenate(gathered)


def _find(comm: MPI.Comm, stored: Stored, name: str, places: Array, size: float) -> Array:
    """The stored values at given places, (n, n_values). Collective."""
    table, width = stored.arrays[name], places.shape[1]
    counts = comm.allgather(len(places))
    missing, row = len(places), np.zeros(0, dtype=np.int64)
    if len(table):
        distance, row = scipy.spatial.cKDTree(table[:, :width]).query(places)
        missing = int(np.count_nonzero(distance > _SAME * size))
    missing = comm.allreduce(missing)
    if missing or len(table) != sum(counts):
        _refuse(
            stored,
            [
                f"{name} is of another mesh, element or quadrature rule, {len(table)} places in "
                f"the file and {sum(counts)} here, of which {missing} are not in it"
            ],
        )
    used = np.concatenate(comm.allgather(row))
    if np.unique(used).size < used.size:
        _refuse(stored, [f"{name} has several values at one place, which cannot be told apart"])
    return table[row, width:]


class _Part(NamedTuple):
    """Of what is solved for: a space of its own, and the numbers of this rank's dofs."""

    name: str
    space: fem.FunctionSpace
    dofs: Indices


def _parts(problem: ContactProblem) -> list[_Part]:
    """The displacement first. Collective."""
    displacement = problem.displacement
    space, dofs = displacement.u.function_space, displacement.dofs
    if dofs is None:
        dofs = np.arange(displacement.n_owned, dtype=np.int32)
    found = [_Part("nodes", space, dofs[: displacement.n_owned])]
    for number, (other, numbers) in enumerate(displacement.others, start=1):
        owned = other.dofmap.index_map.size_local * other.dofmap.index_map_bs
        found.append(_Part(f"part {number}", other, numbers[:owned]))
    return found


def _physical(problem: ContactProblem, rows: Array, *, back: bool = False) -> Array:
    """States and forces of `committed_state` in the user's units, or ``back``. Collective."""
    n, bulk, found = problem.unknowns.n_dofs, problem.bulk, rows.copy()
    convert = (bulk.in_units, bulk.from_units)
    for i in range(4):  # two states and two forces
        found[i, :n] = convert[(i < 2) != back](rows[i, :n])
    return found


def _positions(space: fem.FunctionSpace) -> Array:
    """Coordinates of the owned nodes, (n, gdim).

    Raises:
        ValueError: Values are at no places.
    """
    gdim, dofmap = space.mesh.geometry.dim, space.dofmap
    n_owned = dofmap.index_map.size_local
    try:
        bubbles = space.element.basix_element.family == basix.ElementFamily.bubble
    except RuntimeError:  # a quadrature element has none
        bubbles = False
    if not bubbles:
        return space.tabulate_dof_coordinates()[:n_owned, :gdim]
    if dofmap.dof_layout.num_dofs != 1:
        raise ValueError(
            f"values in {space.ufl_element()} are at no points, and cannot be found again on other "
            "ranks; take bubbles of one function a cell"
        )
    cells = dofmap.list[:, 0]
    places = np.zeros((n_owned + dofmap.index_map.num_ghosts, gdim))
    places[cells] = _middles(space.mesh)[: len(cells)]
    return places[:n_owned]


def _rows(field: fem.Function) -> Array:
    """Values at the owned nodes, (n_nodes, bs)."""
    dofmap = field.function_space.dofmap
    n_owned = dofmap.index_map.size_local
    return field.x.array.reshape(-1, dofmap.index_map_bs)[:n_owned]


def _set_rows(field: fem.Function, rows: Array) -> None:
    """Set what `_rows` gave. Collective."""
    _rows(field)[:] = rows
    field.x.scatter_forward()


def _middles(mesh: dolfinx.mesh.Mesh) -> Array:
    """Middles of this rank's cells, ghosts included, (n_cells, gdim)."""
    middles: Array = mesh.geometry.x[compat.geometry_dofmap(mesh)].mean(axis=1)
    return middles[:, : mesh.geometry.dim]


def _node_places(space: fem.FunctionSpace) -> Array:
    """Coordinates of the owned nodes and mean middle of their cells, (n, 2 gdim). Collective."""
    gdim, dofmap = space.mesh.geometry.dim, space.dofmap
    n_owned = dofmap.index_map.size_local
    n_cells = space.mesh.topology.index_map(space.mesh.topology.dim).size_local
    cells, middles = dofmap.list[:n_cells], _middles(space.mesh)[:n_cells]
    total = la.vector(dofmap.index_map, gdim + 1)
    sums = total.array.reshape(-1, gdim + 1)
    sums[:] = 0.0
    rows = np.column_stack([middles, np.ones(n_cells)])
    np.add.at(sums, cells.ravel(), np.repeat(rows, cells.shape[1], axis=0))
    total.scatter_reverse(la.InsertMode.add)
    mean = sums[:n_owned, :gdim] / sums[:n_owned, gdim:]
    return np.hstack([_positions(space), mean])


def _point_places(contact: Contact) -> Array:
    """Coordinates of the owned points and middle of their cell, (n, 2 gdim). Collective."""
    surface, rows = contact.surface, contact.quadrature.point_rows()
    cells = facet_cells(surface.mesh, surface.facets)
    middles = np.empty_like(contact.points)
    middles[rows] = _middles(surface.mesh)[cells][:, None]
    return np.hstack([contact.points, middles])
