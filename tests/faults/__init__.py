"""Trials of faults: kills, power cuts, damaged files, bad lines and hostile peers; ``make soak`` runs them."""
