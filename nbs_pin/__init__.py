"""Tracking control for any URDF arm, stable for every value of its network weights."""

__version__ = "0.1.0"
