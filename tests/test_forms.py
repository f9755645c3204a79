"""Bulk forms as users write them: over tags of every kind, of two materials, and in time.

A form over tags has the solution of one with coefficients by cell, to 1e-9: the solver's 1e-13 of
the forces, with a margin for the condition of the tangent. The contact stiffness is the default, a
multiple of E/h with the E derived from the form.
"""

import basix.ufl
import dolfinx
import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

import fenics_contact as fc
from fenics_contact.elasticity import LinearElastic, NeoHookean
from scenes.blocks import BOTTOM, LEFT, RIGHT, TOP, block_mesh
from scenes.comparison import assert_raised_on_all_ranks, is_close, nodal_values, point_values
from scenes.elasticity import dirichlet_bc, displacement_space, strain, stress

pytestmark = [
    pytest.mark.newest,
    pytest.mark.two_ranks,
    pytest.mark.timeout(240),
]
COMM = MPI.COMM_WORLD
TIGHT = {"snes_rtol": 1e-13}
LOWER, UPPER = 1, 2
# By tag: Young's modulus, and the force per volume to the side.
E, PULL = {LOWER: 1000.0, UPPER: 4000.0}, {LOWER: 0.0, UPPER: 0.2}
NU = 0.3


class Layers:
    """A block of two layers with tagged cells and facets, pressed onto a floor by a pressure.

    Attributes:
        dx, ds: Measures with the tags.
        E, pull: Coefficients by cell; their form with measures without tags is the reference.
    """

    def __init__(self, element=None, **mesh_arguments):
        """Make mesh, tags and functions; ``element`` is that of a mixed function, if any."""
        self.mesh, self.facets = block_mesh("quadrilateral", n=4, **mesh_arguments)
        d = self.mesh.topology.dim
        cells = np.arange(self.mesh.topology.index_map(d).size_local, dtype=np.int32)
        middle = dolfinx.mesh.compute_midpoints(self.mesh, d, cells)[:, 1]
        layer = np.where(middle < 0.5, LOWER, UPPER).astype(np.int32)
        self.cells = dolfinx.mesh.meshtags(self.mesh, d, cells, layer)
        if element is None:
            self.w = self.u = fem.Function(displacement_space(self.mesh, 1))
            self.v, self.p, self.q = ufl.TestFunction(self.u.function_space), None, None
        else:
            self.w = fem.Function(fem.functionspace(self.mesh, element))
            tests = ufl.TestFunctions(self.w.function_space)
            parts = zip(ufl.split(self.w), tests, strict=True)
            (self.p, self.q), (self.u, self.v) = sorted(
                parts, key=lambda part: len(part[0].ufl_shape)
            )
            self.part = ufl.split(self.w).index(self.u)
        self.dx = ufl.Measure("dx", self.mesh, subdomain_data=self.cells)
        self.ds = ufl.Measure("ds", self.mesh, subdomain_data=self.facets)
        self.E, self.pull = self.by_cell(E), self.by_cell(PULL)
        self.pressure = fem.Constant(self.mesh, 2.0)

    def by_cell(self, values):
        """Return a DG-0 function with a value for each tag of cells."""
        f = fem.Function(fem.functionspace(self.mesh, ("DG", 0)))
        f.x.array[self.cells.indices] = [values[tag] for tag in self.cells.values]
        f.x.scatter_forward()
        return f

    def work(self, E):
        """Return the density of the virtual work of the stresses."""
        return ufl.inner(stress(self.u, E, NU), strain(self.v))

    def loads(self, dx, ds):
        """Return the virtual work of the force on the upper layer and the pressure on the top."""
        return PULL[UPPER] * self.v[0] * dx - self.pressure * self.v[1] * ds

    def plain(self, ds=None):
        """Return the reference form, with no tags except for the top, where they are needed."""
        ds = self.ds(TOP) if ds is None else ds
        F = self.work(self.E) * ufl.dx - self.pull * self.v[0] * ufl.dx
        return F + self.pressure * self.v[1] * ds

    def solved(self, F, law=None, **options):
        """Solve; return the displacements at the nodes, and k_n at the points of Γc."""
        if self.w is self.u:
            bcs = [dirichlet_bc(self.u, self.facets, LEFT, 0)]
        else:
            part = self.w.function_space.sub(self.part).sub(0)
            dofs = fem.locate_dofs_topological(part, 1, self.facets.find(LEFT))
            bcs = [fem.dirichletbc(fem.Constant(self.mesh, 0.0), dofs, part)]
        surface = fc.ContactSurface(self.mesh, self.facets, BOTTOM)
        floor = fc.HalfSpace((0.0, 0.0), (0.0, 1.0))
        contact = fc.Contact(self.u, surface, floor, law or fc.Coulomb(0.3))
        problem = fc.ContactProblem(
            F, self.w, bcs=bcs, contacts=[contact], petsc_options=TIGHT, **options
        )
        problem.solve()
        return nodal_values(problem.displacement.u), point_values(
            contact, contact.values.parameters["k_n"]
        )


