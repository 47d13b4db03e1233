"""Limits on levels that hold for every plant of a box: the filter, and when it is proved."""

from jaxtank.safety.certificate import TankCertificate, design
from jaxtank.safety.filter import SafetyFilter
from jaxtank.safety.of_case import design_for

__all__ = ["SafetyFilter", "TankCertificate", "design", "design_for"]
