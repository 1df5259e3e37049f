"""The command line: Hydra configs in, studies, sweeps, estimates and hardware trials out."""
