"""Limits on levels that hold for every plant of a box: the filter, and when it is proved."""

from jaxtank.safety.certificate import TankCertificate, design
from jaxtank.safety.filter import SafetyFilter
from jaxtank.safety.of_case import design_for
from jaxtank.safety.outlets import OutletFilter

__all__ = ["OutletFilter", "SafetyFilter", "TankCertificate", "design", "design_for"]
