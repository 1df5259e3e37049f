"""Pictures of scenes, fields and trials, as Matplotlib figures.

Every function returns a new figure and leaves pyplot's global state alone: save it with ``figure.savefig``;
a notebook shows it where it is the last expression of a cell. Data are plain arrays or tensors, or mappings
of them by the names of scenes and methods. Lengths are drawn in mm.
"""
