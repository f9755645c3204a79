from pathlib import Path

from spack.package import *
from spack_repo.builtin.build_systems.python import PythonPackage


class PyFenicsContact(PythonPackage):
    """Frictional contact for FEniCSx as a UFL boundary form."""

    # This checkout; Spack's repository requires `url` and, per version, the sha256 of the sdist.
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

    # Contact is an inequality, which complex numbers do not have. MUMPS supports several ranks.
    depends_on("petsc~complex+mumps")

    with when("+demo"), default_args(type="run"):
        depends_on("py-gmsh")
        depends_on("py-matplotlib")
        depends_on("py-tqdm")
