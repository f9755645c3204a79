"""Drag a rubber block over another one by GetFEM, for `tests/test_finite_references.py`.

    python3 verification/getfem_two_bodies.py                    # by penalty, with μ = 0.3
    python3 verification/getfem_two_bodies.py --frictionless     # needs GetFEM 5.4, on Debian
    python3 verification/getfem_two_bodies.py --brick            # python3-getfem

Scene, mesh and elements are those of scenes/sliding_rubber_block.py: biquadratic cells with three
Gauss points along each side. GetFEM's raytracing pairs points of the upper block with the lower
block.

The penalty pressure is p = k ⟨-g⟩ per undeformed length of the lower side of the upper block, with
the gap g to the lower block along the present normal n of the upper block. Friction is the value of
the last increment minus q times the slip since, bounded by μ p. With the jump u - w between both
ends of the ray the slip is t₀·(u - w + g (n - n₀)), where w, n₀ and t₀ are displacement, normal and
tangent of the last increment. GetFEM computes all derivatives. ``--brick`` uses GetFEM's brick for
large sliding instead: an augmented Lagrangian with multipliers linear along the side, without
penetration where they are tested. Newton's method takes full steps; line search "simplest" needs 18
to 38 of them per increment.
"""

from __future__ import annotations

import sys
import time

import getfem as gf  # no dependency: this script and getfem_disc.py alone need it
import numpy as np

NU, ROUND, K, KT, MU = 0.3, 0.3, 2e4, 2e4, 0.3
BLOCKS = (((0.0, 0.0), (6.0, 2.0), (24, 8), 1000.0), ((0.6, 2.0), (2.0, 1.0), (12, 6), 2000.0))
N_INDENTATION, N_SLIDING, INDENTATION, SLIDING_DISTANCE = 4, 20, 0.2, 1.6
FIXED, CONTACT = 1, 2
RAY = 0.5  # release distance
LOWER, UPPER = 0, 1


def block(number: int) -> tuple[gf.Mesh, gf.MeshFem, gf.MeshIm]:
    """Return mesh, displacement space and integration method of a block."""
    origin, size, n, _ = BLOCKS[number]
    # Cells are bilinear, as cells of "cartesian" meshes are affine even after points are moved.
    shape = f"ORG={list(origin)};SIZES={list(size)};NSUBDIV={list(n)}"
    mesh = gf.Mesh("import", "structured", f"GT='GT_QK(2,1)';{shape}")
    at, far = 1e-6, 1e3
    low, high = origin[1], origin[1] + size[1]
    ends = [[-far, low - at], [far, low + at]], [[-far, high - at], [far, high + at]]
    fixed, contact = ends if number == LOWER else ends[::-1]
    mesh.set_region(FIXED, mesh.outer_faces_in_box(*fixed))
    mesh.set_region(CONTACT, mesh.outer_faces_in_box(*contact))
    if number == UPPER:
        points = mesh.pts()
        middle = origin[0] + size[0] / 2
        share = (high - points[1]) / size[1]
        points[1] += ROUND * share * ((points[0] - middle) / (size[0] / 2)) ** 2
        mesh.set_pts(points)
    space = gf.MeshFem(mesh, 2)
    space.set_classical_fem(2)
    return mesh, space, gf.MeshIm(mesh, gf.Integ("IM_GAUSS_PARALLELEPIPED(2,4)"))


def bulk(model: gf.Model, rule: gf.MeshIm, name: str, modulus: float) -> None:
    """Add the strain energy of a block to the model."""
    shear, lame = modulus / (2 * (1 + NU)), modulus * NU / ((1 + NU) * (1 - 2 * NU))
    gradient = f"(Id(2)+Grad_{name})"
    model.add_nonlinear_term(
        rule,
        f"{shear!r}/2*(Norm_sqr{gradient}+1-3-2*log(Det{gradient}))"
        f"+{lame!r}/4*(sqr(Det{gradient})-1-2*log(Det{gradient}))",
    )


