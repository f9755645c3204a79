"""Bodies, meshes, tags and elasticity that tests, benchmarks and verification share.

Whoever makes a scene twice finds the one place for it here. Nothing here is part of the package
`fenics_contact`, nor of what its demos need: those are scripts that users run as they stand.
"""
