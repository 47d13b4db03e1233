"""A whole closed loop as code: its sample as statements, sorted and printed in few characters."""
