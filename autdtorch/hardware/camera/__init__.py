"""A thermal camera that sees the heat of the sound in a thin screen."""
