"""Comparison of dynamics models."""
