"""A rubber block under a rigid disc, by GetFEM: numbers for `tests/test_finite_references.py`.

    python3 verification/getfem_disc.py     # needs GetFEM 5.4, on Debian python3-getfem

Plane strain, half of the block [0, 5] x [0, 10], held at its bottom and across x = 0; the disc of
radius 4 stands on the middle of the top and is pressed down by 3 in twelve increments, without
friction. W = G/2 (I₁ - 3 - 2 ln J) + λ/4 (J² - 1 - 2 ln J) with E = 1000, ν = 0.3; the disc is a
penalty of ½ k ⟨R - |x - c|⟩² per undeformed length, k = 1e4. Biquadratic cells, three Gauss points
along each side of them, all derivatives by GetFEM's own assembly language.
"""

from __future__ import annotations

import time

import getfem as gf  # no dependency: this script alone needs it
import numpy as np

E, NU, RADIUS, HEIGHT, DEPTH, STEPS, K = 1000.0, 0.3, 4.0, 10.0, 3.0, 12, 1e4


def main() -> None:
    """Solve and print the force on half of the disc."""
    gf.util_trace_level(0)
    mesh = gf.Mesh("cartesian", np.linspace(0, 5, 11), np.linspace(0, HEIGHT, 21))
    boxes = ([[-1, -1e-6], [6, 1e-6]], [[-1, HEIGHT - 1e-6], [6, 11]], [[-1e-6, -1], [1e-6, 11]])
    bottom, top, middle = 1, 2, 3
    for region, (low, high) in zip((bottom, top, middle), boxes, strict=True):
        mesh.set_region(region, mesh.outer_faces_in_box(low, high))
    space = gf.MeshFem(mesh, 2)
    space.set_classical_fem(2)
    rule = gf.MeshIm(mesh, gf.Integ("IM_GAUSS_PARALLELEPIPED(2,4)"))
    model = gf.Model("real")
    model.add_fem_variable("u", space)
    shear, lame = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    for name, value in {"G": [shear], "L": [lame], "k": [K], "R": [RADIUS]}.items():
        model.add_initialized_data(name, value)
    model.add_initialized_data("c", [0.0, HEIGHT + RADIUS])
    gradient = "(Id(2)+Grad_u)"
    model.add_nonlinear_term(
        rule,
        f"G/2*(Norm_sqr{gradient}+1-3-2*log(Det{gradient}))"
        f"+L/4*(sqr(Det{gradient})-1-2*log(Det{gradient}))",
    )
    model.add_nonlinear_term(rule, "k/2*sqr(neg_part(Norm(X+u-c)-R))", top)
    model.add_Dirichlet_condition_with_simplification("u", bottom)
    model.add_initialized_data("across", np.array([[1.0, 0.0], [0.0, 0.0]]))
    model.add_initialized_data("zero", [0.0, 0.0])
    # With multipliers the corner of the top is left free to move by 1e-3.
    model.add_generalized_Dirichlet_condition_with_penalization(
        rule, "u", 1e12, middle, "zero", "across"
    )
    start, iterations = time.perf_counter(), 0
    for step in range(1, STEPS + 1):
        model.set_variable("c", [0.0, HEIGHT + RADIUS - DEPTH * step / STEPS])
        made, _ = model.solve("max_iter", 60, "max_res", 1e-9, "lsearch", "simplest")
        iterations += made
        upward = "-k*neg_part(Norm(X+u-c)-R)*((X+u-c)/Norm(X+u-c)).[0;1]"
        force = gf.asm("generic", rule, 0, upward, top, model)
        print(f"{DEPTH * step / STEPS:.2f}  {force:.6f}")
    print(f"{iterations} Newton iterations, {time.perf_counter() - start:.2f} s")


if __name__ == "__main__":
    main()
