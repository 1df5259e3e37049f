"""T-matrices of bodies, and the propagator of scenes by them."""
