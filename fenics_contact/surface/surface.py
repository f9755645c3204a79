"""ContactSurface: the facets of Γc, their submesh, and the quadrature points that carry history."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral

import basix.ufl
import dolfinx.fem.petsc
import numpy as np
import numpy.typing as npt
import scipy.spatial
import ufl
from dolfinx import fem, la
from petsc4py import PETSc

from fenics_contact import compat
from fenics_contact.arguments import check_cells, check_instance, is_number
from fenics_contact.compiling import compile_form, printed_as_ever
from fenics_contact.parallel import gather_rows, global_max, global_min
from fenics_contact.surface.mass import assembled
from fenics_contact.tolerances import NEGLIGIBLE
from fenics_contact.types import Array, Indices

__all__ = [
    "FINEST_RULE",
    "POINTS_PER_RADIUS",
    "ContactSurface",
    "PointEvaluator",
    "Sparse",
    "SurfaceQuadrature",
    "VertexAreas",
    "tagged_facets",
]

_SCHEMES = ("default", "vertex")
# A block of width 1 on facets of Γc in the plane, those opposite so many times as short: force by
# p + 1 points on a facet of Γc over that by as many on each opposite one.
#     2: 0.98, 3: 0.91, 4: 0.96, 5: 0.83, 10: 0.59, 40: 0.5; where points feel pieces of facets
#     2: 0.99, 3: 0.97, 4: 1.01, 5: 1.00, 10: 0.61, 40: 0.54.
_PIERCING = 6
# Degree of the finest rule that is taken unasked, by dimension: 40 points on a facet in the plane,
# 16 in space. There pairs that are integrated piece by piece take 0.6 ms for an opposite facet at
# degree 2, 2 at 6 and 15 at 14.
FINEST_RULE = {2: 78, 3: 6}
# Of one block on another in space, where points feel the opposite at themselves alone, force with
# that rule over that with the finer side as Γc: by degree of the elements, and how many opposite
# facets are as long as one of Γc, of which there are 1 and 2 x 2.
#     hexahedra, 1:  5: 0.995 and 0.998, 6: 0.83 and 0.93, 7: 0.95 and 0.98, 8: 0.93 and 0.98;
#     hexahedra, 2:  2: 0.98 and 0.99, 3: 0.74 and 0.87, 4: 0.88, 5: 0.79;
#     tetrahedra, 1: 5: 0.993 and 0.997, 6: 0.97 and 0.99, 8: 0.93;
#     tetrahedra, 2: 2: 1.00 and 1.00, 3: 0.97 and 0.99, 4: 0.91.
# In the plane it is 0.997 or more up to 200 opposite facets, and pieces leave less than 1e-4.
_NODES_PER_POINT = 1.25
# By how many times as many opposite facets as by their longest sides are along one of Γc where they
# are narrow: right angles in triangles alone make it 1.7.
_NARROW = 2.0
# By how many times as many opposite facets under one of Γc as by the medians they are counted
# there: less is found in meshes whose facets are meant to be alike.
_GRADED = 1.5
# Points of Γc along a rigid obstacle by its smallest radius, at least, times the degree of the
# elements. A cylinder of radius R is pressed 0.3 R into rubber and slides; by facets of length
# h, the force over that by 8 times as many points, and by how much it rises and falls there (8 and
# 16 % by the facets themselves):
#     h = R:   1/2: 0.986 and 3 %, 1/3: 0.998 and 10 %, 1/4: 1.000 and 8 %;
#     h = 2 R: 1: 0.82 and 37 %, 2/3: 0.96 and 27 %, 1/2: 0.99 and 17 %, 1/3: 1.000 and 16 %;
# by multipliers at the nodes 0.68 at h = R, 0.91 at R / 2.
POINTS_PER_RADIUS = 4
# Of the squared cosine of the angle between normals: from here on facets are compared.
_FACING = 0.5


class ContactSurface:
    """The potential contact surface Γc: exterior facets with given tags.

    Cells may be triangles, quadrilaterals, tetrahedra or hexahedra of any geometric degree; a rank
    may own no facets of Γc. The constructor is collective.

    Args:
        mesh: Mesh of the body, topological dimension 2 or 3.
        facet_tags: Tags on the facets of ``mesh``.
        tags: Tag or tags of the facets of Γc.
        quadrature_degree: Degree of the quadrature rule on Γc, at least 2. By default twice the
            degree of the displacement element. It is raised, up to degree 78 in the plane and 6 in
            space, on facets longer than a quarter of the smallest radius of a `Ball`, `Cylinder` or
            `RigidProfile`, and on facets longer than those of an opposing `DeformableBody` (with
            small displacements: 6 times as long), to resolve their shape. If that is not enough,
            `ContactProblem` warns.
        quadrature_scheme: "default" (Gauss), or "vertex": one point per facet vertex. By default
            Gauss; vertices for multipliers of linear elements on a rigid obstacle, if
            ``quadrature_degree`` is not given, the facets are edges or triangles and the contact's
            weight is constant.

    Attributes:
        mesh: The mesh of the body.
        facets: Facets of Γc owned by this rank, shape (n_facets,).
        submesh: Mesh of Γc, on which the history is defined.
        entity_maps: Entity maps with which ``dolfinx.fem.form`` compiles functions of ``submesh``
            in integrals over ``mesh``.

    Raises:
        ValueError: The dimension is wrong, no facet has a tag, or an interior facet has one.
    """

    def __init__(
        self,
        mesh: dolfinx.mesh.Mesh,
        facet_tags: dolfinx.mesh.MeshTags,
        tags: int | Sequence[int],
        *,
        quadrature_degree: int | None = None,
        quadrature_scheme: str | None = None,
    ) -> None:
        if quadrature_scheme is not None and quadrature_scheme not in _SCHEMES:
            raise ValueError(f"quadrature_scheme is {quadrature_scheme!r}; use one of {_SCHEMES}")
        whole = is_number(quadrature_degree) and isinstance(quadrature_degree, Integral)
        if quadrature_degree is not None and not (whole and quadrature_degree >= 2):
            raise ValueError(
                f"quadrature_degree is {quadrature_degree!r}; it must be an integer, at least 2: "
                "a facet with one point can tilt about it into the obstacle without resistance"
            )
        self.mesh = mesh
        self.facets = tagged_facets(mesh, facet_tags, tags)
        self.quadrature_degree = quadrature_degree
        self.quadrature_scheme = quadrature_scheme
        self.submesh, self.entity_maps, self._parent_facets = compat.create_facet_submesh(
            mesh, self.facets
        )
        self._facet_tags = facet_tags
        # All nodes, as a linear bulk is of all of them: compared they take a tenth of the time of a
        # hash, and tell how far they were moved.
        self._places = mesh.geometry.x.copy()
        self._ids = tuple(int(tag) for tag in np.unique(np.atleast_1d(np.asarray(tags))))

    def quadrature(
        self,
        element_degree: int,
        *,
        nodal: bool = False,
        opposite: Indices | None = None,
        pieces: bool = False,
        radius: float = np.inf,
    ) -> SurfaceQuadrature:
        """Return the quadrature rule on Γc for a displacement element. Collective.

        Args:
            element_degree: Degree of the displacement element.
            nodal: Whether vertices are preferred, if the user has not chosen a rule and one
                point per node resolves the obstacle.
            opposite: This rank's facets of the opposing body, which the rule has to resolve; None:
                a rigid obstacle.
            pieces: Whether pairs are integrated piece by piece over the opposite facets. The rule
                is then refined only from `_PIERCING` opposite facets per facet of Γc on.
            radius: Smallest radius of curvature of a rigid obstacle, which the rule has to resolve
                (length).
        """
        degree = self.quadrature_degree or SurfaceQuadrature.default_degree(element_degree)
        if self.quadrature_degree is None and radius < np.inf:
            per_node = self._points_per_node(radius)
            nodal = nodal and per_node <= 1
            wanted = 2 * (per_node * element_degree - 1)
            degree = max(degree, min(wanted, FINEST_RULE[self.mesh.geometry.dim]))
        free = self.quadrature_degree is None and self.quadrature_scheme is None
        scheme = "vertex" if nodal and free else self.quadrature_scheme or "default"
        sparse = None
        if opposite is not None and self.quadrature_degree is None:
            dim = self.mesh.geometry.dim
            coarser = self._times_as_coarse(opposite, across=dim == 3 and not pieces)
            if pieces and coarser < _PIERCING:
                coarser = 1
            wanted = coarser * (degree + 2) - 2
            degree = max(degree, min(wanted, FINEST_RULE[dim]))
            nodes_per_point = coarser * element_degree / (degree // 2 + 1)
            few = dim == 3 and not pieces and nodes_per_point > _NODES_PER_POINT
            if few and scheme == "default":
                sparse = Sparse(coarser, wanted)
        return SurfaceQuadrature(self, degree, scheme, sparse)

    def _points_per_node(self, radius: float) -> int:
        """Points along a facet of median length for a radius of the obstacle. Collective.

        See `POINTS_PER_RADIUS`.
        """
        lengths = gather_rows(self.mesh.comm, self._spreads(self.facets)[:, 3:4])
        return int(np.ceil(POINTS_PER_RADIUS * np.median(lengths) / radius - NEGLIGIBLE))

    def _times_as_coarse(self, opposite: Indices, *, across: bool) -> int:
        """How many facets of the opposite surface are as long as one of Γc, at least 1. Collective.

        By the medians of both, in the undeformed bodies; or where they are most under one of Γc.

        Args:
            opposite: This rank's.
            across: Whether to count long and narrow ones across, in space.
        """
        comm = self.mesh.comm
        sides = [gather_rows(comm, self._spreads(facets)) for facets in (self.facets, opposite)]
        if not all(map(len, sides)):
            return 1
        (middle, ours), (others, theirs) = ((side[:, :3], side[:, 3]) for side in sides)
        times = float(np.median(ours) / np.median(theirs))
        graded = _most_under_one(middle, ours, others, theirs)
        times = graded if graded > _GRADED * times else times
        if across:
            wide = self._times_as_wide(*sides)
            times = wide if wide > _NARROW * times else times
        return max(1, round(times))

    def _times_as_wide(self, here: Array, there: Array) -> float:
        """How many opposite facets are as long as one of Γc where they are most, in space.

        The median over Γc, of each with the facet that is closest to it.

        Args:
            here: Of all ranks, `_spreads` of Γc.
            there: Those of the opposite facets.
        """
        (middle, own), (others, theirs) = (
            (rows[:, :3], rows[:, 4:].reshape(-1, 3, 3)) for rows in (here, there)
        )
        _, closest = scipy.spatial.cKDTree(others).query(middle)
        (_, axes), (_, other_axes) = np.linalg.eigh(own), np.linalg.eigh(theirs)
        # The first axis is the normal.
        facing = np.einsum("fi,fi->f", axes[:, :, 0], other_axes[closest, :, 0]) ** 2 > _FACING
        if not facing.any():
            return 1.0
        plane = axes[facing, :, 1:]
        spreads = own[facing], theirs[closest][facing]
        ours, opposed = (np.einsum("fia,fij,fjb->fab", plane, m, plane) for m in spreads)
        most = np.linalg.eigvals(np.linalg.solve(opposed, ours)).real.max(axis=1)
        return float(np.sqrt(np.median(most)))

    def _spreads(self, facets: Indices) -> Array:
        """Of facets middles, lengths, and Σ (x - middle)(x - middle)ᵀ over corners, (n, 13)."""
        if not len(facets):  # for which DOLFINx ends in a segmentation fault
            return np.zeros((0, 13))
        mesh, dim = self.mesh, self.mesh.topology.dim - 1
        facets = np.asarray(facets, dtype=np.int32)
        nodes = dolfinx.mesh.entities_to_geometry(mesh, dim, facets)
        corners = mesh.geometry.x[nodes.reshape(len(facets), -1)]
        middle = corners.mean(axis=1)
        arms = corners - middle[:, None]
        spread = np.einsum("fki,fkj->fij", arms, arms)
        return np.hstack([middle, mesh.h(dim, facets)[:, None], spread.reshape(-1, 9)])

    def check_places(self, name: str) -> None:
        """Check that the nodes of the mesh have not been moved. Collective.

        Points, weights, gaps and the tangent of a linear bulk are computed once.

        Raises:
            ValueError: Nodes have been moved; raised on all ranks.
        """
        x, comm = self.mesh.geometry.x, self.mesh.comm
        if comm.allreduce(int(not np.array_equal(x, self._places))):
            way = global_max(comm, np.abs(x - self._places))
            raise ValueError(
                f"{name}: nodes of the mesh have been moved, by up to {way:g}, since its "
                "ContactSurface was created; do not move the mesh, displacements are in u (with "
                'kinematics="finite" of any size), or create surface, contacts and problem again'
            )

    def parent_facets(self) -> npt.NDArray[np.int32]:
        """Return the facet of the body of every cell of the submesh owned by this rank."""
        topology = self.submesh.topology
        return self._parent_facets[: topology.index_map(topology.dim).size_local]

    def measure(self, degree: int, scheme: str = "default") -> ufl.Measure:
        """Return the surface measure of Γc with a quadrature rule."""
        metadata = {"quadrature_degree": degree, "quadrature_rule": scheme}
        # The caller's own tags: forms on one mesh must agree in them to be added.
        return ufl.Measure(
            "ds",
            domain=self.mesh,
            subdomain_data=self._facet_tags,
            subdomain_id=self._ids,
            metadata=metadata,
        )


def tagged_facets(
    mesh: dolfinx.mesh.Mesh, facet_tags: dolfinx.mesh.MeshTags, tags: int | Sequence[int]
) -> npt.NDArray[np.int32]:
    """Owned exterior facets with the tags, ascending. Collective.

    Raises:
        ValueError: Wrong dimension, tags of another mesh, a tag that no facet has, an interior
            facet with the tag.
    """
    check_instance("mesh", mesh, dolfinx.mesh.Mesh)
    check_instance("facet_tags", facet_tags, dolfinx.mesh.MeshTags)
    wanted = np.unique(np.asarray(tags))
    if wanted.size and wanted.dtype.kind not in "iu":
        raise ValueError(f"tags is {tags!r}; it must be an integer, or a list of integers")
    wanted = wanted.astype(np.int32)
    tdim = mesh.topology.dim
    if tdim not in (2, 3) or mesh.geometry.dim != tdim:
        raise ValueError(
            f"mesh has topological dimension {tdim} in a space of dimension "
            f"{mesh.geometry.dim}; both must be 2, or both 3"
        )
    check_cells("mesh", mesh.topology.cell_name())
    if facet_tags.dim != tdim - 1:
        raise ValueError(
            f"facet_tags are on entities of dimension {facet_tags.dim}; a mesh of dimension "
            f"{tdim} has facets of dimension {tdim - 1}: pass its facet tags, not its cell tags"
        )

    if not compat.entities_of(facet_tags, mesh):
        raise ValueError(
            "facet_tags are of another mesh, whose facets have other numbers: use tags that were "
            "created on, or read with, the mesh of u"
        )
    mesh.topology.create_connectivity(tdim - 1, tdim)
    exterior = dolfinx.mesh.exterior_facet_indices(mesh.topology)
    n_owned = mesh.topology.index_map(tdim - 1).size_local
    tagged = np.unique(facet_tags.indices[np.isin(facet_tags.values, wanted)])
    tagged = tagged[tagged < n_owned]
    interior = np.setdiff1d(tagged, exterior)
    present = np.unique(gather_rows(mesh.comm, np.unique(facet_tags.values)))
    missing = np.setdiff1d(wanted, present)
    if missing.size:
        raise ValueError(
            f"no facet has the tag {missing.tolist()}; the tags on this mesh are {present.tolist()}"
        )
    n_interior = mesh.comm.allreduce(interior.size)
    if n_interior:
        raise ValueError(
            f"{n_interior} of the facets tagged {wanted.tolist()} are interior facets; Γc must be "
            "a part of the boundary: tag exterior facets only"
        )
    if mesh.comm.allreduce(tagged.size) == 0:
        raise ValueError(f"Γc is empty: no exterior facet has a tag in {wanted.tolist()}")
    return tagged.astype(np.int32)


@dataclass(frozen=True)
class Sparse:
    """Insufficient resolution of the opposite facets by the quadrature points of Γc.

    Attributes:
        times: Number of opposite facets along a facet of Γc.
        degree: Degree of a rule that would resolve them.
    """

    times: int
    degree: int


class SurfaceQuadrature:
    """A quadrature rule on Γc, its function spaces and its weights; the constructor is collective.

    Attributes:
        surface: The `ContactSurface`.
        sparse: The insufficient resolution of a rule that was chosen by default, or None.
        asked: Whether the user has chosen the rule.
        degree: Polynomial degree of the rule.
        ds: The measure of Γc with this rule.
        at_vertices: Whether the points are those of the rule "vertex".
        n_points: Quadrature points that this rank owns.
        weights: Weight times surface Jacobian of the owned points, shape (n_points,), in
            length^(gdim-1).
        weights_with_ghosts: Those of all points that this rank knows.
    """

    def __init__(
        self, surface: ContactSurface, degree: int, scheme: str, sparse: Sparse | None = None
    ) -> None:
        if scheme == "vertex":
            degree = 1  # the rule of the vertices has no other
        self.surface, self.sparse = surface, sparse
        self.asked = surface.quadrature_degree is not None or surface.quadrature_scheme == "vertex"
        self.degree = degree
        self.ds = surface.measure(degree, scheme)
        self._cell = surface.submesh.topology.cell_name()
        self.at_vertices = scheme == "vertex"
        self._points_and_weights = _vertex_rule(self._cell) if self.at_vertices else None
        self._spaces: dict[int | None, fem.FunctionSpace] = {}
        space = self.space()
        self.weights_with_ghosts = self._weigh(self.ds)
        self.n_points = space.dofmap.index_map.size_local
        self.weights = self.weights_with_ghosts[: self.n_points]

    def _weigh(self, measure: ufl.Measure) -> Array:
        """Weight times Jacobian of all points that this rank knows. Collective."""
        space = self.space()
        form = compile_form(ufl.TestFunction(space) * measure, self.surface.entity_maps)
        return assembled(form, la.vector(space.dofmap.index_map, 1))

    @cached_property
    def on_submesh(self) -> tuple[ufl.Measure, Array]:
        """The measure of Γc as a mesh of its own, and `_weigh` by it. Collective."""
        measure = ufl.Measure("dx", self.surface.submesh, metadata=self.ds.metadata())
        return measure, self._weigh(measure)

    @staticmethod
    def default_degree(element_degree: int) -> int:
        """Return degree 2p, exact for the work of tractions of degree p on a closed facet."""
        return 2 * max(1, element_degree)

    def space(self, size: int | None = None) -> fem.FunctionSpace:
        """Space of functions at the points, scalar or with ``size`` components, made once."""
        if size not in self._spaces:
            shape = () if size is None else (size,)
            points, weights = self._points_and_weights or (None, None)
            with printed_as_ever():
                element = basix.ufl.quadrature_element(
                    self._cell,
                    value_shape=shape,
                    points=points,
                    weights=weights,
                    degree=self.degree,
                )
            self._spaces[size] = fem.functionspace(self.surface.submesh, element)
        return self._spaces[size]

    @cached_property
    def point_rows(self) -> npt.NDArray[np.int32]:
        """Points of every facet of this rank, (n_facets, n_points_per_facet).

        Row i is that of ``surface.facets[i]``.
        """
        parents = self.surface.parent_facets()
        return self.space().dofmap.list[: parents.size][np.argsort(parents)]

    @cached_property
    def facet_sizes(self) -> Array:
        """Length of the point's facet, in space the root of its area, (n_points,) (length)."""
        rows, sizes = self.point_rows, np.empty(self.n_points)
        areas = self.weights[rows].sum(axis=1)
        sizes[rows] = areas[:, None] ** (1.0 / (self.surface.mesh.geometry.dim - 1))
        return sizes

    def interpolation_matrix(self, space: fem.FunctionSpace) -> PETSc.Mat:
        """Sparse matrix from the dofs of a function to its values at the points. Collective.

        Args:
            space: On the mesh of the body or on the submesh; scalar (d = 1), or vector-valued with
                block size d.

        Returns:
            Matrix with d rows per point, (d n_points, n_dofs).
        """
        scalar = not space.ufl_element().reference_value_shape
        values = self.space(None if scalar else space.dofmap.bs)
        form = compile_form(
            ufl.inner(ufl.TrialFunction(space), ufl.TestFunction(values)) * self.ds,
            self.surface.entity_maps,
        )
        matrix = fem.petsc.assemble_matrix(form)
        matrix.assemble()
        inverse = matrix.createVecLeft()
        inverse.array[:] = np.repeat(1.0 / self.weights, space.dofmap.bs)
        matrix.diagonalScale(inverse, None)
        inverse.destroy()
        return matrix


