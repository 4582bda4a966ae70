"""Analysis of images and measurements: detection, points, comparison with ground truth, and array health."""
