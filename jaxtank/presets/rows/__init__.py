"""Published numbers and claims, and what is measured of them, where the preset would be
too long.
"""
