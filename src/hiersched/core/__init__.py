"""Numbers, randomness, compiled kernels and how models meet them: what everything stands on."""
