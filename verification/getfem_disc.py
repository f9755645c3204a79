"""Press a rigid disc into rubber by GetFEM, for `tests/test_finite_references.py`.

    python3 verification/getfem_disc.py               # without friction
    python3 verification/getfem_disc.py --friction    # needs GetFEM 5.4, on Debian python3-getfem

A block in plane strain with fixed bottom is under a disc of radius 4, which touches the middle of
its top. W = G/2 (I₁ - 3 - 2 ln J) + λ/4 (J² - 1 - 2 ln J) with E = 1000, ν = 0.3; the disc is a
penalty of ½ k ⟨R - |x - c|⟩² per undeformed length, k = 1e4. Cells are biquadratic, of size 0.5,
with three Gauss points along each side; GetFEM's assembly language computes all derivatives.

Without friction half of a block 10 x 10 is modelled, and the disc pressed in by 3 in twelve
increments. With μ = 0.3 a block 16 x 10 is pressed in the same way, then the disc rotates by 0.8 in
eight increments, and is dragged by 2 in eight more. Friction is the value of the last increment
minus q = 1e3 times the slip since, bounded by μ p. The slip is R sin(θ - θ₀), where θ and θ₀ are
the angles on the disc of a point's present and last projection.
"""

from __future__ import annotations

import sys
import time

import getfem as gf  # no dependency: this script and getfem_two_bodies.py alone need it
import numpy as np

E, NU, RADIUS, HEIGHT, DEPTH, STEPS, K = 1000.0, 0.3, 4.0, 10.0, 3.0, 12, 1e4
KT = 1e3
MU, ROTATION, SLIDING_DISTANCE, N_SLIDING = 0.3, 0.8, 2.0, 8
BOTTOM, TOP, MIDDLE = 1, 2, 3
OUTWARD = "((X+u-c)/Norm(X+u-c))"  # from the centre of the disc
PRESSURE = "(k*neg_part(Norm(X+u-c)-R))"


def block(left: float, right: float) -> tuple[gf.Model, gf.MeshIm]:
    """Return model and integration method of rubber between two x, with fixed bottom."""
    along = np.linspace(left, right, round((right - left) / 0.5) + 1)
    mesh = gf.Mesh("cartesian", along, np.linspace(0, HEIGHT, 21))
    boxes = ([[-9, -1e-6], [9, 1e-6]], [[-9, HEIGHT - 1e-6], [9, 11]], [[-1e-6, -1], [1e-6, 11]])
    for region, (low, high) in zip((BOTTOM, TOP, MIDDLE), boxes, strict=True):
        mesh.set_region(region, mesh.outer_faces_in_box(low, high))
    space = gf.MeshFem(mesh, 2)
    space.set_classical_fem(2)
    rule = gf.MeshIm(mesh, gf.Integ("IM_GAUSS_PARALLELEPIPED(2,4)"))
    model = gf.Model("real")
    model.add_fem_variable("u", space)
    shear, lame = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    for name, value in {"G": [shear], "L": [lame], "k": [K], "q": [KT], "R": [RADIUS]}.items():
        model.add_initialized_data(name, value)
    model.add_initialized_data("c", [0.0, HEIGHT + RADIUS])
    gradient = "(Id(2)+Grad_u)"
    model.add_nonlinear_term(
        rule,
        f"G/2*(Norm_sqr{gradient}+1-3-2*log(Det{gradient}))"
        f"+L/4*(sqr(Det{gradient})-1-2*log(Det{gradient}))",
    )
    model.add_nonlinear_term(rule, "k/2*sqr(neg_part(Norm(X+u-c)-R))", TOP)
    model.add_Dirichlet_condition_with_simplification("u", BOTTOM)
    return model, rule


def solve(model: gf.Model) -> int:
    """Solve one increment; return the number of Newton iterations."""
    made, _ = model.solve("max_iter", 60, "max_res", 1e-9, "lsearch", "simplest")
    return int(made)