class VertexAreas:
    """The area that each vertex of Γc stands for in the rule "vertex".

    The constructor is collective.

    Args:
        quadrature: The rule.
        weight: Factor w of the surface measure.

    Attributes:
        area: Continuous function of degree 1 on the submesh of Γc, ∫ w v ds with v the function of
            the vertex (length^(gdim-1) times the unit of the weight).

    Raises:
        ValueError: The rule is another one, or an area is not positive.
    """

    def __init__(
        self, quadrature: SurfaceQuadrature, weight: ufl.core.expr.Expr, name: str
    ) -> None:
        surface = quadrature.surface
        if surface.quadrature_scheme != "vertex":
            raise ValueError(
                f"{name}: NodalSprings act at the vertices of Γc, but quadrature_scheme is "
                f"{surface.quadrature_scheme or 'default'!r}; create the ContactSurface with "
                'quadrature_scheme="vertex", or give the stiffness per area'
            )
        self._name = name
        self._comm = surface.mesh.comm
        space = fem.functionspace(surface.submesh, ("Lagrange", 1))
        self.area = fem.Function(space, name="area")
        self._form = compile_form(
            weight * ufl.TestFunction(space) * quadrature.ds, surface.entity_maps
        )
        self.update()

    def update(self) -> None:
        """Measure again, with the weight as it is now. Collective.

        Raises:
            ValueError: The area of a vertex is not positive.
        """
        assembled(self._form, self.area.x)
        smallest = global_min(self._comm, self.area.x.array, empty=1.0)
        if not smallest > 0.0:
            raise ValueError(
                f"{self._name}: the area of a vertex of Γc is {smallest:g}, including the weight; "
                "NodalSprings need a positive one: check the weight (2πr is zero on the axis), "
                "or give the stiffness per area"
            )


