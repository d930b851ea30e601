"""Figures and pages of runs, certificates, models and studies."""
