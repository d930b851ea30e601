"""Models of an arm: what the controller believes."""
