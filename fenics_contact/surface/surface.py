"""The contact surface Γc: its facets, their submesh and the quadrature points."""

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
from fenics_contact.compiling import compile_form, default_print_options
from fenics_contact.parallel import gather_rows, global_max, global_min
from fenics_contact.surface.mass import assemble_values
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
# Ratio of slave to master facet length from which on segmented pairs need a finer rule. Force of a
# 2D block with p + 1 points per slave facet relative to that with as many per master facet, by
# length ratio: 2: 0.98, 3: 0.91, 4: 0.96, 5: 0.83, 10: 0.59, 40: 0.5; with segmented integration
# 2: 0.99, 3: 0.97, 4: 1.01, 5: 1.00, 10: 0.61, 40: 0.54.
_REFINED_LENGTH_RATIO = 6
# Largest default degree by dimension: 40 points per facet in 2D, 16 in 3D, where segmented pairs
# take 0.6, 2 and 15 ms per master facet at degree 2, 6 and 14.
FINEST_RULE = {2: 78, 3: 6}
# Largest number of master nodes per point along a slave facet without segmentation. Ratio of the
# force between 3D blocks with that rule to that with the finer side as slave, by element degree and
# length ratio, for 1 and 2 x 2 slave facets:
#     hexahedra, 1:  5: 0.995 and 0.998, 6: 0.83 and 0.93, 7: 0.95 and 0.98, 8: 0.93 and 0.98;
#     hexahedra, 2:  2: 0.98 and 0.99, 3: 0.74 and 0.87, 4: 0.88, 5: 0.79;
#     tetrahedra, 1: 5: 0.993 and 0.997, 6: 0.97 and 0.99, 8: 0.93;
#     tetrahedra, 2: 2: 1.00 and 1.00, 3: 0.97 and 0.99, 4: 0.91.
# In 2D it is at least 0.997 up to a ratio of 200; with segmentation the error is below 1e-4.
_MAX_NODES_PER_POINT = 1.25
# Factor by which the width ratio of anisotropic facets must exceed the length ratio to be used;
# right angles in triangles alone cause 1.7.
_ANISOTROPY_RATIO = 2.0
# Factor by which the local length ratio must exceed the median one to be used: graded meshes.
_GRADING_RATIO = 1.5
# Smallest number of points of Γc per smallest radius of a rigid obstacle, times the element degree.
# A cylinder of radius R is pressed 0.3 R into rubber and slides. Ratio of the force to that with 8
# times as many points, and its oscillation (8 and 16 % by the mesh), by facet length h and point
# spacing in R:
#     h = R:   1/2: 0.986 and 3 %, 1/3: 0.998 and 10 %, 1/4: 1.000 and 8 %;
#     h = 2 R: 1: 0.82 and 37 %, 2/3: 0.96 and 27 %, 1/2: 0.99 and 17 %, 1/3: 1.000 and 16 %;
# with nodal multipliers 0.68 at h = R and 0.91 at h = R / 2.
POINTS_PER_RADIUS = 4
# Smallest squared cosine of the angle between the normals of facing facets.
_MIN_FACING_COSINE_SQUARED = 0.5


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
        is_integer = is_number(quadrature_degree) and isinstance(quadrature_degree, Integral)
        if quadrature_degree is not None and not (is_integer and quadrature_degree >= 2):
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
        # Comparison takes a tenth of the time of a hash, and yields the distance.
        self._coordinates = mesh.geometry.x.copy()
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
            pieces: Whether pairs are integrated over segments of the opposing facets. The rule is
                then refined only from `_REFINED_LENGTH_RATIO` opposing facets per facet of Γc on.
            radius: Smallest radius of curvature of a rigid obstacle, which the rule has to resolve
                (length).
        """
        degree = self.quadrature_degree or SurfaceQuadrature.default_degree(element_degree)
        if self.quadrature_degree is None and radius < np.inf:
            per_node = self._points_per_node(radius)
            nodal = nodal and per_node <= 1
            wanted = 2 * (per_node * element_degree - 1)
            degree = max(degree, min(wanted, FINEST_RULE[self.mesh.geometry.dim]))
        is_default = self.quadrature_degree is None and self.quadrature_scheme is None
        scheme = "vertex" if nodal and is_default else self.quadrature_scheme or "default"
        sparse = None
        if opposite is not None and self.quadrature_degree is None:
            dim = self.mesh.geometry.dim
            ratio = self._length_ratio(opposite, widths=dim == 3 and not pieces)
            if pieces and ratio < _REFINED_LENGTH_RATIO:
                ratio = 1
            wanted = ratio * (degree + 2) - 2
            degree = max(degree, min(wanted, FINEST_RULE[dim]))
            nodes_per_point = ratio * element_degree / (degree // 2 + 1)
            is_sparse = dim == 3 and not pieces and nodes_per_point > _MAX_NODES_PER_POINT
            if is_sparse and scheme == "default":
                sparse = Sparse(ratio, wanted)
        return SurfaceQuadrature(self, degree, scheme, sparse)

    def _points_per_node(self, radius: float) -> int:
        """Return the points needed along a facet by `POINTS_PER_RADIUS`. Collective."""
        lengths = gather_rows(self.mesh.comm, self._moments(self.facets)[:, 3:4])
        return int(np.ceil(POINTS_PER_RADIUS * np.median(lengths) / radius - NEGLIGIBLE))

    def _length_ratio(self, opposite: Indices, *, widths: bool) -> int:
        """Return the ratio of the facet lengths of Γc and of the opposing surface. Collective.

        It is the ratio of the undeformed medians, or the largest local one, rounded, at least 1.

        Args:
            opposite: This rank's facets of the opposing surface.
            widths: Whether to compare the widths of anisotropic facets, in 3D.
        """
        comm = self.mesh.comm
        sides = [gather_rows(comm, self._moments(facets)) for facets in (self.facets, opposite)]
        if not all(map(len, sides)):
            return 1
        (middle, ours), (others, theirs) = ((side[:, :3], side[:, 3]) for side in sides)
        ratio = float(np.median(ours) / np.median(theirs))
        local_ratio = _largest_local_ratio(middle, ours, others, theirs)
        ratio = local_ratio if local_ratio > _GRADING_RATIO * ratio else ratio
        if widths:
            width_ratio = self._width_ratio(*sides)
            ratio = width_ratio if width_ratio > _ANISOTROPY_RATIO * ratio else ratio
        return max(1, round(ratio))

    def _width_ratio(self, slave: Array, master: Array) -> float:
        """Return the median over Γc of the largest directional size ratio of facets in 3D.

        Args:
            slave: `_moments` of Γc on all ranks.
            master: `_moments` of the opposing surface on all ranks.
        """
        (middle, own), (others, theirs) = (
            (rows[:, :3], rows[:, 4:].reshape(-1, 3, 3)) for rows in (slave, master)
        )
        _, closest = scipy.spatial.cKDTree(others).query(middle)
        (_, axes), (_, other_axes) = np.linalg.eigh(own), np.linalg.eigh(theirs)
        # The first axis is the normal.
        facing = (
            np.einsum("fi,fi->f", axes[:, :, 0], other_axes[closest, :, 0]) ** 2
            > _MIN_FACING_COSINE_SQUARED
        )
        if not facing.any():
            return 1.0
        plane = axes[facing, :, 1:]
        moments = own[facing], theirs[closest][facing]
        ours, opposing = (np.einsum("fia,fij,fjb->fab", plane, m, plane) for m in moments)
        largest = np.linalg.eigvals(np.linalg.solve(opposing, ours)).real.max(axis=1)
        return float(np.sqrt(np.median(largest)))

    def _moments(self, facets: Indices) -> Array:
        """Return facet centres c, lengths and Σ (x - c)(x - c)ᵀ over corners, (n, 13)."""
        if not len(facets):  # mesh.h of DOLFINx crashes
            return np.zeros((0, 13))
        mesh, dim = self.mesh, self.mesh.topology.dim - 1
        facets = np.asarray(facets, dtype=np.int32)
        nodes = dolfinx.mesh.entities_to_geometry(mesh, dim, facets)
        corners = mesh.geometry.x[nodes.reshape(len(facets), -1)]
        middle = corners.mean(axis=1)
        arms = corners - middle[:, None]
        moment = np.einsum("fki,fkj->fij", arms, arms)
        return np.hstack([middle, mesh.h(dim, facets)[:, None], moment.reshape(-1, 9)])

    def check_places(self, name: str) -> None:
        """Check that mesh coordinates are unchanged, as geometry is computed once. Collective.

        Raises:
            ValueError: Nodes have been moved; raised on all ranks.
        """
        x, comm = self.mesh.geometry.x, self.mesh.comm
        if comm.allreduce(int(not np.array_equal(x, self._coordinates))):
            distance = global_max(comm, np.abs(x - self._coordinates))
            raise ValueError(
                f"{name}: nodes of the mesh have been moved, by up to {distance:g}, since its "
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
        # The user's tags: forms can be added only if they have the same subdomain data.
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
    """Return owned exterior facets with the tags, ascending. Collective.

    Raises:
        ValueError: The dimension is wrong, the tags are of another mesh, no facet has a tag, or an
            interior facet has one.
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
        times: Number of opposing facets along a facet of Γc.
        degree: Degree of a rule that would resolve them.
    """

    times: int
    degree: int


class SurfaceQuadrature:
    """A quadrature rule on Γc, its function spaces and its weights; the constructor is collective.

    Attributes:
        surface: The `ContactSurface`.
        sparse: Insufficient resolution of a default rule, or None.
        asked: Whether the rule was chosen by the user.
        degree: Polynomial degree of the rule.
        ds: The measure of Γc with this rule.
        at_vertices: Whether the rule is "vertex".
        n_points: Number of quadrature points owned by this rank.
        weights: Weight times surface Jacobian of the owned points, (n_points,) (length^(gdim-1)).
        weights_with_ghosts: Weights including those of ghost points.
    """

    def __init__(
        self, surface: ContactSurface, degree: int, scheme: str, sparse: Sparse | None = None
    ) -> None:
        if scheme == "vertex":
            degree = 1
        self.surface, self.sparse = surface, sparse
        self.asked = surface.quadrature_degree is not None or surface.quadrature_scheme == "vertex"
        self.degree = degree
        self.ds = surface.measure(degree, scheme)
        self._cell = surface.submesh.topology.cell_name()
        self.at_vertices = scheme == "vertex"
        self._points_and_weights = _vertex_rule(self._cell) if self.at_vertices else None
        self._spaces: dict[int | None, fem.FunctionSpace] = {}
        space = self.space()
        self.weights_with_ghosts = self._compute_weights(self.ds)
        self.n_points = space.dofmap.index_map.size_local
        self.weights = self.weights_with_ghosts[: self.n_points]

    def _compute_weights(self, measure: ufl.Measure) -> Array:
        """Return weight times Jacobian of all points, ghosts included. Collective."""
        space = self.space()
        form = compile_form(ufl.TestFunction(space) * measure, self.surface.entity_maps)
        return assemble_values(form, la.vector(space.dofmap.index_map, 1))

    @cached_property
    def on_submesh(self) -> tuple[ufl.Measure, Array]:
        """Cell measure of the submesh and weights of all points. Collective."""
        measure = ufl.Measure("dx", self.surface.submesh, metadata=self.ds.metadata())
        return measure, self._compute_weights(measure)

    @staticmethod
    def default_degree(element_degree: int) -> int:
        """Return degree 2p, exact for the work of tractions of degree p."""
        return 2 * max(1, element_degree)

    def space(self, size: int | None = None) -> fem.FunctionSpace:
        """Return the quadrature space, scalar or with ``size`` components, cached."""
        if size not in self._spaces:
            shape = () if size is None else (size,)
            points, weights = self._points_and_weights or (None, None)
            with default_print_options():
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
        """Points of every facet of ``surface.facets``, (n_facets, n_points_per_facet)."""
        parents = self.surface.parent_facets()
        return self.space().dofmap.list[: parents.size][np.argsort(parents)]

    @cached_property
    def facet_sizes(self) -> Array:
        """Length of the point's facet, in 3D the root of its area, (n_points,) (length)."""
        rows, sizes = self.point_rows, np.empty(self.n_points)
        areas = self.weights[rows].sum(axis=1)
        sizes[rows] = areas[:, None] ** (1.0 / (self.surface.mesh.geometry.dim - 1))
        return sizes

    def interpolation_matrix(self, space: fem.FunctionSpace) -> PETSc.Mat:
        """Assemble the interpolation matrix from dofs to values at the points. Collective.

        Args:
            space: Scalar space (d = 1) or vector-valued space of block size d on the mesh or the
                submesh.

        Returns:
            Matrix, (d n_points, n_dofs).
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
    """Tributary areas of the vertices of Γc in the rule "vertex".

    The constructor is collective.

    Args:
        quadrature: The rule.
        weight: Factor w of the surface measure.

    Attributes:
        area: Function of degree 1 on the submesh of Γc, ∫ w φ ds with φ the basis function of the
            vertex (length^(gdim-1) times the unit of the weight).

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
        """Recompute the areas with the present weight. Collective.

        Raises:
            ValueError: The area of a vertex is not positive.
        """
        assemble_values(self._form, self.area.x)
        smallest = global_min(self._comm, self.area.x.array, empty=1.0)
        if not smallest > 0.0:
            raise ValueError(
                f"{self._name}: the area of a vertex of Γc is {smallest:g}, including the weight; "
                "NodalSprings need a positive one: check the weight (2πr is zero on the axis), "
                "or give the stiffness per area"
            )


