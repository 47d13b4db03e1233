"""A case as a live page: its closed loop as JavaScript, and the page around it."""
