"""Bounds of the inertia matrix over all poses."""
