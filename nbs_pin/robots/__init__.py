"""Descriptions of arms: URDF, checks, drawings."""