def two_measures_with_one_data(s):
    """Return a form over measures, each with a tag and a rule, and a third for the loads."""
    one, other = (
        ufl.Measure("dx", s.mesh, subdomain_data=s.cells, subdomain_id=tag, metadata=rule)
        for tag, rule in ((LOWER, {"quadrature_degree": 2}), (UPPER, {"quadrature_degree": 4}))
    )
    F = s.work(E[LOWER]) * one + s.work(E[UPPER]) * other
    return F - s.loads(s.dx(UPPER), s.ds(TOP))


def pairs(s):
    """Return a form over lists of (number, entities), as DOLFINx's ``form`` accepts them."""
    s.mesh.topology.create_connectivity(2, 1)
    to_cell, to_facet = s.mesh.topology.connectivity(1, 2), s.mesh.topology.connectivity(2, 1)
    behind = [(f, to_cell.links(f)[0]) for f in s.facets.find(TOP)]
    sides = [(cell, list(to_facet.links(cell)).index(f)) for f, cell in behind]
    top = np.array(sides, dtype=np.int32).ravel()
    dx = ufl.Measure(
        "dx", s.mesh, subdomain_data=[(tag, s.cells.find(tag)) for tag in (LOWER, UPPER)]
    )
    ds = ufl.Measure("ds", s.mesh, subdomain_data=[(TOP, top)])
    F = s.work(E[LOWER]) * dx(LOWER) + s.work(E[UPPER]) * dx(UPPER)
    return F - s.loads(dx(UPPER), ds(TOP))


def two_materials(s, dx=None):
    """Return the virtual work of the stresses of both materials, over the tags of one measure."""
    dx = s.dx if dx is None else dx
    return s.work(E[LOWER]) * dx(LOWER) + s.work(E[UPPER]) * dx(UPPER)


# Forms as they occur in scripts, by name.
EQUIVALENT_FORMS = {
    "two materials": lambda s: two_materials(s) - s.loads(s.dx(UPPER), s.ds(TOP)),
    "without a mesh": lambda s: (
        two_materials(s, ufl.Measure("dx", subdomain_data=s.cells))
        - s.loads(ufl.Measure("dx", subdomain_data=s.cells)(UPPER), s.ds(TOP))
    ),
    "two measures with one data": two_measures_with_one_data,
    "pairs of number and entities": pairs,
    "several tags at once": lambda s: (
        s.work(E[LOWER]) * s.dx((LOWER, UPPER))
        + s.work(E[UPPER] - E[LOWER]) * s.dx(UPPER)
        - s.loads(s.dx(UPPER), s.ds(TOP))
    ),
    "a sum of measures": lambda s: (
        s.work(s.E) * (s.dx(LOWER) + s.dx(UPPER)) - s.loads(s.dx(UPPER), s.ds(TOP))
    ),
    "one measure with data, all cells": lambda s: (
        s.work(s.E) * s.dx - s.loads(s.dx(UPPER), s.ds(TOP))
    ),
    "plain next to tagged": lambda s: s.work(s.E) * ufl.dx - s.loads(s.dx(UPPER), s.ds(TOP)),
    "plain facets next to tagged": lambda s: (
        s.plain() + fem.Constant(s.mesh, 0.0) * ufl.dot(s.u, s.v) * ufl.ds
    ),
    "by an energy": lambda s: (
        ufl.derivative(
            sum(
                0.5 * ufl.inner(stress(s.u, E[tag], NU), strain(s.u)) * s.dx(tag)
                for tag in (LOWER, UPPER)
            ),
            s.u,
            s.v,
        )
        - s.loads(s.dx(UPPER), s.ds(TOP))
    ),
    "bodies of the package": lambda s: (
        LinearElastic(s.u, E[LOWER], NU, "plane strain").residual(s.v, s.dx(LOWER))
        + LinearElastic(s.u, E[UPPER], NU, "plane strain").residual(s.v, s.dx(UPPER))
        - s.loads(s.dx(UPPER), s.ds(TOP))
    ),
}


