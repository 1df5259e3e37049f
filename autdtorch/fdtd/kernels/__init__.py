"""Time-stepping kernels under one contract: a readable specification and fast versions."""