class PointEvaluator:
    """Evaluates named UFL expressions at the quadrature points of Γc, all in one compiled form.

    By assembly, ∫ e q ds / ∫ q ds with q the test function of the quadrature space: exact for any
    orientation of the facets, which the evaluation of expressions on facets is not in every
    release of DOLFINx. The constructor is collective, and compiles the form.

    Args:
        expressions: Scalars and vectors by name.
        by_points: Whether they are of functions at the points and of nothing else: then the
            form knows Γc alone, and is the same on all bodies with facets of this kind.

    Attributes:
        form: What is assembled (UFL).
    """

    def __init__(
        self,
        quadrature: SurfaceQuadrature,
        expressions: Mapping[str, ufl.core.expr.Expr],
        *,
        by_points: bool = False,
    ) -> None:
        components: list[ufl.core.expr.Expr] = []
        self._columns: dict[str, int | slice] = {}
        for name, expression in expressions.items():
            expression = ufl.as_ufl(expression)
            start = len(components)
            if expression.ufl_shape == ():
                components.append(expression)
                self._columns[name] = start
            else:
                components += [expression[i] for i in range(expression.ufl_shape[0])]
                self._columns[name] = slice(start, len(components))
        self._size = len(components)
        space = quadrature.space(self._size)
        test = ufl.TestFunction(space)
        measure, self._weights = quadrature.ds, quadrature.weights_with_ghosts
        if by_points:
            measure, self._weights = quadrature.on_submesh
        self.form = ufl.inner(ufl.as_vector(components), test) * measure
        maps = None if by_points else quadrature.surface.entity_maps
        self._compiled = compile_form(self.form, maps)
        self._vector = la.vector(space.dofmap.index_map, self._size)
        self._n_owned = quadrature.n_points

    def __call__(self) -> dict[str, Array]:
        """The values at the owned points by name, shape (n_points,) or (n_points, d). Collective.

        The arrays are copies.
        """
        weighted = assembled(self._compiled, self._vector).reshape(-1, self._size)
        with np.errstate(invalid="ignore", divide="ignore"):
            values = weighted / self._weights[:, None]
        return {name: values[: self._n_owned, c].copy() for name, c in self._columns.items()}


