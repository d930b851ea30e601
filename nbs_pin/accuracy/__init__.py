"""How far a model is from another."""
