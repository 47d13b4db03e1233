"""Rigs and closed loops of the papers whose preset alone would be too long."""
