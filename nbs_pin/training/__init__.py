"""Controllers trained through the closed loop."""
