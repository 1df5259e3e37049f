"""Bayesian optimisation by BoTorch, which is loaded here without the warning of a package below it."""

import warnings

with warnings.catch_warnings():
    # linear_operator 0.6.1 calls it when it is imported, and users can do nothing about it
    warnings.filterwarnings("ignore", "`torch.jit.script` is")
    import botorch.models  # noqa: F401
