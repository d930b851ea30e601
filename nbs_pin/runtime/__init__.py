"""Laws on arms: the guard, arms, the loop at a fixed rate."""
