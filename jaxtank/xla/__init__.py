"""Workarounds for the XLA compiler; each module names the version that made it necessary.

Imports jax only; may be imported by every folder.
"""
