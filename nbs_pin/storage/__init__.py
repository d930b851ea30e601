"""Controllers and models in files."""
