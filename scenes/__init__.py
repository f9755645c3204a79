"""Bodies, meshes, tags and elasticity common to tests, benchmarks and verification.

Problems that are needed more than once are defined here. Neither the package `fenics_contact` nor
its demos, which are self-contained scripts, depend on this package.
"""
