"""What a controller promises before it moves, how each promise is known, and attempts to break it."""
