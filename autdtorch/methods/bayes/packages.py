"""Names of BoTorch and GPyTorch, imported without the warning of a package below them."""

import warnings

with warnings.catch_warnings():
    # linear_operator 0.6.1 calls it when it is imported, and users can do nothing about it
    warnings.filterwarnings("ignore", "`torch.jit.script` is")
    from botorch.acquisition.analytic import _ei_helper as ei_helper
    from botorch.acquisition.analytic import _log_ei_helper as log_ei_helper
    from botorch.fit import fit_gpytorch_mll
    from botorch.models import SingleTaskGP
    from botorch.test_functions.base import BaseTestProblem
    from botorch.utils.safe_math import fatmin, log_fatplus, logmeanexp
    from gpytorch.kernels import Kernel, MaternKernel
    from gpytorch.means import ZeroMean
    from gpytorch.mlls import ExactMarginalLogLikelihood

__all__ = [
    "BaseTestProblem",
    "ExactMarginalLogLikelihood",
    "Kernel",
    "MaternKernel",
    "SingleTaskGP",
    "ZeroMean",
    "ei_helper",
    "fatmin",
    "fit_gpytorch_mll",
    "log_ei_helper",
    "log_fatplus",
    "logmeanexp",
]
