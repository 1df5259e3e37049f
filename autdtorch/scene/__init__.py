"""The scene: transducer array, medium, obstacles, control points, and the geometry they stand on."""
