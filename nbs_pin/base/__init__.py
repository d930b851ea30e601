"""Errors, arrays, checks, files and records that the whole package uses."""
