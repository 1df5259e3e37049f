"""Colours and lines that Matplotlib figures and 3D views share."""

import numpy as np

# Colours of the Okabe-Ito palette, which colour-blind readers can distinguish.
TRANSDUCER_COLOUR = "#0072B2"
FOCUS_COLOUR = "#009E73"  # green: not in the colour map of the pressure
PLANE_COLOUR = "#56B4E9"
OBSTACLE_COLOUR = "#B0B0B0"
REFLECTOR_COLOUR = "#8A6D3B"
EDGE_COLOUR = "#222222"

SHARP_ANGLE = np.radians(30)  # between two faces; sharper edges of obstacles are drawn
REFLECTOR_OPACITY, BACK_OPACITY = 0.3, 0.08  # of reflectors seen from the front, and from the back
MOST_EDGES = 500  # of one obstacle; more, as those of voxels, would blacken it and are not drawn

PHASE_MAP = "twilight"  # cyclic: 0 and 2 pi have one colour
PRESSURE_MAP = "inferno"
FLOOR = -30.0  # dB, lower end of the colour scale
WAVE_MAP = "RdBu_r"  # for pressures of both signs; 0 is white
