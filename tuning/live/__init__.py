"""The interactive page: the closed loop simulated and tuned in a browser, in one HTML file."""
