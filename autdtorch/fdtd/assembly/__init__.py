"""Assembly of heterogeneous cells: geometry, interface elements, coupling coefficients, stencil rows."""