@pytest.mark.whole
@pytest.mark.parametrize("form", EQUIVALENT_FORMS)
def test_equivalent_forms_have_the_same_solution(form):
    """Every form has the solution and k_n of that with coefficients by cell, to 1e-9."""
    s = Layers()
    u, k_n = s.solved(EQUIVALENT_FORMS[form](s))
    reference = Layers()
    expected, stiffness = reference.solved(reference.plain())
    assert is_close(u, expected, 1e-9) and is_close(k_n, stiffness, 1e-9)
    # E of the lower layer, on cells of height 1/4; to the round-off of its smoothing.
    assert is_close(k_n, np.full(k_n.shape, 10 * E[LOWER] * 4), 1e-9)


VECTOR, SCALAR = (
    basix.ufl.element("P", "quadrilateral", degree, shape=shape)
    for degree, shape in ((2, (2,)), (1, ()))
)


@pytest.mark.whole
@pytest.mark.parametrize("parts", [(VECTOR, SCALAR), (SCALAR, VECTOR)], ids=["u, p", "p, u"])
def test_two_materials_in_a_mixed_form(parts):
    """Displacement and pressure of a mixed function, in any order, over tags: E is 3 G, 1e-9."""
    element = basix.ufl.mixed_element(parts)
    computed = []
    for tagged in (True, False):
        s = Layers(element)

        def work(E, s=s):
            G, lame = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
            density = 2 * G * ufl.inner(strain(s.u), strain(s.v)) - s.p * ufl.div(s.v)
            return density - s.q * (ufl.div(s.u) + s.p / lame)

        if tagged:
            F = work(E[LOWER]) * s.dx(LOWER) + work(E[UPPER]) * s.dx(UPPER)
            F -= s.loads(s.dx(UPPER), s.ds(TOP))
        else:
            F = work(s.E) * ufl.dx - s.pull * s.v[0] * ufl.dx + s.pressure * s.v[1] * s.ds(TOP)
        computed.append(s.solved(F))
    (u, k_n), (expected, stiffness) = computed
    assert is_close(u, expected, 1e-9) and is_close(k_n, stiffness, 1e-9)
    assert is_close(k_n, np.full(k_n.shape, 10 * 3 * E[LOWER] / (2 * (1 + NU)) * 4), 1e-9)


def test_two_nonlinear_materials():
    """A nonlinear bulk over tags with their own rules, against coefficients by cell, 1e-9."""
    computed = []
    for tagged in (True, False):
        s = Layers()
        rules = [
            s.dx(tag, metadata={"quadrature_degree": 4})
            if tagged
            else ufl.dx(metadata={"quadrature_degree": 4})
            for tag in E
        ]
        if tagged:
            rubbers = [NeoHookean(s.u, E[tag], NU, "plane strain") for tag in E]
            F = sum(r.residual(s.v, dx) for r, dx in zip(rubbers, rules, strict=True))
            F -= s.loads(s.dx(UPPER), s.ds(TOP))
        else:
            F = NeoHookean(s.u, s.E, NU, "plane strain").residual(s.v, rules[0])
            F += s.pressure * s.v[1] * s.ds(TOP) - s.pull * s.v[0] * ufl.dx
        s.pressure.value = 50.0
        computed.append(s.solved(F))
    (u, k_n), (expected, stiffness) = computed
    assert is_close(u, expected, 1e-9) and is_close(k_n, stiffness, 1e-9)


@pytest.mark.parametrize("kind", ["cells", "facets"])
def test_two_quadrature_rules_over_the_same_tags(kind):
    """Two quadrature rules over a tag, one of them over several tags at once, are both assembled.

    In one form, DOLFINx 0.9 silently assembles one of them, in residual, tangent and E.
    """
    computed = []
    for tagged in (True, False):
        s = Layers()
        rule = {"quadrature_degree": 4}
        bed = 100.0 * ufl.dot(s.u, s.v)
        F = s.plain() if kind == "facets" or not tagged else -s.loads(s.dx(UPPER), s.ds(TOP))
        if tagged and kind == "cells":
            F += sum(s.work(E[tag]) * s.dx(tag, metadata=rule) for tag in (LOWER, UPPER))
            F += bed * s.dx((LOWER, UPPER)) + s.v[0] * s.dx((LOWER, UPPER))
        elif kind == "cells":
            F += bed * ufl.dx + s.v[0] * ufl.dx
        else:
            both = [s.ds(t, metadata=rule if tagged else {}) for t in (LEFT, RIGHT)]
            F += bed * both[0] + 2 * bed * both[1]
            F += bed * s.ds((LEFT, RIGHT)) + s.v[0] * s.ds((LEFT, RIGHT))
        computed.append(s.solved(F))
    (u, k_n), (expected, stiffness) = computed
    assert is_close(u, expected, 1e-9) and is_close(k_n, stiffness, 1e-9)


