"""The same loop over many draws of its uncertain parameters, and which of them matter."""