class PointEvaluator:
    """Evaluation of named UFL expressions at the quadrature points of Γc by one compiled form.

    Values are ∫ e q ds / ∫ q ds with q the test function of the quadrature space. Unlike
    `fem.Expression` on facets this is independent of their orientation in all releases of DOLFINx.
    The constructor is collective, and compiles the form.

    Args:
        expressions: Scalars and vectors by name.
        by_points: Whether the expressions contain quadrature functions only. The form is then
            defined on the submesh, and compiled once per type of facet.

    Attributes:
        form: Assembled UFL form.
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
        """Return copies of the values at the owned points by name. Collective.

        Shapes are (n_points,) for scalars and (n_points, d) for vectors.
        """
        weighted = assemble_values(self._compiled, self._vector).reshape(-1, self._size)
        with np.errstate(invalid="ignore", divide="ignore"):
            values = weighted / self._weights[:, None]
        return {name: values[: self._n_owned, c].copy() for name, c in self._columns.items()}


def _largest_local_ratio(
    centre: Array, length: Array, master_centre: Array, master_length: Array
) -> float:
    """Return the largest local length ratio of facets of Γc and opposing ones.

    A facet of Γc is compared with the median of its nearest opposing facet and of those to which it
    is the nearest, if these are not farther away by more than half its length.

    Args:
        centre: Centres of all facets of Γc, (n, 3) (length).
        length: Their lengths, (n,).
        master_centre: Centres of the opposing facets, (m, 3) (length).
        master_length: Their lengths, (m,).
    """
    nearest, first = scipy.spatial.cKDTree(master_centre).query(centre)
    distance, owner = scipy.spatial.cKDTree(centre).query(master_centre)
    is_near = distance <= nearest[owner] + length[owner] / 2
    facet = np.concatenate([np.arange(len(centre)), owner[is_near]])
    other = np.concatenate([first, np.flatnonzero(is_near)])
    facet, other = np.unique(np.column_stack([facet, other]), axis=0).T
    order = np.lexsort((master_length[other], facet))
    _, start, count = np.unique(facet, return_index=True, return_counts=True)
    median = master_length[other[order]][start + (count - 1) // 2]
    return float(np.max(length / median))


def _vertex_rule(cell: str) -> tuple[Array, Array]:
    """Return points and weights of the rule "vertex" as defined by FFCx."""
    points = basix.geometry(basix.CellType[cell])
    volume = {"interval": 1.0, "triangle": 0.5, "quadrilateral": 1.0}[cell]
    return points, np.full(len(points), volume / len(points))
