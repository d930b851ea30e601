"""Training of controllers through the closed loop."""
