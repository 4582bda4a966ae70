"""The central node: takes measurements in, stores them, hands them on to be processed."""
