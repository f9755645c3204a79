"""What the package's texts mean and what to do, by hand; `messages` puts both together.

``tests/test_docs.py`` looks that every text has its place here, and every place a text.
"""

from __future__ import annotations

# Errors: their groups in the order in which a script meets them, the modules of each, and what
# they have in common. The text of an error itself says what was given and what to give.
GROUPS: list[tuple[str, list[str], str]] = [
    (
        "Installation",
        ["compat"],
        "`python -m fenics_contact info` tells what an installation is made of.",
    ),
    (
        "Meshes",
        ["meshes", "joining"],
        "A mesh from gmsh has its cells in physical groups that do not overlap. Meshes that are "
        "joined "
        "have the same kind of cell, geometric degree and communicator.",
    ),
    (
        "Types of arguments",
        ["arguments"],
        "An argument is of another class than is expected, often because the order of the "
        "arguments "
        "is another, or because the brackets of a class are missing.",
    ),
    (
        "Surface and displacement",
        ["surface.surface", "surface.displacement", "surface.fields", "surface.modulus"],
        "Γc is made of tagged exterior facets. The displacement is a continuous, vector-valued "
        "Lagrange function on the mesh of Γc, or that part of a mixed function which `ufl.split` "
        "gives.",
    ),
    (
        "Supports",
        [
            "supports.base",
            "supports.rigid",
            "supports.profile",
            "supports.meshed",
            "supports.facets",
            "supports.stl",
            "supports.deformable",
        ],
        "Vectors have as many components as the mesh has dimensions, an axis is given in space "
        "only. "
        "Of facets and points the order says which side is outside.",
    ),
    (
        "Laws and stiffness",
        ["laws.base", "laws.friction", "laws.unilateral", "laws.stiffness", "contact.point_law"],
        "k_n and k_t are stresses per length. A law of one's own says its `response`, and its "
        "potential where it has no k_n: [](learn/own-law.md). All that it depends on are its "
        "parameters.",
    ),
    (
        "Contacts",
        [
            "contact.contact",
            "contact.choices",
            "contact.inputs",
            "contact.opposite",
            "contact.point_data",
            "contact.rigid",
            "contact.finite",
            "contact.general",
            "contact.accuracy",
        ],
        "The parts do not go together, or a value is out of range at a point of Γc; the text "
        "begins "
        "with the name of the contact. What finite kinematics need is on [its page](finite.md).",
    ),
    (
        "Bulk form",
        ["systems.bulk", "systems.measures", "elasticity"],
        "F is the residual of the bulk in the function that is solved for and one test function, "
        "loads "
        "included, contact not.",
    ),
    (
        "Problem and choice of the method",
        [
            "problem",
            "checks.given",
            "methods.solver",
            "methods.options",
            "methods.alternating",
            "methods.primal_dual",
            "systems.choice",
        ],
        "[](choose.md) says which method and linear solver are for what.",
    ),
    (
        "Loads that nothing balances, bodies that nothing holds",
        ["methods.load_balance"],
        "Found before any iteration, by the rigid motions that Dirichlet conditions leave to each "
        "body. Contact can only push along its normals and rub within the cone of friction. Look "
        "at "
        "the sign of the load first, then at the normal of the support, then at what is to hold "
        "the "
        "body. The text names the motion, and the largest force that contact can bear along it.",
    ),
    (
        "Linear algebra",
        [
            "methods.callbacks",
            "methods.neighbourhood",
            "systems.dissection",
            "systems.substructure",
            "systems.unknowns",
        ],
        "A factorisation was refused, or a matrix is singular though contact is held: a part of "
        "the "
        "body is held by nothing, or memory is short. `condensation=False` iterates on all "
        "unknowns, "
        '`linear_solver="multigrid"` takes memory that grows as their number.',
    ),
    (
        "Increments",
        ["histories.increments", "histories.table"],
        "Arguments of `increments`, and files of another history: make the same calls in the same "
        "order, or remove the file.",
    ),
    (
        "Checkpoints",
        ["histories.checkpoint", "histories.archive", "histories.places"],
        "A file is taken up by the scene that wrote it alone; the text names what differs. "
        '`changed="continue"` goes on with other data (stiffness, laws, supports, conditions, '
        "loads), "
        "never with another mesh or element.",
    ),
    (
        "Error estimates and adaptation",
        ["estimates.errors", "estimates.adaptation"],
        "The stress is a UFL tensor on the body; meshes that are adapted are straight triangles or "
        "tetrahedra.",
    ),
    (
        "Results",
        [
            "contact.results",
            "results.files",
            "results.output",
            "results.vtu",
            "results.writer",
            "results.drawing",
            "results.plotting",
            "results.animation",
            "histories.progress",
            "histories.report",
        ],
        "Files of another program are never overwritten.",
    ),
]

