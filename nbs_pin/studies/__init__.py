"""Whole studies: what the commands of the command line do, as functions."""
