"""The perfect-information open-loop optimum: the best inputs when the whole run is known in
advance.
"""
