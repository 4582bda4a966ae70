"""GPU kernels compiled without a GPU. They need their own process, because one cannot both compile and simulate."""
