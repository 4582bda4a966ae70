"""Processing state: worker processes make images of measurements, a publisher hands them to applications."""
