"""Plants and the closed loop."""
