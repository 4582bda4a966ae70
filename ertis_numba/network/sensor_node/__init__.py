"""The sensor node: keeps measurements until the central node has acknowledged them."""
