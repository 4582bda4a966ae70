"""What the network does to measurements: figures, faults, and the oracle that judges them."""
