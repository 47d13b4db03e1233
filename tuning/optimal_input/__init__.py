"""The perfect-information open-loop optimum: the best inputs if the whole run is known."""