def test_joined_bodies():
    """Two bodies in contact, with materials over ``joined.body``, against `by_body`, 1e-9."""
    computed = []
    for tagged in (True, False):
        lower, upper = (block_mesh("quadrilateral", n=n) for n in (2, 3))
        upper[0].geometry.x[:, 1] += 1.0
        joined = fc.join_meshes(
            {
                name: (mesh, None, tags)
                for name, (mesh, tags) in {"lower": lower, "upper": upper}.items()
            }
        )
        mesh, moduli = joined.mesh, {"lower": 1000.0, "upper": 4000.0}
        u = fem.Function(displacement_space(mesh, 1))
        v = ufl.TestFunction(u.function_space)
        dx = ufl.Measure("dx", mesh, subdomain_data=joined.cells)
        ds = ufl.Measure("ds", mesh, subdomain_data=joined.facets)
        if tagged:
            F = sum(
                LinearElastic(u, fem.Constant(mesh, modulus), NU, "plane strain").residual(
                    v, dx(joined.body(name))
                )
                for name, modulus in moduli.items()
            )
        else:
            F = LinearElastic(u, joined.by_body(moduli), NU, "plane strain").residual(v)
        F += fem.Constant(mesh, 2.0) * v[1] * ds(joined.facet("upper", TOP))
        bcs = [dirichlet_bc(u, joined.facets, joined.facet("lower", BOTTOM), i) for i in range(2)]
        bcs.append(dirichlet_bc(u, joined.facets, joined.facet("upper", LEFT), 0))
        surface = fc.ContactSurface(mesh, joined.facets, joined.facet("upper", BOTTOM))
        below = fc.DeformableBody(joined.facets, joined.facet("lower", TOP))
        contact = fc.Contact(u, surface, below, fc.Coulomb(0.3))
        fc.ContactProblem(F, u, bcs=bcs, contacts=[contact], petsc_options=TIGHT).solve()
        computed.append((nodal_values(u), point_values(contact, contact.values.parameters["k_n"])))
    (u, k_n), (expected, stiffness) = computed
    assert is_close(u, expected, 1e-9) and is_close(k_n, stiffness, 1e-9)


def test_interior_facets_with_tagged_cells():
    """Integrals over interior facets need no tags if those over cells have tags, 1e-9."""
    computed = []
    for tagged in (True, False):
        s = Layers(ghost_mode=dolfinx.mesh.GhostMode.shared_facet)
        jumps = ufl.inner(ufl.jump(ufl.grad(s.u)), ufl.jump(ufl.grad(s.v))) * ufl.dS(s.mesh)
        F = EQUIVALENT_FORMS["two materials"](s) if tagged else s.plain()
        computed.append(s.solved(F + fem.Constant(s.mesh, 10.0) * jumps))
    (u, k_n), (expected, stiffness) = computed
    assert is_close(u, expected, 1e-9) and is_close(k_n, stiffness, 1e-9)


@pytest.mark.parametrize("kind", ["dx", "ds"])
def test_two_tag_objects_for_one_kind_of_measure_are_refused(kind):
    """Two tag objects for one kind of measure, of which DOLFINx accepts one, raise an error."""
    s = Layers()
    tags = s.cells if kind == "dx" else s.facets
    copy = dolfinx.mesh.meshtags(s.mesh, tags.dim, tags.indices, tags.values)
    F = s.plain()
    for data in (tags, copy):
        F += s.v[0] * ufl.Measure(kind, s.mesh, subdomain_data=data)(UPPER)
    assert_raised_on_all_ranks(
        lambda: s.solved(F), ValueError, f"integrals over {kind} with two different"
    )


