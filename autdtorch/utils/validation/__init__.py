"""Checks made once, where a value enters the package.

Every function takes the name of the field first and returns the checked value in one canonical form. A bad
value raises a `ValueError` of one line, ``field: value unit; accepted range``.
"""

from autdtorch.utils.validation.numbers import boolean as boolean
from autdtorch.utils.validation.numbers import finite_number as finite_number
from autdtorch.utils.validation.numbers import fluid as fluid
from autdtorch.utils.validation.numbers import indices as indices
from autdtorch.utils.validation.numbers import integer_at_least as integer_at_least
from autdtorch.utils.validation.numbers import integers as integers
from autdtorch.utils.validation.numbers import not_negative as not_negative
from autdtorch.utils.validation.numbers import number_between as number_between
from autdtorch.utils.validation.numbers import positive as positive
from autdtorch.utils.validation.numbers import positive_integers as positive_integers
from autdtorch.utils.validation.objects import hint as hint
from autdtorch.utils.validation.objects import members as members
from autdtorch.utils.validation.objects import path_of as path_of
from autdtorch.utils.validation.objects import require_callable as require_callable
from autdtorch.utils.validation.objects import require_kind as require_kind
from autdtorch.utils.validation.objects import require_known as require_known
from autdtorch.utils.validation.objects import require_name as require_name
from autdtorch.utils.validation.objects import require_one_of as require_one_of
from autdtorch.utils.validation.tensors import LENGTH_TOLERANCE as LENGTH_TOLERANCE
from autdtorch.utils.validation.tensors import ArrayLike as ArrayLike
from autdtorch.utils.validation.tensors import Vector as Vector
from autdtorch.utils.validation.tensors import complex_tensor as complex_tensor
from autdtorch.utils.validation.tensors import finite_vector as finite_vector
from autdtorch.utils.validation.tensors import magnitude_tensor as magnitude_tensor
from autdtorch.utils.validation.tensors import points_grid as points_grid
from autdtorch.utils.validation.tensors import points_tensor as points_tensor
from autdtorch.utils.validation.tensors import positive_entries as positive_entries
from autdtorch.utils.validation.tensors import real_tensor as real_tensor
from autdtorch.utils.validation.tensors import unit_vector as unit_vector
from autdtorch.utils.validation.values import invalid as invalid
from autdtorch.utils.validation.values import is_dense as is_dense
from autdtorch.utils.validation.values import within as within
