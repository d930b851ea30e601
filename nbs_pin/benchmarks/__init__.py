"""Run times of laws, plants and training, a comparison of tuned laws, and the challenge for laws of anyone."""
