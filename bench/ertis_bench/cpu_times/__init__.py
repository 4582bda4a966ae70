"""Times of the signal chain versus settings, workers and beamformers, and the costs of its parts."""
