"""Run times of laws, plants and training, and a comparison of tuned laws."""
