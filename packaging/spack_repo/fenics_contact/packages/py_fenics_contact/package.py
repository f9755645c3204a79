from pathlib import Path

from spack.package import *
from spack_repo.builtin.build_systems.python import PythonPackage


class PyFenicsContact(PythonPackage):
    """Frictional contact for FEniCSx as a UFL boundary form."""

    # This checkout; in Spack's own repository `url` and, for each version, the sha256 of its sdist.
    git = Path(__file__).resolve().parents[5].as_uri()

    license("LGPL-3.0-or-later")

    version("main", branch="main")

    variant("demo", default=False, description="What the demos need: gmsh, matplotlib, tqdm")

    depends_on("py-setuptools@77:", type="build")

    with default_args(type=("build", "run")):
        depends_on("python@3.10:")
        depends_on("py-fenics-dolfinx@0.9:+petsc4py")
        depends_on("py-fenics-ufl")
        depends_on("py-fenics-basix")
        depends_on("py-petsc4py")
        depends_on("py-mpi4py")
        depends_on("py-numpy")
        depends_on("py-scipy")

    # Contact is an inequality: of complex numbers there is none. MUMPS factorises on several ranks.
    depends_on("petsc~complex+mumps")

    with when("+demo"), default_args(type="run"):
        depends_on("py-gmsh")
        depends_on("py-matplotlib")
        depends_on("py-tqdm")
