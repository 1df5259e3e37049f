"""Pictures of scenes, fields and trials, as Matplotlib figures.

Every function returns a new figure and does not change pyplot's global state. ``figure.savefig`` saves it; a
notebook shows it if it is the last expression of a cell. Data are arrays or tensors, or mappings of them by
scene and method name. Pictures show lengths in mm.
"""
