"""Dynamics models of an arm, on which controllers rely."""
