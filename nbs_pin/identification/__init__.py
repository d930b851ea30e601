"""Models of arms from measured motions: data collection, log files, least squares and network fits."""
