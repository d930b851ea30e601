"""Calls of the public Python interface with hostile arguments (`tools/fuzz_api.py`)."""