def test_tags_of_other_entities_or_meshes_are_refused():
    """Facet tags for cells, or tags of another mesh, are named; DOLFINx gives a code or nothing."""
    s, other = Layers(), Layers()
    F = s.plain() + s.v[0] * ufl.Measure("dx", s.mesh, subdomain_data=s.facets)(TOP)
    assert_raised_on_all_ranks(
        lambda: s.solved(F), ValueError, f"dx({TOP})", "dimension 1", "on the cells"
    )
    F = s.plain() + s.v[0] * ufl.Measure("dx", s.mesh, subdomain_data=other.cells)(UPPER)
    assert_raised_on_all_ranks(lambda: s.solved(F), ValueError, f"dx({UPPER})", "another mesh")


def test_subdomain_of_a_measure_without_tags_is_refused():
    """An integral over a subdomain without tags is named, even if other measures have tags."""
    s = Layers()
    F = EQUIVALENT_FORMS["two materials"](s) + s.v[0] * ufl.dx(s.mesh)(UPPER)
    assert_raised_on_all_ranks(
        lambda: s.solved(F), ValueError, f"an integral over dx({UPPER})", "no tags"
    )


# ---- in time -------------------------------------------------------------------------------------

DENSITY, BETA, GAMMA = 2.0, 0.25, 0.5


def newmark(u, v, dt):
    """Return acceleration and velocity (UFL) at the end of a time step that starts at rest."""
    return u / (BETA * dt**2), GAMMA * u / (BETA * dt)


def bulks(kind, mesh, u, v):
    """Return the residual with the lower layer's modulus, and the weight of its integrals."""
    if kind == "rubber":
        rubber = NeoHookean(u, E[LOWER], NU, "plane strain")
        return rubber.residual(v), rubber.weight
    body = LinearElastic(u, E[LOWER], NU, kind)
    return body.residual(v), body.weight


@pytest.mark.whole
@pytest.mark.parametrize("kind", ["plane strain", "axisymmetric", "3D", "rubber"])
def test_inertia_is_not_counted_as_stiffness(kind):
    """E derived from a form by Newmark's method is that of the material: 1e-9, round-off.

    The form has mass, viscous damping, an elastic foundation and a first-order term. Mass is from
    1e-12 to 1e18 times as large as stiffness; it once changed E by 12 % and -30 %.
    """
    mesh, tags = block_mesh("tetrahedron" if kind == "3D" else "triangle", n=2)
    d = mesh.geometry.dim
    u = fem.Function(displacement_space(mesh, 1))
    v, dt = ufl.TestFunction(u.function_space), fem.Constant(mesh, 1.0)
    elastic, weight = bulks(kind, mesh, u, v)
    acceleration, velocity = newmark(u, v, dt)
    wind = fem.Constant(mesh, np.ones(d))
    F = elastic + weight * ufl.dot(DENSITY * acceleration + 3.0 * velocity + 5.0 * u, v) * ufl.dx
    F += weight * 0.1 * ufl.dot(ufl.grad(u) * wind, v) * ufl.dx
    surface = fc.ContactSurface(mesh, tags, BOTTOM)
    floor = fc.HalfSpace(np.zeros(d), np.eye(d)[-1])
    computed = []
    for exponent in range(-8, 8, 3):
        dt.value = 10.0**exponent
        contact = fc.Contact(
            u, surface, floor, fc.Coulomb(0.3, fc.RelativeStiffness(5.0)), weight=weight
        )
        fc.ContactProblem(F, u, contacts=[contact])
        computed.append(point_values(contact, contact.values.parameters["k_n"]))
    # The height of a cell is half of that of the block.
    assert is_close(computed, np.full_like(computed, 5.0 * E[LOWER] * 2), 1e-9)


def test_inertia_in_a_mixed_form():
    """E derived from a mixed form with inertia is 3 G, 1e-9."""
    s = Layers(basix.ufl.mixed_element([VECTOR, SCALAR]))
    dt, G = fem.Constant(s.mesh, 1e-5), E[LOWER] / (2 * (1 + NU))
    F = 2 * G * ufl.inner(strain(s.u), strain(s.v)) * ufl.dx - s.p * ufl.div(s.v) * ufl.dx
    F += DENSITY * ufl.dot(newmark(s.u, s.v, dt)[0], s.v) * ufl.dx
    F -= s.q * (ufl.div(s.u) + s.p / E[LOWER]) * ufl.dx - s.pressure * s.v[1] * s.ds(TOP)
    _, k_n = s.solved(F)
    assert is_close(k_n, np.full(k_n.shape, 10 * 3 * G * 4), 1e-9)