def _most_under_one(middle: Array, ours: Array, others: Array, theirs: Array) -> float:
    """How many facets opposite are as long as one of Γc, where they are most.

    Under a facet are the one that is closest to it, and all to which it is the closest and that are
    no farther from it than that by half of its length; their median counts, as one alone may be a
    sliver.

    Args:
        middle: Of all facets of Γc, (n, 3) (length).
        ours: Their lengths, (n,).
        others: Middles opposite, (m, 3).
        theirs: Their lengths, (m,).
    """
    nearest, first = scipy.spatial.cKDTree(others).query(middle)
    distance, owner = scipy.spatial.cKDTree(middle).query(others)
    under = distance <= nearest[owner] + ours[owner] / 2
    facet = np.concatenate([np.arange(len(middle)), owner[under]])
    other = np.concatenate([first, np.flatnonzero(under)])
    facet, other = np.unique(np.column_stack([facet, other]), axis=0).T
    order = np.lexsort((theirs[other], facet))
    _, start, count = np.unique(facet, return_index=True, return_counts=True)
    median = theirs[other[order]][start + (count - 1) // 2]
    return float(np.max(ours / median))


def _vertex_rule(cell: str) -> tuple[Array, Array]:
    """Points and weights of the rule "vertex" as the form compiler has it."""
    points = basix.geometry(basix.CellType[cell])
    volume = {"interval": 1.0, "triangle": 0.5, "quadrilateral": 1.0}[cell]
    return points, np.full(len(points), volume / len(points))
