"""What a controller acts on: the truth of a simulation."""
