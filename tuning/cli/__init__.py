"""The command line `jaxtank`."""