class PenaltyContact:
    """Penalty and friction as expressions in GetFEM's assembly language, with its raytracing."""

    def __init__(self, model: gf.Model, blocks: list, mu: float) -> None:
        """Add penalty and friction to the model."""
        (mesh2, space2, _), (mesh1, space1, self.rule) = blocks
        self.model, self.mu = model, mu
        model.add_raytracing_transformation("ray", RAY)
        model.add_master_contact_boundary_to_raytracing_transformation("ray", mesh2, "u2", CONTACT)
        model.add_slave_contact_boundary_to_raytracing_transformation("ray", mesh1, "u1", CONTACT)
        for name, value in {"k": K, "q": KT, "mu": mu}.items():
            model.add_initialized_data(name, [value])
        model.add_fem_data("w1", space1)
        model.add_fem_data("w2", space2)
        self.points = gf.MeshImData(self.rule, CONTACT)
        model.add_im_data("previous_friction", self.points)
        n, n0 = (f"Transformed_unit_vector(Grad_{v}1,Normal)" for v in "uw")
        gap = f"((Interpolate(X,ray)+Interpolate(u2,ray)-X-u1).{n})"
        pressure = f"(k*neg_part({gap}))"
        relative_displacement = f"(u1-w1-Interpolate(u2,ray)+Interpolate(w2,ray)+{gap}*({n}-{n0}))"
        trial = f"(previous_friction-q*({relative_displacement}.([0,-1;1,0]*{n0})))"
        bound = f"(mu*{pressure})"
        self.friction = f"({trial}-pos_part({trial}-{bound})+neg_part({trial}+{bound}))"
        self.traction = f"(-{pressure}*{n}+{self.friction}*([0,-1;1,0]*{n}))"
        if not mu:
            self.traction = f"(-{pressure}*{n})"
        term = f"-{self.traction}.(Test_u1-Interpolate(Test_u2,ray))"
        model.add_nonlinear_term(self.rule, f"Interpolate_filter(ray,{term},1)", CONTACT)

    def force(self) -> np.ndarray:
        """Return the contact force on the upper block."""
        return np.array(
            [
                gf.asm(
                    "generic",
                    self.rule,
                    0,
                    f"Interpolate_filter(ray,{self.traction}({i}),1)",
                    CONTACT,
                    self.model,
                )
                for i in (1, 2)
            ]
        )

    def commit(self) -> None:
        """Commit the present state."""
        model = self.model
        if self.mu:
            friction_traction = f"Interpolate_filter(ray,{self.friction},1)"
            found = model.interpolation(friction_traction, self.points, CONTACT)
            model.set_variable("previous_friction", found)
        for i in "12":
            model.set_variable("w" + i, model.variable("u" + i))


class BrickContact:
    """GetFEM's brick for large sliding, with multipliers on the upper block."""

    def __init__(self, model: gf.Model, blocks: list, mu: float) -> None:
        """Add the brick to the model."""
        (_, space2, rule2), (mesh1, space1, self.rule) = blocks
        self.model = model
        linear = gf.MeshFem(mesh1, 2)
        linear.set_classical_fem(1)
        model.add_filtered_fem_variable("m", linear, CONTACT)
        for name, value in {"r": 1e3, "mu": mu, "alpha": 1.0}.items():
            model.add_initialized_data(name, [value])
        model.add_fem_data("w1", space1)
        model.add_fem_data("w2", space2)
        brick = model.add_integral_large_sliding_contact_brick_raytracing(
            "r", RAY, "mu", "alpha", 0
        )
        model.add_slave_contact_boundary_to_large_sliding_contact_brick(
            brick, self.rule, CONTACT, "u1", "m", "w1"
        )
        model.add_master_contact_boundary_to_large_sliding_contact_brick(
            brick, rule2, CONTACT, "u2", "w2"
        )

    def force(self) -> np.ndarray:
        """Return the contact force on the upper block."""
        return np.array(
            [gf.asm("generic", self.rule, 0, f"m({i})", CONTACT, self.model) for i in (1, 2)]
        )

    def commit(self) -> None:
        """Commit the present state."""
        for i in "12":
            self.model.set_variable("w" + i, self.model.variable("u" + i))


def main() -> None:
    """Solve all increments, and print the contact force of each."""
    gf.util_trace_level(0)
    gf.util_warning_level(0)
    start, clock = time.process_time(), time.perf_counter()
    mu = 0.0 if "--frictionless" in sys.argv else MU
    blocks = [block(LOWER), block(UPPER)]
    model = gf.Model("real")
    for name, (_, space, rule), (_, _, _, modulus) in zip(
        ("u2", "u1"), blocks, BLOCKS, strict=True
    ):
        model.add_fem_variable(name, space)
        bulk(model, rule, name, modulus)
    model.add_initialized_data("prescribed_displacement", [0.0, 0.0])
    model.add_Dirichlet_condition_with_simplification("u2", FIXED)
    model.add_Dirichlet_condition_with_multipliers(
        blocks[UPPER][2], "u1", 2, FIXED, "prescribed_displacement"
    )
    contact = (BrickContact if "--brick" in sys.argv else PenaltyContact)(model, blocks, mu)
    path = [(0.0, INDENTATION * i / N_INDENTATION) for i in range(1, N_INDENTATION + 1)]
    path += [(SLIDING_DISTANCE * i / N_SLIDING, INDENTATION) for i in range(1, N_SLIDING + 1)]
    iterations = []
    for along, down in path:
        model.set_variable("prescribed_displacement", [along, -down])
        made, _ = model.solve("max_iter", 100, "max_res", 1e-9, "lsearch", "basic")
        iterations.append(int(made))
        found = contact.force()
        contact.commit()
        print(f"({found[0]:.6f}, {found[1]:.6f}),  # {made}", flush=True)
    spent, waited = time.process_time() - start, time.perf_counter() - clock
    print(f"{sum(iterations)} Newton iterations, {spent:.2f} s of the processor, {waited:.2f} s")


if __name__ == "__main__":
    main()