def without_friction() -> int:
    """Print the force on half of the disc; return the number of Newton iterations."""
    model, rule = block(0.0, 5.0)
    model.add_initialized_data("across", np.array([[1.0, 0.0], [0.0, 0.0]]))
    model.add_initialized_data("zero", [0.0, 0.0])
    # With multipliers the corner of the top would move by 1e-3.
    model.add_generalized_Dirichlet_condition_with_penalization(
        rule, "u", 1e12, MIDDLE, "zero", "across"
    )
    iterations = 0
    for step in range(1, STEPS + 1):
        model.set_variable("c", [0.0, HEIGHT + RADIUS - DEPTH * step / STEPS])
        iterations += solve(model)
        force = gf.asm("generic", rule, 0, f"-{PRESSURE}*{OUTWARD}.[0;1]", TOP, model)
        print(f"{DEPTH * step / STEPS:.2f}  {force:.6f}")
    return iterations


def with_friction() -> int:
    """Print force on the block and torque about the disc's centre; return the iterations."""
    model, rule = block(-8.0, 8.0)
    points = gf.MeshImData(rule, TOP)
    across = gf.MeshImData(rule, TOP, 2)
    model.add_im_data("previous_projection", across)  # as directions from the centre
    model.add_im_data("previous_friction", points)  # positive along [-y; x] of these directions
    model.add_initialized_data("mu", [MU])
    model.add_initialized_data("turn", [1.0, 0.0])  # cosine and sine of the last increment's angle
    along = f"([0,-1;1,0]*{OUTWARD})"
    was = "previous_projection"
    was = f"[turn(1)*{was}(1)-turn(2)*{was}(2);turn(2)*{was}(1)+turn(1)*{was}(2)]"
    trial = f"(previous_friction-q*R*({along}.(-{was})))"
    bound = f"(mu*{PRESSURE})"
    friction = f"({trial}-pos_part({trial}-{bound})+neg_part({trial}+{bound}))"
    model.add_nonlinear_term(rule, f"-{friction}*({along}.Test_u)", TOP)

    def commit() -> None:
        found = model.interpolation(friction, points, TOP)
        model.set_variable("previous_projection", model.interpolation(OUTWARD, across, TOP))
        model.set_variable("previous_friction", found)

    model.set_variable("previous_projection", model.interpolation(OUTWARD, across, TOP))
    iterations, done = 0, 0.0
    path = [(0.0, DEPTH * i / STEPS, 0.0) for i in range(1, STEPS + 1)]
    path += [(0.0, DEPTH, ROTATION * i / N_SLIDING) for i in range(1, N_SLIDING + 1)]
    path += [(SLIDING_DISTANCE * i / N_SLIDING, DEPTH, ROTATION) for i in range(1, N_SLIDING + 1)]
    for side, depth, angle in path:
        model.set_variable("c", [side, HEIGHT + RADIUS - depth])
        model.set_variable("turn", [np.cos(angle - done), np.sin(angle - done)])
        iterations += solve(model)
        traction = f"({PRESSURE}*{OUTWARD}+{friction}*{along})"
        # The contact force on the block is minus the contact terms of the residual.
        x, y = (gf.asm("generic", rule, 0, f"{traction}({i})", TOP, model) for i in (1, 2))
        torque = gf.asm("generic", rule, 0, f"Norm(X+u-c)*{friction}", TOP, model)
        commit()
        done = angle
        print(f"({x:.6f}, {y:.6f}, {torque:.6f}),")
    return iterations


def main() -> None:
    """Solve with or without friction, and print the forces."""
    gf.util_trace_level(0)
    start = time.process_time()
    iterations = with_friction() if "--friction" in sys.argv else without_friction()
    print(f"{iterations} Newton iterations, {time.process_time() - start:.2f} s of the processor")


if __name__ == "__main__":
    main()
