"""Machine code of laws, models and rollouts."""
