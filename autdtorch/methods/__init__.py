"""Methods: they see an objective (drives in, pressure magnitudes out), and ask and tell its drives."""
