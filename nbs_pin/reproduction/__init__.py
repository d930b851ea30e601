"""The paper and the studies of this package, run again."""