# What else is said, by a piece of its text: what it means, and what to do.
MEANINGS: dict[str, dict[str, tuple[str, str]]] = {
    "NotConverged": {
        "did not converge": (
            "No state of this increment passed. u, history and loads are as before it. "
            "The text has the reason of SNES, what the last state does not satisfy (next table), "
            "and "
            "every attempt with its outcome.",
            "Read the attempts from the left. Then the ladder above.",
        ),
    },
    "verdict": {
        "residual of": (
            "The equations of a body, a free support or a contact are left with more than 1e-9 of "
            "the "
            "forces on it (or what `accuracy` asks for).",
            "It is what a failed method leaves: see the attempts. Alone, after a method that says "
            "converged: forces are far smaller than those of the increment before.",
        ),
        "forces on": (
            "Load, reactions and tractions at the points do not sum to zero.",
            "As for the residual.",
        ),
        "differ from those of the boundary form": (
            "With `second_route=True`: forces on Γc are not those that DOLFINx assembles.",
            "No state of yours makes this: please report it.",
        ),
        "violated by": (
            "A law does not hold at a point: complementarity, stiffness, cone, slip, dissipation.",
            "With a law of your own: its `response` and its limit contradict each other, or it "
            "pulls where the gap is open, and its `has_tension` does not say so.",
        ),
        "penetration or elastic slip left": (
            "Multipliers have not settled within their rounds.",
            "k_n and k_t near 10 E/h, a larger `tolerance`; take facets out of Γc that a Dirichlet "
            "condition holds inside of the support.",
        ),
        "friction would drive the slip": (
            "The state is one of several, and friction would give energy in it.",
            "Smaller increments; `increments` cuts by itself.",
        ),
        "cannot be told": (
            "A body is held against nothing but springs of contact, so that what small "
            "displacements "
            "leave out cannot be estimated.",
            "Hold the body by a condition or a weak spring, or `ContactProblem(kinematics=inf)`.",
        ),
        "too large to be taken as small: with": (
            "Gap and normals where the body has moved to would change force or pressure by more "
            "than "
            "`ContactProblem(kinematics=0.2)`.",
            '`Contact(..., kinematics="finite")`; or describe the motion as one of the support; '
            "between "
            'bodies `update="increment"`.',
        ),
        "times its size: nothing holds": (
            "A body is deformed as none that has stiffness is.",
            "Dirichlet conditions; units of stiffness and loads.",
        ),
        "is thrown out: it has gone": (
            "A body that nothing but contact holds was pushed out of sight of all others in one "
            "step of the iteration, and is in equilibrium there, without any force.",
            "Smaller increments; bodies that touch at first; a weak spring.",
        ),
        "turned inside out": (
            "det(I + grad u) ≤ 0 at a point of a nonlinear bulk.",
            "Smaller increments, finer cells there.",
        ),
        "penetrates between the quadrature points": (
            "A place of either surface lies deeper in what is opposite than the points of Γc "
            "around it resist: an edge, a corner or an obstacle narrower than points are apart.",
            "Let the finer surface be Γc, refine it there, give a larger `quadrature_degree`, or "
            "add a second contact with the surfaces swapped.",
        ),
        "the distance of the Obstacle changes": (
            "`Obstacle(distance=...)` is no distance where contact is.",
            "Divide it by the length of its gradient.",
        ),
        "half of its radius of curvature": (
            "A point is so deep in a curved support that it is about to leave on the other side.",
            'A larger k_n, or `enforcement="augmented"`.',
        ),
        "has crossed what lies opposite": (
            "In one increment a place of Γc entered the obstacle or the other body on one side and "
            "left it, or is about to, on another; or it came in where no point of Γc resists.",
            "Smaller increments (`increments` cuts by itself); all sides that may touch in Γc and "
            "in the opposite surface.",
        ),
        "rad in one increment": (
            "The support turns by more than a right angle in one increment, with friction.",
            "More increments; `increments` cuts by itself.",
        ),
    },
    "attempt": {
        "iterations used up": (
            "The method reached its limit (`-contact_snes_max_it`).",
            "Something follows by itself, unless `fallback=False`.",
        ),
        "no progress": (
            "The line search finds no step that makes the residual smaller.",
            "The next method, or a cut, follows by itself.",
        ),
        "overload": (
            "Along the motion that is named the load does more than friction takes, by the "
            "pressures of equilibria in which friction is as large as it would have to be.",
            "Less load, more friction, or a condition that holds the body along this motion.",
        ),
        "the matrix is singular": (
            "The tangent of the present state holds a body nowhere.",
            "If the last attempt ends so: look for a body that nothing holds where contact opens.",
        ),
        "the residual is not finite": (
            "A law, the bulk form or a load gives NaN or infinity, or cells are turned inside out.",
            "Smaller increments; look at divisions and roots in your own form.",
        ),
        "chatters": (
            "Points keep changing their status while the residual does not fall; the place is "
            "told.",
            "Smaller increments, a lower k_t, then a lower k_n.",
        ),
    },
    "warning": {
        "displacements are taken as small": (
            "What small displacements leave out is more than 1 % of force or pressure. It is said "
            "again where it has doubled; the summary of each step has it.",
            'Accept it, or take `kinematics="finite"`. From 20 % on the increment fails.',
        ),
        "round-off of its displacements leaves": (
            "A stiff body is carried along so far that the round-off of its displacements, times "
            "its stiffness, is more than 1e-5 of the forces on it.",
            "Stresses and reactions of the softer bodies, and contact forces, are exact. Let the "
            "support move in the place of the body, or take the stiff one for rigid.",
        ),
        "points into the body": (
            "The support's normal is the wrong way round at every point of Γc.",
            "Turn it round. Where the body is deep inside, it is an error.",
        ),
        "press on one and the same support": (
            "Two contacts have facets in common, and what they press on is at one place and moves "
            "as one. Stiffnesses add up, and each has a part of the force, the pressure and the "
            "friction.",
            "Tags that overlap; a contact that was made twice. Two laws side by side may be meant.",
        ),
        "pass between its points": (
            "In space, with finite kinematics, Γc has at most four points a side of a facet "
            "unasked. The facets opposite are so much smaller that their nodes give way between "
            "these, and bear nothing there: force and pressure are too small, though all equations "
            "hold. [](finite.md) has what was measured.",
            "Let the finer surface be Γc; or the `quadrature_degree` that is told, which takes "
            "time by its square. A body 100 times as stiff opposite loses less than 1 %.",
        ),
        "times as long as the radius": (
            "A point of Γc sees the support where it is, and no more: where few of a facet touch, "
            "the force goes up and down as they come and go. The radius of a `Ball`, a `Cylinder` "
            "or a `RigidProfile` is known, and sets the number of points by default; that of "
            "an `Obstacle` is measured where it bears.",
            "Smaller facets where the support may come, or the `quadrature_degree` that is told.",
        ),
        "opposite surface ends": (
            "With finite kinematics a point of Γc bears or not, as its normal meets the other body "
            "or passes its end. Facets that an end divides bear much of the force, and one point "
            "more or less counts there: blocks lacked 8 and 13 % of the force. "
            "[](finite.md) has what was measured.",
            "Let the body whose surface is the smaller one have Γc, so that all of its points meet "
            "the other; or finer facets, or a larger `quadrature_degree`.",
        ),
        "have no opposite": (
            "More than half of Γc looks past the other body.",
            "Tags of Γc and of the opposite, `search_distance`, `release`.",
        ),
        "with changed data": (
            'A checkpoint is gone on with by other data, as `changed="continue"` allows.',
            "Nothing, if the list is what you changed.",
        ),
        "and nothing on the mesh has this tag": (
            "A load, or another integral of F, is over a tag that no facet or cell has.",
            "The number of the tag; the tags that the measure was made with.",
        ),
        "holds nothing": (
            "A Dirichlet condition was made of an empty list of degrees of freedom.",
            "The tag, or the function that locates; `np.isclose` instead of `==`.",
        ),
        "nothing will change with it": (
            "The load that `increments` leads stands nowhere in the problem.",
            "Put the constant itself into the form, the condition or the support, not a number "
            "made of it.",
        ),
        "was solved and not committed": (
            "Friction remembers what is committed alone; a loop of one's own has left it out.",
            "`problem.commit()` after `problem.solve()`, or take `increments`.",
        ),
        "will not be solved for": (
            "A history starts at another load than the last one has ended at.",
            "`increments(problem, load, start, ...)` with the load that was reached.",
        ),
        "nothing was solved": (
            "`increments` returns what is to be iterated over.",
            "`for step in fc.increments(...)`, or `list(...)`.",
        ),
        "did not converge: cut to": (
            "The increment is tried again with half of its size.",
            "Nothing, if the history goes on; see the ladder above.",
        ),
        "is changed between increments": (
            "A function in the bulk form is changed by the loop and is not in the checkpoint.",
            "`increments(..., fields=[...])`.",
        ),
        "no solver has read": (
            "A PETSc option under the problem's prefix has had no effect.",
            "Its spelling; whether its solver is in use.",
        ),
        "the reference BLAS": (
            "Factorisations take up to eight times longer than they need.",
            "Install OpenBLAS.",
        ),
        "failed alone": (
            "One rank raised an error that the others cannot know of; all are ended.",
            "The error is shown above it.",
        ),
        "penetrates its support": (
            "Body and support overlap before any load.",
            "An interference that is meant belongs in `Contact(gap=...)`; else the place of the "
            "support.",
        ),
        "no two of the bodies": (
            "`contact_pairs` found nothing: bodies are farther apart, or overlap by more than "
            "half a cell.",
            "A larger `distance`; bodies that do not overlap.",
        ),
    },
    "log": {
        "compiling forms": (
            "A program waits for the compiler where it has forms that none had before.",
            "Nothing: the next run starts at once. Numbers that are `fem.Constant`s leave the form "
            "as it is when they change.",
        ),
        "are done": ("The checkpoint has all increments of this call.", "Nothing."),
        "going on from": ("A history goes on behind its checkpoint.", "Nothing."),
        "accuracy": ("What `accuracy=` has chosen.", "Nothing."),
        "iterating on all unknowns": ("Why the problem is not condensed.", "Nothing."),
        "linear systems of": ("Which linear solver, and why.", "Nothing."),
        "condensed onto": ("How many unknowns are iterated on.", "Nothing."),
        "pairs are found anew": (
            "Points slide along another body: who lies opposite them changes.",
            'Nothing; `DeformableBody(update="never")` where the first pairs are to stay.',
        ),
    },
}
