"""Certified bounds of the closed loop and how each is known, worst-case search, monitors and design."""
