"""Numerical constants of the assembly. Lengths are in cells; densities and masses are relative to air."""

# Density with which sound-hard bodies are assembled. Cells that stay almost uncoupled become sound-hard.
SOUND_HARD_DENSITY = 1e5
# Distance by which bodies are grown, so that touching bodies leave no film of air between them
CONTACT_GAP = 1e-9
# Half the diagonal of an element: a surface farther from its centre does not intersect it
HALF_DIAGONAL = 0.87
FAR = 1e3  # Signed distance of a body that is too far from an element to matter
SUBCELLS = 4  # Sub-cells along each edge of an interface element, for the volume quadrature
ABSENT_SHARE = 1e-4  # Share of an element's volume below which a material counts as absent
# Smallest mean gradient of a signed distance with one normal. The two faces of a thin plate cancel.
LEAST_GRADIENT = 0.5
PLANE_VARIATION = 1e-6  # Largest variation of a signed distance along an axis-aligned face: rounding
# Largest curvature [1/cells] of a surface that the local solutions follow. Edges have none.
LARGEST_CURVATURE = 0.5
# Diagonal coupling that an element full of the heavier material supplies, relative to its own need. The
# element behind has a sixth to spare, and half of that is used.
DIAGONAL_SHARE = 6.0
# Sum of coupling coefficients, relative to air, up to which a cell in a sound-hard body is sound-hard. Cells
# at a surface have 0.3 or more, all others 0.03 or less.
SOUND_HARD_COUPLING = 0.1
# Eigenvalues below this share of the largest are rounding in a condensed stiffness matrix. A higher value
# would remove energy from nearly constant pressures.
NULL_EIGENVALUE = 1e-10
ROW_ROUNDING = 1e-9  # Stencil rows within this of air's are those of air
# Largest sum of a stencil row at a surface, relative to a uniform material, before the cell receives mass.
# Gershgorin's bound exceeds the largest eigenvalue of air by more. For the paper's cubes 1.1 costs 3 % of the
# time step and 1.2 would cost 8 %; a slab of density ratio 3 keeps its mass.
ROW_SUM_MARGIN = 1.1
MASS_TRANSFERS = 6  # Largest number of mass transfers to light cells; one is nearly always enough
