"""The version, readable without importing DOLFINx."""

__version__ = "0.1.0"
