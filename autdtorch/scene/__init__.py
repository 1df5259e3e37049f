"""Scenes: transducer array, medium, obstacles and control points."""
