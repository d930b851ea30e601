"""The paper's experiments reproduced, and the studies of this package."""
