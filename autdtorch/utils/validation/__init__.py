"""Checks made once, where a value enters the package.

Every function takes the name of the field first and returns the checked value in one canonical form. A bad
value raises a `ValueError` of one line, ``field: value unit; accepted range``.
"""

from autdtorch.utils.validation.numbers import (
    boolean,
    finite_number,
    fluid,
    indices,
    integer_at_least,
    integers,
    not_negative,
    number_between,
    positive,
    positive_integers,
)
from autdtorch.utils.validation.objects import (
    hint,
    members,
    path_of,
    require_callable,
    require_kind,
    require_known,
    require_name,
    require_one_of,
)
from autdtorch.utils.validation.tensors import (
    LENGTH_TOLERANCE,
    ArrayLike,
    Vector,
    complex_tensor,
    finite_vector,
    magnitude_tensor,
    points_grid,
    points_tensor,
    positive_entries,
    real_tensor,
    unit_vector,
)
from autdtorch.utils.validation.values import invalid, is_dense

__all__ = [
    "LENGTH_TOLERANCE",
    "ArrayLike",
    "Vector",
    "boolean",
    "complex_tensor",
    "finite_number",
    "finite_vector",
    "fluid",
    "hint",
    "indices",
    "integer_at_least",
    "integers",
    "invalid",
    "is_dense",
    "magnitude_tensor",
    "members",
    "not_negative",
    "number_between",
    "path_of",
    "points_grid",
    "points_tensor",
    "positive",
    "positive_entries",
    "positive_integers",
    "real_tensor",
    "require_callable",
    "require_kind",
    "require_known",
    "require_name",
    "require_one_of",
    "unit_vector",
]
