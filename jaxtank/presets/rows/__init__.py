"""Published numbers and claims, and what is measured of them."""
