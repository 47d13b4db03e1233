"""Workarounds for the XLA compiler; each module names the version that made it necessary."""
